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

use tokio::sync::{Mutex, oneshot, watch};
use tokio::task::spawn_blocking;
use tokio_util::sync::CancellationToken;
use tracing::Instrument;
use uuid::Uuid;

use super::ending::Outcome;
use super::progress::{Progress, Recorder, WRITE_INTERVAL, WatchSink};
use super::queue::{Given, job_id};
use super::view::ErrorView;
use super::{Fit, Hold, JobState, Jobs, Machine, fit};
use crate::formats::report::Report;
use crate::pipeline::{Context, Needs, PipelineError, RunPaths};
use crate::store::db::jobs::JobRow;
use crate::store::db::{job_images, jobs};
use crate::store::{DataDir, StoreError, atomic};

/// The idle executor looks into the queue so often even if nobody wakes it.
const IDLE_POLL: Duration = Duration::from_secs(5);
/// Between attempts to store a job's end while the database refuses, for instance because the disk is full.
pub(super) const STORE_RETRY: Duration = Duration::from_secs(2);
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

    /// Compares the dataset's folder with the job's list: a file without a row was never acknowledged and goes; a row
    /// without its file ends the job.
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
}

type EngineResult = Result<Result<Report, PipelineError>, Box<dyn Any + Send>>;

fn panic_message(panic: &(dyn Any + Send)) -> &str {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("no message")
}
