//! How a job ends: its outputs are published, then verdicts, models and the final state committed together.

use std::sync::Arc;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::executor::{Executor, STORE_RETRY};
use super::queue::transition;
use super::view::ErrorView;
use super::{Hold, JobState, publish};
use crate::formats::report::Report;
use crate::store::StoreError;
use crate::store::db::job_outputs::JobOutputRow;
use crate::store::db::jobs::JobRow;
use crate::store::db::{job_outputs, job_stages, jobs};

/// A job may fill the disk so often in a row without a further stage coming to its end.
const MAX_DISK_FULL: i64 = 3;

/// How a run ended.
pub(super) enum Outcome {
    Report(Box<Report>),
    Cancelled,
    Failed(ErrorView),
}

impl Executor {
    /// Stores how a job ended, again and again until the store takes it or the process ends.
    pub(super) async fn finish(&self, id: Uuid, outcome: Outcome) -> JobState {
        let mut outputs = None;
        loop {
            match self.try_finish(id, &outcome, &mut outputs).await {
                Ok(state) => {
                    self.jobs.hub.announce();
                    return state;
                }
                Err(error) => {
                    tracing::error!(job = %id, %error, "the end of a job could not be stored");
                    if error.is_disk_full() {
                        self.jobs.store.drop_ballast();
                    }
                }
            }
            if self.jobs.hub.is_stopping() {
                return JobState::Running;
            }
            tokio::time::sleep(STORE_RETRY).await;
        }
    }

    /// One attempt. `outputs` keeps what was published, because that can be done only once.
    async fn try_finish(
        &self,
        id: Uuid,
        outcome: &Outcome,
        outputs: &mut Option<Vec<JobOutputRow>>,
    ) -> Result<JobState, StoreError> {
        let store = &self.jobs.store;
        if matches!(outcome, Outcome::Report(_)) && outputs.is_none() {
            let store = Arc::clone(store);
            let publish = tokio::task::spawn_blocking(move || publish::publish(&store.data, id));
            *outputs = Some(publish.await.map_err(std::io::Error::other)??);
        }
        let mut tx = store.db.write().await?;
        if let Some(outputs) = outputs {
            job_outputs::replace(&mut tx, id, outputs).await?;
        }
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(StoreError::NotFound)?;
        let (state, error) = match outcome {
            Outcome::Report(report) => {
                row.models = Some(publish::models_json(report));
                publish::write_verdicts(&mut tx, id, report).await?;
                if report.models.is_empty() {
                    (JobState::Failed, Some(no_model(report)))
                } else {
                    (JobState::Succeeded, None)
                }
            }
            // The process ends: the job goes on after the next start.
            Outcome::Cancelled if self.jobs.hub.is_stopping() && !row.cancel_requested => (JobState::Queued, None),
            Outcome::Cancelled => (JobState::Cancelled, None),
            Outcome::Failed(error) if error.code == "disk_full" && !row.cancel_requested => {
                (wait_for_space(&mut row, id, &mut tx).await?, Some(error.clone()))
            }
            Outcome::Failed(error) => (JobState::Failed, Some(error.clone())),
        };
        let error = error.filter(|_| state == JobState::Failed);
        let code = error.as_ref().map(|error| error.code.clone());
        transition(&mut tx, &mut row, state, error).await?;
        tx.commit().await?;
        self.jobs.figures.ended(state, code.as_deref());
        Ok(state)
    }
}

/// Sends a job that filled the disk back to wait for more room than was thought, unless it keeps filling it without getting
/// anywhere.
async fn wait_for_space(row: &mut JobRow, id: Uuid, tx: &mut SqliteConnection) -> Result<JobState, StoreError> {
    let stages = job_stages::list(&mut *tx, id).await?;
    let finished = stages.iter().filter(|stage| stage.state == "done" || stage.state == "reused").count();
    let finished = i64::try_from(finished).unwrap_or(i64::MAX);
    row.interruptions = if finished > row.stages_finished { 1 } else { row.interruptions + 1 };
    row.stages_finished = row.stages_finished.max(finished);
    if row.interruptions > MAX_DISK_FULL {
        return Ok(JobState::Failed);
    }
    row.held = Some(Hold::DiskFull.as_str().to_owned());
    row.needed_bytes = row.needed_bytes.map(|bytes| bytes.saturating_add(bytes / 2));
    Ok(JobState::Queued)
}

fn no_model(report: &Report) -> ErrorView {
    let examined = report.images.len();
    let message = format!(
        "no model could be made of the {examined} photographs; the report says for each what happened and what may help"
    );
    let stage = report.stages.iter().map(|stage| stage.name.as_str()).find(|name| *name == "coarse_model");
    ErrorView { stage: stage.map(str::to_owned), code: "no_model".to_owned(), message }
}
