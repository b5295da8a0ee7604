//! The executor: takes jobs out of the queue and runs each to its end on a thread of its own.
//!
//! One [`tick`](Executor::tick):
//! 1. claim the first waiting job that fits into memory and disk; none: [`Tick::Idle`];
//! 2. check that its photographs are the ones it was queued with;
//! 3. run the engine on a fresh thread, a panic caught, while progress goes into the database;
//! 4. publish the outputs, then commit verdicts, models and the final state in one transaction.
//!
//! A crash at any moment leaves the job `running`; the next start queues it again, and the engine goes on from its artifacts.

use std::any::Any;
use std::collections::{BTreeMap, HashMap};
use std::io;
use std::panic::AssertUnwindSafe;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use sqlx::SqliteConnection;
use tokio::sync::{Mutex, oneshot, watch};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;
use uuid::Uuid;

use super::progress::{Progress, Recorder, WRITE_INTERVAL, WatchSink};
use super::queue::{Given, job_id, transition};
use super::view::ErrorView;
use super::{Fit, Hold, JobState, Jobs, Machine, fit, publish};
use crate::formats::report::Report;
use crate::pipeline::{Context, Needs, PipelineError, RunPaths};
use crate::store::db::job_outputs::JobOutputRow;
use crate::store::db::jobs::JobRow;
use crate::store::db::{job_images, job_outputs, job_stages, jobs};
use crate::store::{DataDir, StoreError, atomic};

/// The idle executor looks into the queue so often even if nobody wakes it.
const IDLE_POLL: Duration = Duration::from_secs(5);
/// Between attempts to store a job's end while the database refuses, for instance because the disk is full.
const STORE_RETRY: Duration = Duration::from_secs(2);
/// A job may fill the disk so often in a row without a further stage coming to its end.
const MAX_DISK_FULL: i64 = 3;
/// Stack of a job's thread; the engine's recursion is shallow, but matrices on the stack are not.
const STACK_BYTES: usize = 16 << 20;

/// What one tick did.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tick {
    /// The queue is empty.
    Idle,
    /// A job ran and is now in this state.
    Ran(Uuid, JobState),
}

/// Runs jobs.
#[derive(Clone)]
pub struct Executor {
    /// Which.
    pub jobs: Jobs,
    /// What there is for them.
    pub machine: Machine,
    /// Seed of every run.
    pub seed: u64,
    /// Held while a job is chosen, so that no two take the same room.
    desk: Arc<Mutex<Desk>>,
}

/// What choosing needs to know.
#[derive(Default)]
struct Desk {
    /// The running jobs: their datasets and their memory.
    running: HashMap<Uuid, (Uuid, u64)>,
    /// Estimates of the waiting ones.
    needs: HashMap<Uuid, Needs>,
}

/// What becomes of a job that was claimed.
#[derive(Debug)]
enum Choice {
    /// It runs.
    Run { threads: usize },
    /// It never fits; why.
    Refuse(String),
}

/// How a run ended.
enum Outcome {
    Report(Box<Report>),
    Cancelled,
    Failed(ErrorView),
}

impl Executor {
    /// An executor of these jobs on this machine.
    pub fn new(jobs: Jobs, machine: Machine, seed: u64) -> Self {
        Self { jobs, machine, seed, desk: Arc::default() }
    }

    /// Runs jobs, `parallel` at once, until `shutdown`; returns once the running ones stopped.
    pub async fn run(self, parallel: usize, shutdown: CancellationToken) {
        let lanes: Vec<_> = (0..parallel.max(1))
            .map(|_| {
                let (executor, shutdown) = (self.clone(), shutdown.clone());
                tokio::spawn(async move { executor.lane(&shutdown).await })
            })
            .collect();
        shutdown.cancelled().await;
        self.jobs.hub.stop();
        for lane in lanes {
            if let Err(error) = lane.await {
                tracing::error!(%error, "an executor lane panicked");
            }
        }
    }

    async fn lane(&self, shutdown: &CancellationToken) {
        while !shutdown.is_cancelled() {
            let pause = match self.tick().await {
                // It goes on once there is room; not at once.
                Ok(Tick::Ran(_, JobState::Queued)) => STORE_RETRY,
                Ok(Tick::Ran(..)) => continue,
                Ok(Tick::Idle) => IDLE_POLL,
                Err(error) => {
                    tracing::error!(%error, "the queue can't be read");
                    STORE_RETRY
                }
            };
            tokio::select! {
                () = self.jobs.hub.woken() => {}
                () = tokio::time::sleep(pause) => {}
                () = shutdown.cancelled() => {}
            }
        }
    }

    /// Runs the next job, if there is one, to its end.
    ///
    /// # Errors
    /// When the queue can't be read.
    pub async fn tick(&self) -> Result<Tick, StoreError> {
        let Some((row, choice)) = self.next().await? else { return Ok(Tick::Idle) };
        let id = job_id(&row)?;
        self.run_claimed(id, row, choice).instrument(tracing::info_span!("job", %id)).await
    }

    /// Runs a claimed job to its end.
    async fn run_claimed(&self, id: Uuid, row: JobRow, choice: Choice) -> Result<Tick, StoreError> {
        tracing::info!(?choice, "job started");
        let outcome = match choice {
            Choice::Refuse(message) => {
                Outcome::Failed(ErrorView { stage: None, code: "not_enough_memory".to_owned(), message })
            }
            Choice::Run { threads } => match self.check_input(&row).await {
                Ok(()) => self.run_engine(id, &row, threads).await,
                Err(error) => Outcome::Failed(error),
            },
        };
        self.jobs.hub.ended(id);
        if let Outcome::Report(report) = &outcome {
            self.jobs.figures.reported(report);
        }
        let state = self.finish(id, outcome).await;
        self.desk.lock().await.running.remove(&id);
        self.jobs.store.release_space(id);
        if state != JobState::Queued {
            // Another may have waited for what it had.
            self.jobs.hub.wake_executor();
        }
        tracing::info!(%state, "job ended");
        Ok(Tick::Ran(id, state))
    }

    /// Claims the first waiting job that fits.
    async fn next(&self) -> Result<Option<(JobRow, Choice)>, StoreError> {
        let store = &self.jobs.store;
        let mut desk = self.desk.lock().await;
        let waiting = self.jobs.waiting().await?;
        desk.needs.retain(|job, _| waiting.contains(job));
        for id in waiting {
            let Some(row) = jobs::find(store.db.reader(), id).await? else { continue };
            let dataset: Uuid = row.dataset_id.parse().map_err(|_| StoreError::NotFound)?;
            // Two runs on the same photographs would do the same work twice at once; the second goes on from the first.
            if desk.running.values().any(|(other, _)| *other == dataset) {
                continue;
            }
            let mut needs = match desk.needs.get(&id) {
                Some(needs) => *needs,
                None => self.estimate(id, &row).await?,
            };
            desk.needs.insert(id, needs);
            // A run that filled the disk needs more than was thought.
            needs.disk_bytes = needs.disk_bytes.max(row.needed_bytes.and_then(|n| u64::try_from(n).ok()).unwrap_or(0));
            let taken = desk.running.values().map(|(_, memory)| memory).sum();
            let folders = vec![store.data.job(id), store.data.work(dataset)];
            let look = folders.clone();
            let written = spawn_blocking(move || look.iter().map(|folder| DataDir::folder_bytes(folder)).sum());
            let written: u64 = written.await.map_err(io::Error::other).and_then(|sum: io::Result<u64>| sum)?;
            let mut fits = fit(&needs, &self.machine, taken, store.free_bytes().await?, written);
            if fits == Fit::Wait(Hold::DiskFull) && store.drop_idle_work().await? {
                fits = fit(&needs, &self.machine, taken, store.free_bytes().await?, written);
            }
            let (choice, given) = match fits {
                Fit::Wait(hold) => {
                    self.jobs.hold(id, hold).await?;
                    continue;
                }
                Fit::Never(why) => (Choice::Refuse(why), Given::default()),
                Fit::Start { threads, note } => {
                    let memory_bytes = needs.memory_bytes(threads);
                    let given = Given { threads, note, memory_bytes, disk_bytes: needs.disk_bytes };
                    (Choice::Run { threads }, given)
                }
            };
            let Some(row) = self.jobs.claim(id, &given).await? else { continue };
            desk.running.insert(id, (dataset, given.memory_bytes));
            store.reserve_space(id, folders, given.disk_bytes.saturating_sub(written));
            return Ok(Some((row, choice)));
        }
        Ok(None)
    }

    /// What a job will take. Nothing where that can't be said: the run then tells what is wrong.
    async fn estimate(&self, id: Uuid, row: &JobRow) -> Result<Needs, StoreError> {
        let store = &self.jobs.store;
        let folder = store.data.images(row.dataset_id.parse().map_err(|_| StoreError::NotFound)?);
        let images = job_images::list(store.db.reader(), id, None, -1, u32::MAX).await?;
        let images: Vec<PathBuf> = images.into_iter().map(|image| folder.join(image.path)).collect();
        let options = serde_json::from_str(&row.options).unwrap_or_default();
        let engine = Arc::clone(&self.jobs.engine);
        let needs = spawn_blocking(move || engine.needs(&images, &options)).await.map_err(io::Error::other)?;
        Ok(needs.unwrap_or_else(|error| {
            tracing::warn!(job = %id, %error, "what a job needs can't be estimated");
            Needs::default()
        }))
    }

    /// Compares the dataset's folder with the job's list: a file without a row was never acknowledged and goes; a row without its
    /// file ends the job.
    async fn check_input(&self, row: &JobRow) -> Result<(), ErrorView> {
        let failed = |message: String| ErrorView { stage: None, code: "input_missing".to_owned(), message };
        let check = async {
            let (job, dataset) = (job_id(row)?, row.dataset_id.parse::<Uuid>().map_err(|_| StoreError::NotFound)?);
            let images = job_images::list(self.jobs.store.db.reader(), job, None, -1, u32::MAX).await?;
            let mut expected: BTreeMap<String, i64> =
                images.into_iter().map(|image| (image.path, image.size_bytes)).collect();
            let folder = self.jobs.store.data.images(dataset);
            let check = move || -> Result<Option<String>, StoreError> {
                for path in atomic::list_files(&folder)? {
                    let file = folder.join(&path);
                    match expected.remove(&path) {
                        Some(size) if i64::try_from(file.metadata()?.len()) == Ok(size) => {}
                        Some(_) => return Ok(Some(path)),
                        None => std::fs::remove_file(file)?,
                    }
                }
                Ok(expected.into_keys().next())
            };
            tokio::task::spawn_blocking(check).await.map_err(std::io::Error::other)?
        };
        match check.await {
            Ok(None) => Ok(()),
            Ok(Some(path)) => Err(failed(format!("the photograph {path:?} is missing or damaged in the store"))),
            Err(error) => Err(failed(error.to_string())),
        }
    }

    async fn run_engine(&self, id: Uuid, row: &JobRow, threads: usize) -> Outcome {
        let hub = &self.jobs.hub;
        let cancel = hub.started(id);
        // Somebody may have asked between the claim and the flag's birth.
        if let Ok(Some(now)) = jobs::find(self.jobs.store.db.reader(), id).await
            && now.cancel_requested
        {
            cancel.cancel();
        }
        let (progress_in, mut progress) = watch::channel(Progress::default());
        let context = Context { seed: self.seed, threads, cancel, progress: Arc::new(WatchSink(progress_in)) };
        let mut finished = match self.spawn(id, row, context) {
            Ok(finished) => finished,
            Err(error) => {
                let message = format!("the job could not be started: {error}");
                let code = match &error {
                    full if full.is_disk_full() => "disk_full",
                    broken if broken.is_disk_error() => "disk_error",
                    _ => "io_error",
                };
                return Outcome::Failed(ErrorView { stage: None, code: code.to_owned(), message });
            }
        };
        let mut recorder = Recorder::new(id);
        let mut telling = true;
        let result = loop {
            tokio::select! {
                result = &mut finished => break result,
                changed = progress.changed(), if telling => telling = changed.is_ok(),
            }
            let now = progress.borrow_and_update().clone();
            if let Err(error) = recorder.write(&self.jobs.store.db, hub, now).await {
                tracing::warn!(job = %id, %error, "progress could not be stored");
            }
            if let Ok(result) = tokio::time::timeout(WRITE_INTERVAL, &mut finished).await {
                break result;
            }
        };
        let last = progress.borrow().clone();
        let stage = last.current();
        if let Err(error) = recorder.write(&self.jobs.store.db, hub, last).await {
            tracing::warn!(job = %id, %error, "progress could not be stored");
        }
        match result {
            Ok(Ok(Ok(report))) => Outcome::Report(Box::new(report)),
            Ok(Ok(Err(PipelineError::Cancelled))) => Outcome::Cancelled,
            Ok(Ok(Err(error))) => {
                Outcome::Failed(ErrorView { stage, code: error.code().to_owned(), message: error.to_string() })
            }
            Ok(Err(panic)) => {
                let message = format!("the engine panicked: {}", panic_message(&*panic));
                Outcome::Failed(ErrorView { stage, code: "panic".to_owned(), message })
            }
            Err(_) => {
                let message = "the job's thread ended without a word".to_owned();
                Outcome::Failed(ErrorView { stage, code: "internal_error".to_owned(), message })
            }
        }
    }

    /// Starts the engine on a thread of its own.
    fn spawn(&self, id: Uuid, row: &JobRow, context: Context) -> Result<oneshot::Receiver<EngineResult>, StoreError> {
        let data = &self.jobs.store.data;
        let dataset = row.dataset_id.parse().map_err(|_| StoreError::NotFound)?;
        let paths =
            RunPaths { images_dir: data.images(dataset), out_dir: data.partial(id), work_dir: data.work(dataset) };
        std::fs::create_dir_all(&paths.work_dir)?;
        atomic::empty_dir(&paths.out_dir)?;
        let options = serde_json::from_str(&row.options).unwrap_or_default();
        let engine = Arc::clone(&self.jobs.engine);
        let (sender, receiver) = oneshot::channel();
        let span = tracing::Span::current();
        std::thread::Builder::new().name(format!("job-{id}")).stack_size(STACK_BYTES).spawn(move || {
            let _entered = span.entered();
            let run = AssertUnwindSafe(|| engine.run(&paths, &options, &context));
            let result = std::panic::catch_unwind(run);
            drop(context);
            // Nobody listens any more only when the process ends.
            let _ = sender.send(result);
        })?;
        Ok(receiver)
    }

    /// Stores how a job ended, again and again until the store takes it or the process ends.
    async fn finish(&self, id: Uuid, outcome: Outcome) -> JobState {
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

type EngineResult = Result<Result<Report, PipelineError>, Box<dyn Any + Send>>;

fn no_model(report: &Report) -> ErrorView {
    let examined = report.images.len();
    let message = format!(
        "no model could be made of the {examined} photographs; the report says for each what happened and what may help"
    );
    let stage = report.stages.iter().map(|stage| stage.name.as_str()).find(|name| *name == "coarse_model");
    ErrorView { stage: stage.map(str::to_owned), code: "no_model".to_owned(), message }
}

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
