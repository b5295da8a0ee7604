//! Photographs and the job on them in one request: all of it happens or nothing.

use uuid::Uuid;

use super::AppState;
use super::access::Principal;
use super::problem::Problem;
use super::upload::{Form, Parts, Received, receive};
use crate::jobs::webhooks::NewWebhook;
use crate::jobs::{Jobs, NewJob};
use crate::store::db::jobs::JobRow;
use crate::store::db::{datasets, now_ms};

/// The dataset of an upload: goes again unless the upload becomes a job, also when the sender leaves in the middle.
struct OwnDataset {
    jobs: Jobs,
    dataset: Uuid,
    kept: bool,
}

impl Drop for OwnDataset {
    fn drop(&mut self) {
        if !self.kept {
            let (jobs, dataset) = (self.jobs.clone(), self.dataset);
            tokio::spawn(async move {
                if let Err(error) = jobs.delete_dataset(dataset).await {
                    tracing::warn!(%dataset, %error, "what a broken upload left behind stays until the next start");
                }
            });
        }
    }
}

/// What a form says about its job.
pub(super) struct Order {
    pub(super) name: String,
    pub(super) options: serde_json::Value,
    pub(super) priority: i64,
    pub(super) webhook: Option<NewWebhook>,
}

/// Stores the photographs of a form in a dataset of their own and queues the job `id` on them, by what `read` takes
/// from the form.
pub(super) async fn submit(
    state: &AppState,
    principal: &Principal,
    id: Uuid,
    parts: Parts,
    form: Form,
    read: impl FnOnce(&Received) -> Result<Order, Problem>,
) -> Result<JobRow, Problem> {
    let dataset = Uuid::now_v7();
    let mut tx = state.jobs.store.db.write().await?;
    datasets::insert(&mut tx, dataset, "", now_ms(), Some(id), principal.owner()).await?;
    tx.commit().await?;
    let mut own = OwnDataset { jobs: state.jobs.clone(), dataset, kept: false };
    let received = receive(state, parts, dataset, form).await?;
    let Order { name, options, priority, webhook } = read(&received)?;
    principal.check_priority(priority)?;
    let (ignored, owner_token) = (Some(received.ignored), principal.owner());
    let new = NewJob { id, name, dataset, options, ignored, priority, owner_token, webhook };
    let row = state.jobs.enqueue(new).await?;
    own.kept = true;
    Ok(row)
}
