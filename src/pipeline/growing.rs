//! The units of work of `coarse_model`: models as they stand while they grow.

use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::PipelineError;
use super::units::Units;
use crate::coarse::{Checkpoint, Checkpoints};

/// A model is kept once growing has taken so many times what keeping it took last, so that keeping costs 2 % at most,
/// however large the model and slow the disk.
const WORK_PER_KEEPING: u32 = 50;

/// Keeps the models of one `coarse_model`, each as it stood last.
pub struct GrowingModels<'a> {
    units: Units<'a>,
    begun: AtomicUsize,
    state: Mutex<State>,
}

struct State {
    kept_at: Instant,
    keeping_took: Duration,
    images_reused: usize,
    failure: Option<PipelineError>,
}

impl<'a> GrowingModels<'a> {
    /// Keeps them among `units`.
    pub fn new(units: Units<'a>) -> Self {
        let state = State { kept_at: Instant::now(), keeping_took: Duration::ZERO, images_reused: 0, failure: None };
        Self { units, begun: AtomicUsize::new(0), state: Mutex::new(state) }
    }

    /// Whether something could not be read or kept; going on would be in vain.
    pub fn has_failed(&self) -> bool {
        self.state().failure.is_some()
    }

    /// The number of images of models taken up from an earlier run.
    ///
    /// # Errors
    /// What could not be read or kept.
    pub fn finish(self) -> Result<usize, PipelineError> {
        let state = self.state.into_inner().unwrap_or_else(std::sync::PoisonError::into_inner);
        state.failure.map_or(Ok(state.images_reused), Err)
    }

    fn state(&self) -> std::sync::MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(std::sync::PoisonError::into_inner)
    }
}

impl Checkpoints for GrowingModels<'_> {
    fn begin(&self) -> Option<Checkpoint<'static>> {
        let number = self.begun.fetch_add(1, Ordering::Relaxed) + 1;
        let known = self.units.known::<Checkpoint<'static>>(&number);
        let mut state = self.state();
        match known {
            Ok(known) => {
                state.images_reused += known.as_ref().map_or(0, Checkpoint::num_images);
                known
            }
            Err(error) => {
                state.failure.get_or_insert(error);
                None
            }
        }
    }

    fn keep(&self, checkpoint: &Checkpoint<'_>) {
        let mut state = self.state();
        if state.kept_at.elapsed() < WORK_PER_KEEPING * state.keeping_took {
            return;
        }
        let begun = Instant::now();
        if let Err(error) = self.units.keep(&self.begun.load(Ordering::Relaxed), checkpoint) {
            state.failure.get_or_insert(error);
        }
        state.keeping_took = begun.elapsed();
        state.kept_at = Instant::now();
    }
}
