//! What may be done with jobs from outside: enqueue, cancel, resume (and delete: [`super::deletion`]). Every move is one
//! transaction, and each change of state is an event.

use std::collections::BTreeMap;
use std::sync::Arc;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::eta::{Eta, estimate};
use super::schedule::{self, QueuePlace, Rates, Size, Turns, Waiting};
use super::view::{ErrorView, StateEvent, time_text};
use super::webhooks::NewWebhook;
use super::{Engine, Figures, Hold, Hub, JobState, JobsError};
use crate::store::db::jobs::{JobRow, NewJobRow, QueuedRow};
use crate::store::db::{
    dataset_images, datasets, job_events, job_images, job_outputs, job_stages, jobs, now_ms, webhooks,
};
use crate::store::{Quantity, Store, StoreError, check_quota};

/// Letters of a job's name.
pub const MAX_NAME_CHARS: usize = 200;
/// The highest priority; the lowest is as far below 0.
pub const MAX_PRIORITY: i64 = 10;
/// Runs that a forecast goes by.
const RATED_RUNS: u32 = 20;

/// The jobs of a store.
#[derive(Clone)]
pub struct Jobs {
    /// Where they are kept.
    pub store: Arc<Store>,
    /// Who must hear of changes.
    pub hub: Arc<Hub>,
    /// Who runs them.
    pub engine: Arc<dyn Engine>,
    /// What they took.
    pub figures: Arc<Figures>,
}

/// What to reconstruct.
#[derive(Clone, Debug)]
pub struct NewJob {
    /// Its id, a fresh one.
    pub id: Uuid,
    /// For people; the dataset's name when empty.
    pub name: String,
    /// Its photographs.
    pub dataset: Uuid,
    /// What the engine takes.
    pub options: serde_json::Value,
    /// Files of its own upload that were no photographs.
    pub ignored: Option<usize>,
    /// Of two waiting jobs the one of higher priority starts first.
    pub priority: i64,
    /// The token it belongs to.
    pub owner_token: Option<Uuid>,
    /// Who is told of its changes of state, from the first on.
    pub webhook: Option<NewWebhook>,
}

/// What a job is given when it starts.
#[derive(Clone, Debug, Default)]
pub(super) struct Given {
    /// Worker threads.
    pub(super) threads: usize,
    /// Why not all.
    pub(super) note: Option<String>,
    /// Memory it may need.
    pub(super) memory_bytes: u64,
    /// Room on the disk it may need.
    pub(super) disk_bytes: u64,
}

/// A job's id out of a row, which was written from one.
pub(super) fn job_id(row: &JobRow) -> Result<Uuid, StoreError> {
    row.id.parse().map_err(|_| sqlx::Error::Decode(format!("{:?} is no id", row.id).into()).into())
}

/// The state of a row; the table takes no other names.
pub fn state_of(row: &JobRow) -> JobState {
    JobState::parse(&row.state).unwrap_or(JobState::Failed)
}

/// Moves a job to another state: row and event.
pub(super) async fn transition(
    tx: &mut SqliteConnection,
    row: &mut JobRow,
    next: JobState,
    error: Option<ErrorView>,
) -> Result<(), StoreError> {
    let id = job_id(row)?;
    // Somebody may have set the clock back between two starts of the program; nothing happens to a job before what
    // happened last.
    let now = now_ms().max(row.created_ms).max(row.started_ms.unwrap_or(0));
    debug_assert!(state_of(row).may_become(next), "{} -> {next}", row.state);
    row.state = next.as_str().to_owned();
    if next == JobState::Running {
        row.started_ms = Some(now);
    }
    row.finished_ms = next.is_final().then_some(now);
    if next != JobState::Running {
        row.cancel_requested = false;
    }
    let event = StateEvent { state: next, at: time_text(now), error };
    row.error_stage = event.error.as_ref().and_then(|error| error.stage.clone());
    row.error_code = event.error.as_ref().map(|error| error.code.clone());
    row.error_message = event.error.as_ref().map(|error| error.message.clone());
    jobs::update_state(tx, row).await?;
    let data = serde_json::to_string(&event).map_err(|error| sqlx::Error::Encode(error.into()))?;
    job_events::append(tx, id, "state", &data).await?;
    Ok(())
}

fn check_priority(priority: i64) -> Result<(), JobsError> {
    if (-MAX_PRIORITY..=MAX_PRIORITY).contains(&priority) { Ok(()) } else { Err(JobsError::InvalidPriority) }
}

fn size(row: &QueuedRow) -> Size {
    Size { images: row.images as f64, bytes: row.size_bytes as f64 }
}

/// The waiting jobs in the order in which they will start.
async fn ordered_queue(db: &mut SqliteConnection) -> Result<Vec<Waiting>, StoreError> {
    let waiting = jobs::queue(&mut *db, "queued").await?.into_iter().map(|row| Waiting {
        size: size(&row),
        held: Hold::ALL.into_iter().find(|hold| row.held.as_deref() == Some(hold.as_str())),
        id: row.id,
        owner: row.owner_token,
        priority: row.priority,
        seq: row.seq,
    });
    let waiting: Vec<Waiting> = waiting.collect();
    if waiting.is_empty() {
        return Ok(waiting);
    }
    let turns = jobs::turns(&mut *db).await?.into_iter().map(|(owner, running, last_ms)| {
        let turns = Turns { running: usize::try_from(running).unwrap_or(0), last_ms };
        (owner, turns)
    });
    Ok(schedule::order(waiting, &turns.collect()))
}

/// Puts a job that is over into the queue once more, on the photographs that its dataset holds now; what it made is forgotten.
pub(super) async fn queue_again(tx: &mut SqliteConnection, row: &mut JobRow) -> Result<(), JobsError> {
    let id = job_id(row)?;
    let dataset = row.dataset_id.parse().map_err(|_| JobsError::DatasetNotFound)?;
    row.interruptions = 0;
    row.stages_finished = 0;
    row.models = None;
    row.started_ms = None;
    job_images::freeze(tx, id, dataset).await?;
    job_stages::clear(tx, id).await?;
    job_outputs::replace(tx, id, &[]).await?;
    Ok(transition(tx, row, JobState::Queued, None).await?)
}

impl Jobs {
    /// One job.
    ///
    /// # Errors
    /// [`JobsError::JobNotFound`], or what the store said.
    pub async fn find(&self, id: Uuid) -> Result<JobRow, JobsError> {
        jobs::find(self.store.db.reader(), id).await?.ok_or(JobsError::JobNotFound)
    }

    /// Whether a name and options would be taken.
    ///
    /// # Errors
    /// Why not.
    pub fn check(&self, name: &str, options: &serde_json::Value) -> Result<(), JobsError> {
        if name.chars().count() > MAX_NAME_CHARS {
            return Err(JobsError::InvalidName);
        }
        self.engine.validate(options).map_err(JobsError::InvalidOptions)
    }

    /// Queues a new job on the photographs that the dataset holds now.
    ///
    /// # Errors
    /// Why not.
    pub async fn enqueue(&self, new: NewJob) -> Result<JobRow, JobsError> {
        self.check(&new.name, &new.options)?;
        check_priority(new.priority)?;
        let mut tx = self.store.db.write().await?;
        let Some(dataset) = datasets::find(&mut *tx, new.dataset).await? else {
            return Err(JobsError::DatasetNotFound);
        };
        if dataset_images::list(&mut *tx, new.dataset, "", 1).await?.is_empty() {
            return Err(JobsError::NoImages);
        }
        let now = now_ms();
        let row = NewJobRow {
            id: new.id,
            name: if new.name.is_empty() { dataset.name } else { new.name },
            created_ms: now,
            dataset: new.dataset,
            options: new.options.to_string(),
            ignored: new.ignored.map(|n| i64::try_from(n).unwrap_or(i64::MAX)),
            priority: new.priority,
            owner_token: new.owner_token,
        };
        jobs::insert(&mut tx, &row).await?;
        let owner = new.owner_token.map(|token| token.to_string());
        check_quota(&mut tx, owner.as_deref(), &[Quantity::Jobs]).await?;
        if let Some(webhook) = &new.webhook {
            webhooks::insert(&mut tx, &webhook.row(new.id)).await?;
        }
        job_images::freeze(&mut tx, new.id, new.dataset).await?;
        let event = StateEvent { state: JobState::Queued, at: time_text(now), error: None };
        let data = serde_json::to_string(&event).map_err(|error| sqlx::Error::Encode(error.into()))?;
        job_events::append(&mut tx, new.id, "state", &data).await?;
        let row = jobs::find(&mut *tx, new.id).await?.ok_or(JobsError::JobNotFound)?;
        tx.commit().await?;
        self.hub.announce();
        self.hub.wake_executor();
        Ok(row)
    }

    /// The waiting jobs, the next one first.
    pub(super) async fn waiting(&self) -> Result<Vec<Uuid>, StoreError> {
        let mut snapshot = self.store.db.reader().begin().await?;
        let ordered = ordered_queue(&mut snapshot).await?;
        Ok(ordered.iter().filter_map(|job| job.id.parse().ok()).collect())
    }

    /// Takes a job out of the queue and marks it running with what it was given; none when it does not wait any more.
    pub(super) async fn claim(&self, id: Uuid, given: &Given) -> Result<Option<JobRow>, StoreError> {
        let mut tx = self.store.db.write().await?;
        let Some(mut row) = jobs::find(&mut *tx, id).await? else { return Ok(None) };
        if state_of(&row) != JobState::Queued {
            return Ok(None);
        }
        row.held = None;
        row.threads = i64::try_from(given.threads).ok();
        row.memory_bytes = i64::try_from(given.memory_bytes).ok();
        row.needed_bytes = i64::try_from(given.disk_bytes).ok();
        row.resource_note.clone_from(&given.note);
        job_stages::clear(&mut tx, job_id(&row)?).await?;
        transition(&mut tx, &mut row, JobState::Running, None).await?;
        tx.commit().await?;
        self.hub.announce();
        Ok(Some(row))
    }

    /// Notes what a waiting job waits for besides its turn.
    pub(super) async fn hold(&self, id: Uuid, hold: Hold) -> Result<(), StoreError> {
        let mut tx = self.store.db.write().await?;
        let Some(mut row) = jobs::find(&mut *tx, id).await? else { return Ok(()) };
        if state_of(&row) == JobState::Queued && row.held.as_deref() != Some(hold.as_str()) {
            tracing::warn!(job = %id, waits_for = hold.as_str(), "a job can't start yet");
            row.held = Some(hold.as_str().to_owned());
            jobs::update_state(&mut tx, &row).await?;
            tx.commit().await?;
            self.hub.announce();
        }
        Ok(())
    }

    /// Whether something that makes room may be tried once more: the disk is so full that not even that could be
    /// written down, and the ballast was there to be given up.
    pub(super) fn made_room(&self, error: &JobsError) -> bool {
        matches!(error, JobsError::Store(error) if error.is_disk_full()) && self.store.drop_ballast()
    }

    /// Where every waiting job stands, by its id, when `lanes` jobs run at once.
    ///
    /// # Errors
    /// What the store said.
    pub async fn places(&self, lanes: usize) -> Result<BTreeMap<String, QueuePlace>, StoreError> {
        let mut snapshot = self.store.db.reader().begin().await?;
        let ordered = ordered_queue(&mut snapshot).await?;
        if ordered.is_empty() {
            return Ok(BTreeMap::new());
        }
        let now = now_ms();
        let mut rates = Rates::default();
        for run in jobs::latest_whole_runs(&mut *snapshot, RATED_RUNS).await? {
            let seconds = run.finished_ms.zip(run.started_ms).map_or(0, |(end, start)| end - start) as f64 / 1000.0;
            rates.add(size(&run), Eta { low: seconds, high: seconds });
        }
        let mut running = Vec::new();
        for run in jobs::queue(&mut *snapshot, "running").await? {
            let id = run.id.parse().map_err(|_| StoreError::NotFound)?;
            let stages = job_stages::list(&mut *snapshot, id).await?;
            let left = estimate(&stages, now);
            let spent_s = run.started_ms.map_or(0, |start| (now - start).max(0)) as f64 / 1000.0;
            if let Some(left) = left
                && stages.iter().all(|stage| stage.state != "reused")
            {
                rates.add(size(&run), left.plus(Eta { low: spent_s, high: spent_s }));
            }
            // Until it tells itself, as for those that wait.
            let forecast = || {
                let all = rates.forecast(size(&run))?;
                Some(Eta { low: (all.low - spent_s).max(0.0), high: (all.high - spent_s).max(0.0) })
            };
            running.push(left.or_else(forecast));
        }
        let places = schedule::places(&ordered, lanes, &running, &rates);
        Ok(ordered.into_iter().map(|job| job.id).zip(places).collect())
    }

    /// Moves a waiting job forward or back.
    ///
    /// # Errors
    /// [`JobsError::NotQueued`] in any other state.
    pub async fn set_priority(&self, id: Uuid, priority: i64) -> Result<JobRow, JobsError> {
        check_priority(priority)?;
        let mut tx = self.store.db.write().await?;
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        let state = state_of(&row);
        if state != JobState::Queued {
            return Err(JobsError::NotQueued(state));
        }
        row.priority = priority;
        jobs::update_state(&mut tx, &row).await?;
        tx.commit().await?;
        self.hub.announce();
        Ok(row)
    }

    /// Stops a queued job at once, asks a running one to stop; no error for one that is cancelled.
    ///
    /// # Errors
    /// [`JobsError::NotActive`] for a job that succeeded or failed.
    pub async fn cancel(&self, id: Uuid) -> Result<JobRow, JobsError> {
        match self.try_cancel(id).await {
            Err(error) if self.made_room(&error) => self.try_cancel(id).await,
            other => other,
        }
    }

    async fn try_cancel(&self, id: Uuid) -> Result<JobRow, JobsError> {
        let mut tx = self.store.db.write().await?;
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        match state_of(&row) {
            JobState::Queued => transition(&mut tx, &mut row, JobState::Cancelled, None).await?,
            JobState::Running => {
                row.cancel_requested = true;
                jobs::update_state(&mut tx, &row).await?;
            }
            JobState::Cancelled => {}
            over => return Err(JobsError::NotActive(over)),
        }
        tx.commit().await?;
        self.hub.cancel(id);
        self.hub.announce();
        Ok(row)
    }

    /// Queues a failed or cancelled job again; finished stages are re-used.
    ///
    /// # Errors
    /// [`JobsError::NotResumable`] in any other state.
    pub async fn resume(&self, id: Uuid) -> Result<JobRow, JobsError> {
        let mut tx = self.store.db.write().await?;
        let mut row = jobs::find(&mut *tx, id).await?.ok_or(JobsError::JobNotFound)?;
        match state_of(&row) {
            JobState::Failed | JobState::Cancelled => {}
            other => return Err(JobsError::NotResumable(other)),
        }
        queue_again(&mut tx, &mut row).await?;
        tx.commit().await?;
        self.hub.announce();
        self.hub.wake_executor();
        Ok(row)
    }
}
