//! What the jobs of this process took, for the figures of the service.

use std::collections::BTreeMap;
use std::sync::{Mutex, MutexGuard, PoisonError};

use super::JobState;
use crate::formats::report::Report;

/// Sums since the process started.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Sums {
    /// By stage: how often it ran, and its wall-clock and CPU seconds; what was re-used does not count.
    pub stages: BTreeMap<String, StageSums>,
    /// Stages whose results were re-used.
    pub stages_reused: u64,
    /// Runs by the state they ended in.
    pub ended: BTreeMap<&'static str, u64>,
    /// Failed runs by their error.
    pub failed: BTreeMap<String, u64>,
    /// Photographs of runs that made a report.
    pub images: u64,
    /// Wall-clock seconds of those runs.
    pub seconds: f64,
}

/// Of one stage.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct StageSums {
    /// How often it ran.
    pub runs: u64,
    /// Wall-clock seconds.
    pub wall_s: f64,
    /// CPU seconds.
    pub cpu_s: f64,
}

/// The sums, shared between those who add and those who read.
#[derive(Debug, Default)]
pub struct Figures(Mutex<Sums>);

impl Figures {
    fn lock(&self) -> MutexGuard<'_, Sums> {
        // A panic elsewhere can't leave the sums half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// The sums now.
    pub fn sums(&self) -> Sums {
        self.lock().clone()
    }

    /// A run made a report.
    pub(super) fn reported(&self, report: &Report) {
        let mut sums = self.lock();
        sums.images += report.images.len() as u64;
        sums.seconds += report.wall_s;
        for stage in &report.stages {
            if stage.reused {
                sums.stages_reused += 1;
                continue;
            }
            let of_stage = sums.stages.entry(stage.name.clone()).or_default();
            of_stage.runs += 1;
            of_stage.wall_s += stage.wall_s;
            of_stage.cpu_s += stage.cpu_s;
        }
    }

    /// A run ended.
    pub(super) fn ended(&self, state: JobState, error: Option<&str>) {
        let mut sums = self.lock();
        *sums.ended.entry(state.as_str()).or_default() += 1;
        if let Some(error) = error {
            *sums.failed.entry(error.to_owned()).or_default() += 1;
        }
    }
}
