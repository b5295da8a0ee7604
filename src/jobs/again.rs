//! What clients of NodeODM may do with jobs beyond the rest: take a finished one back, run one again with other
//! options, and leave tasks uncommitted.

use std::time::Duration;

use uuid::Uuid;

use super::queue::{queue_again, transition};
use super::{JobState, Jobs, JobsError, state_of};
use crate::store::db::jobs::{self, JobRow};
use crate::store::db::{nodeodm_tasks, now_ms};

impl Jobs {
    /// Stops a job that waits or runs, and makes a finished one count as cancelled; its outputs stay.
    ///
    /// # Errors
    /// [`JobsError::JobNotFound`], or what the store said.
    pub async fn withdraw(&self, id: Uuid) -> Result<JobRow, JobsError> {
        match self.cancel(id).await {
            Err(JobsError::NotActive(_)) => {}
            stopped => return stopped,
        }
        let mut tx = self.store.db.write().await?;
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        if state_of(&row).may_become(JobState::Cancelled) {
            transition(&mut tx, &mut row, JobState::Cancelled, None).await?;
        }
        tx.commit().await?;
        self.hub.announce();
        Ok(row)
    }

    /// Queues a job that is over again, with these options or, without, its own; what it made goes.
    ///
    /// # Errors
    /// [`JobsError::NotResumable`] while it waits or runs, [`JobsError::InvalidOptions`].
    pub async fn restart(&self, id: Uuid, options: Option<&serde_json::Value>) -> Result<JobRow, JobsError> {
        if let Some(options) = options {
            self.check("", options)?;
        }
        let mut tx = self.store.db.write().await?;
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        let state = state_of(&row);
        if !state.is_final() {
            return Err(JobsError::NotResumable(state));
        }
        if let Some(options) = options {
            jobs::set_options(&mut tx, id, &options.to_string()).await?;
        }
        queue_again(&mut tx, &mut row).await?;
        tx.commit().await?;
        self.hub.announce();
        self.hub.wake_executor();
        Ok(row)
    }

    /// Removes tasks of the NodeODM interface that were begun and got no photograph for `expiry`, with what they got
    /// before; how many.
    ///
    /// # Errors
    /// What the store said.
    pub async fn remove_abandoned_tasks(&self, expiry: Duration) -> Result<usize, JobsError> {
        let before = now_ms() - i64::try_from(expiry.as_millis()).unwrap_or(i64::MAX / 2);
        let abandoned = nodeodm_tasks::datasets_untouched_since(self.store.db.reader(), before).await?;
        for dataset in &abandoned {
            self.delete_dataset(dataset.parse().map_err(|_| JobsError::DatasetNotFound)?).await?;
        }
        Ok(abandoned.len())
    }

    /// Waits until a job that was asked to stop has stopped, but no longer than `most`.
    ///
    /// # Errors
    /// [`JobsError::JobNotFound`], or what the store said.
    pub async fn stopped(&self, id: Uuid, most: Duration) -> Result<JobRow, JobsError> {
        let mut changes = self.hub.changes();
        let wait = async {
            loop {
                changes.mark_unchanged();
                let row = self.find(id).await?;
                if state_of(&row) != JobState::Running || changes.changed().await.is_err() {
                    return Ok(row);
                }
            }
        };
        match tokio::time::timeout(most, wait).await {
            Ok(row) => row,
            Err(_) => self.find(id).await,
        }
    }
}
