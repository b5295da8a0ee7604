//! Deletion of jobs and datasets: rows first, in one transaction, folders after it.

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::JobState;
use super::JobsError;
use super::queue::{Jobs, state_of};
use crate::store::StoreError;
use crate::store::db::{datasets, jobs};

/// Removes the rows of a job that does not run, and its dataset when its own upload made it and no other job uses it;
/// gives that dataset.
pub(super) async fn remove_job(tx: &mut SqliteConnection, id: Uuid) -> Result<Option<Uuid>, StoreError> {
    let own: Option<Uuid> = datasets::owned_only_by(&mut *tx, id).await?.and_then(|dataset| dataset.parse().ok());
    jobs::delete(&mut *tx, id).await?;
    match own {
        Some(dataset) => {
            datasets::delete(tx, dataset).await?;
        }
        None => datasets::release_owner(tx, id).await?,
    }
    Ok(own)
}

impl Jobs {
    /// Deletes a job that does not run, its files, and its dataset when its own upload made it and no other job uses it.
    ///
    /// # Errors
    /// [`JobsError::Running`].
    pub async fn delete(&self, id: Uuid) -> Result<(), JobsError> {
        match self.try_delete(id).await {
            Err(error) if self.made_room(&error) => self.try_delete(id).await,
            other => other,
        }
    }

    async fn try_delete(&self, id: Uuid) -> Result<(), JobsError> {
        let mut tx = self.store.db.write().await?;
        let row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        if state_of(&row) == JobState::Running {
            return Err(JobsError::Running);
        }
        remove_job(&mut tx, id).await?;
        tx.commit().await?;
        self.hub.announce();
        self.remove_folders().await;
        Ok(())
    }

    /// Removes the folders of what was deleted. The deletion itself is done and must not be told as failed: what stays
    /// stands on the list, for the next deletion or start.
    async fn remove_folders(&self) {
        if let Err(error) = self.store.discard_deleted().await {
            tracing::warn!(%error, "folders of what was deleted stay until the next deletion");
        }
    }

    /// Deletes a dataset that no job refers to.
    ///
    /// # Errors
    /// [`StoreError::DatasetInUse`].
    pub async fn delete_dataset(&self, id: Uuid) -> Result<(), JobsError> {
        match self.try_delete_dataset(id).await {
            Err(error) if self.made_room(&error) => self.try_delete_dataset(id).await,
            other => other,
        }
    }

    async fn try_delete_dataset(&self, id: Uuid) -> Result<(), JobsError> {
        let mut tx = self.store.db.write().await?;
        if jobs::use_of_dataset(&mut tx, id).await?.0 {
            return Err(StoreError::DatasetInUse.into());
        }
        if !datasets::delete(&mut tx, id).await? {
            return Err(JobsError::DatasetNotFound);
        }
        tx.commit().await?;
        self.remove_folders().await;
        Ok(())
    }
}
