//! Runs stages: re-uses the result of an earlier run with the same inputs, measures, tells progress, keeps the account.
//!
//! A stage's result is stored under the hash of everything that decides it: the key of the stage before, the options it
//! reads, the seed. So a run that was stopped at any moment goes on from its last finished stage (and within it from
//! its finished [units of work](super::units)), and one with other options re-does only what they touch.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Mutex;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::measure::Stopwatch;
use super::units::Units;
use super::{Context, PipelineError, ProgressEvent, Stage, StageKey};
use crate::formats::report::StageReport;
use crate::store::ArtifactStore;

/// Named counts of a stage.
pub type Counts = BTreeMap<String, f64>;

/// Changes whenever stored stage results of an earlier build must not be re-used.
const FORMAT_VERSION: u32 = 10;

/// The key a stage's result is stored under.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ArtifactKey(pub String);

impl ArtifactKey {
    /// The key of what `parts` decide, for a stage with this name.
    pub fn of(name: &str, parts: &[&dyn erased::Part]) -> Self {
        let mut hasher = blake3::Hasher::new();
        hasher.update(&FORMAT_VERSION.to_le_bytes());
        hasher.update(name.as_bytes());
        for part in parts {
            let bytes = part.bytes();
            hasher.update(&(bytes.len() as u64).to_le_bytes());
            hasher.update(&bytes);
        }
        Self(format!("{name}-{}", hasher.finalize().to_hex()))
    }
}

/// Parts of a key.
pub mod erased {
    use serde::Serialize;

    /// Anything serialisable can decide a stage's result.
    pub trait Part {
        /// Its canonical bytes.
        fn bytes(&self) -> Vec<u8>;
    }

    impl<T: Serialize> Part for T {
        fn bytes(&self) -> Vec<u8> {
            serde_json::to_vec(self).expect("options and keys serialise")
        }
    }
}

/// Units done within a stage, told at most every per cent.
pub struct StageProgress<'a> {
    context: &'a Context,
    stage: StageKey,
    total: u64,
    state: Mutex<(u64, u64)>,
}

impl StageProgress<'_> {
    /// One more unit is done.
    pub fn tick(&self) {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        state.0 += 1;
        let done = state.0;
        self.tell(&mut state, done, self.total);
    }

    /// `done` of `total` units are done.
    pub fn set(&self, done: u64, total: u64) {
        let mut state = self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        self.tell(&mut state, done, total);
    }

    fn tell(&self, state: &mut (u64, u64), done: u64, total: u64) {
        let percent = (100 * done.min(total)).checked_div(total).map_or(0, |percent| 1 + percent);
        if percent != state.1 || done >= total {
            state.1 = percent;
            self.context.progress.report(ProgressEvent::StageProgress { stage: self.stage, done, total });
        }
    }
}

/// Runs stages one after another.
pub struct Runner<'a> {
    /// Seed, threads, cancel, progress.
    pub context: &'a Context,
    /// Where results are kept.
    pub store: ArtifactStore,
    /// The account so far.
    pub stages: Vec<StageReport>,
}

impl<'a> Runner<'a> {
    /// A runner that keeps its results in `work_dir`.
    ///
    /// # Errors
    /// When the folder can't be made.
    pub fn new(work_dir: &Path, context: &'a Context) -> Result<Self, PipelineError> {
        let store = ArtifactStore::open(work_dir).map_err(|source| io_error(Stage::Intake, work_dir, source))?;
        Ok(Self { context, store, stages: Vec::new() })
    }

    fn stored<T: DeserializeOwned>(
        &self,
        stage: StageKey,
        key: Option<&ArtifactKey>,
    ) -> Result<Option<T>, PipelineError> {
        let Some(key) = key else { return Ok(None) };
        let bytes = self.store.get(&key.0).map_err(|source| io_error(stage.stage, Path::new(&key.0), source))?;
        Ok(bytes.and_then(|bytes| postcard::from_bytes(&bytes).ok()))
    }

    /// Runs a stage, or takes its stored result. `work` returns the result and its counts.
    ///
    /// # Errors
    /// Those of `work`, cancellation, or a result that can't be stored.
    pub fn stage<T: Serialize + DeserializeOwned>(
        &mut self,
        stage: StageKey,
        key: Option<&ArtifactKey>,
        total: u64,
        work: impl FnOnce(&ArtifactStore, &StageProgress<'_>) -> Result<(T, Counts), PipelineError>,
    ) -> Result<T, PipelineError> {
        self.context.check_cancelled()?;
        let watch = Stopwatch::start();
        self.context.progress.report(ProgressEvent::StageStarted { stage, total });
        let stored: Option<(T, Counts)> = self.stored(stage, key)?;
        let reused = stored.is_some();
        let (result, counts) = match stored {
            Some(stored) => stored,
            None => {
                let progress = StageProgress { context: self.context, stage, total, state: Mutex::new((0, 0)) };
                let outcome = work(&self.store, &progress)?;
                if let Some(key) = key {
                    let bytes = to_bytes(&outcome);
                    self.store
                        .put(&key.0, &bytes)
                        .map_err(|source| io_error(stage.stage, Path::new(&key.0), source))?;
                }
                outcome
            }
        };
        if let Some(key) = key {
            // Also of a stage whose result a run stored just before it was stopped.
            Units::new(&self.store, stage.stage, key).clear()?;
        }
        let (wall_s, cpu_s) = (watch.wall_s(), watch.cpu_s());
        self.context.progress.report(ProgressEvent::StageFinished {
            stage,
            reused,
            wall_s,
            cpu_s,
            counts: counts.clone(),
        });
        self.stages.push(StageReport {
            name: stage.stage.name().to_owned(),
            iteration: stage.iteration,
            wall_s,
            cpu_s,
            reused,
            counts,
        });
        Ok(result)
    }
}

/// The bytes of a stage's result or of a unit of its work, in a block of just their size: a block that grows takes
/// twice as much for models of tens of megabytes.
pub(super) fn to_bytes<T: Serialize + ?Sized>(value: &T) -> Vec<u8> {
    let size = postcard::serialize_with_flavor(value, postcard::ser_flavors::Size::default());
    let bytes = Vec::with_capacity(size.expect("plain data serialises"));
    postcard::to_extend(value, bytes).expect("plain data serialises")
}

/// The I/O error of a path during a stage.
pub fn io_error(stage: Stage, path: &Path, source: std::io::Error) -> PipelineError {
    PipelineError::Io { stage, path: path.to_owned(), source }
}

/// Counts from pairs of name and number.
pub fn counts<const N: usize>(pairs: [(&str, usize); N]) -> Counts {
    pairs.into_iter().map(|(name, count)| (name.to_owned(), count as f64)).collect()
}
