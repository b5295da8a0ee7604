//! What start-up mends after the process ended at any moment.

use uuid::Uuid;

use super::JobState;
use super::queue::{job_id, transition};
use super::view::{CurrentStage, ErrorView};
use crate::store::db::{datasets, job_stages, jobs};
use crate::store::{Store, StoreError};

/// The process may end so often under a job without a further stage coming to its end; then the job is to blame.
const MAX_INTERRUPTIONS: i64 = 10;

/// What was mended.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Recovered {
    /// Jobs that ran and wait again.
    pub requeued: usize,
    /// Jobs that somebody had asked to stop.
    pub cancelled: usize,
    /// Jobs under which the process ended too often.
    pub given_up: usize,
    /// Datasets of uploads that were never acknowledged.
    pub abandoned_uploads: usize,
}

/// Brings the store into order; to be called once, before the executor starts.
///
/// # Errors
/// What the store said.
pub async fn recover(store: &Store) -> Result<Recovered, StoreError> {
    let mut recovered = Recovered::default();
    let mut tx = store.db.write().await?;
    for mut row in jobs::in_state(&mut tx, "running").await? {
        let id = job_id(&row)?;
        let stages = job_stages::list(&mut *tx, id).await?;
        let finished = stages.iter().filter(|stage| stage.state == "done" || stage.state == "reused").count();
        let finished = i64::try_from(finished).unwrap_or(i64::MAX);
        row.interruptions = if finished > row.stages_finished { 1 } else { row.interruptions + 1 };
        row.stages_finished = row.stages_finished.max(finished);
        if row.cancel_requested {
            recovered.cancelled += 1;
            transition(&mut tx, &mut row, JobState::Cancelled, None).await?;
        } else if row.interruptions >= MAX_INTERRUPTIONS {
            recovered.given_up += 1;
            let stage = CurrentStage::among(&stages).map(|stage| stage.name);
            let message =
                format!("the service ended {MAX_INTERRUPTIONS} times while this stage ran, perhaps for want of memory");
            let error = ErrorView { stage, code: "interrupted".to_owned(), message };
            transition(&mut tx, &mut row, JobState::Failed, Some(error)).await?;
        } else {
            recovered.requeued += 1;
            transition(&mut tx, &mut row, JobState::Queued, None).await?;
        }
    }
    for dataset in datasets::abandoned(&mut *tx).await? {
        let Ok(dataset) = dataset.parse::<Uuid>() else { continue };
        recovered.abandoned_uploads += 1;
        datasets::delete(&mut tx, dataset).await?;
    }
    tx.commit().await?;
    store.discard_deleted().await?;
    Ok(recovered)
}
