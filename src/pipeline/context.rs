//! What every stage is given besides its input: seed, threads, the cancel flag and a place to tell progress.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use super::{PipelineError, StageKey};

/// Asks a run to stop; shared with whoever may ask.
#[derive(Clone, Debug, Default)]
pub struct CancelFlag(Arc<AtomicBool>);

impl CancelFlag {
    /// Asks the run to stop at the next unit of work.
    pub fn cancel(&self) {
        self.0.store(true, Ordering::Relaxed);
    }

    /// Whether somebody asked.
    pub fn is_cancelled(&self) -> bool {
        self.0.load(Ordering::Relaxed)
    }
}

/// What a run tells while it goes on.
#[derive(Clone, Debug, PartialEq)]
pub enum ProgressEvent {
    /// The stages this run will go through, in order; sent once, first (later additions are announced by their start).
    Plan(Vec<StageKey>),
    /// A stage began, with this many units of work (0 when not known).
    StageStarted {
        /// Which.
        stage: StageKey,
        /// Units of work.
        total: u64,
    },
    /// Units of work were done.
    StageProgress {
        /// Which.
        stage: StageKey,
        /// Units done.
        done: u64,
        /// Units in all.
        total: u64,
    },
    /// A stage ended.
    StageFinished {
        /// Which.
        stage: StageKey,
        /// Whether its result was re-used from an earlier, interrupted run.
        reused: bool,
        /// Wall-clock seconds.
        wall_s: f64,
        /// CPU seconds.
        cpu_s: f64,
        /// Named counts.
        counts: BTreeMap<String, f64>,
    },
}

/// Hears of progress; called from worker threads, so it must be quick.
pub trait ProgressSink: Send + Sync {
    /// Takes one event.
    fn report(&self, event: ProgressEvent);
}

/// Hears nothing.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoProgress;

impl ProgressSink for NoProgress {
    fn report(&self, _: ProgressEvent) {}
}

/// What a run is given besides its input and options.
#[derive(Clone)]
pub struct Context {
    /// All randomness derives from it.
    pub seed: u64,
    /// Worker threads; the result does not depend on it.
    pub threads: usize,
    /// Asked at every unit of work.
    pub cancel: CancelFlag,
    /// Told of progress.
    pub progress: Arc<dyn ProgressSink>,
}

impl Context {
    /// Fails once somebody asked to stop.
    ///
    /// # Errors
    /// [`PipelineError::Cancelled`].
    pub fn check_cancelled(&self) -> Result<(), PipelineError> {
        if self.cancel.is_cancelled() { Err(PipelineError::Cancelled) } else { Ok(()) }
    }
}
