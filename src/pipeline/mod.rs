//! The runner: order of the stages, units of work, options, progress, resume and the report.

mod add_points;
mod coarse;
mod coarse_match;
mod colors;
mod context;
mod error;
mod export;
mod features;
mod focals;
mod growing;
mod intake;
mod localise;
mod masks;
mod measure;
mod needs;
mod options;
mod ready_features;
mod refine;
mod report;
mod run;
mod runner;
mod stage;
mod state;
mod units;
mod verdict;

pub use context::{CancelFlag, Context, NoProgress, ProgressEvent, ProgressSink};
pub use error::PipelineError;
pub use needs::{Needs, estimate};
pub use options::{CoarseOptions, IntakeOptions, KnownCamera, ReconstructionOptions, RefineOptions};
pub use run::{RunPaths, reconstruct};
pub use stage::{Stage, StageKey};
