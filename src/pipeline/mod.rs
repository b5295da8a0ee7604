//! The runner: order of the stages, units of work, options, progress, resume and the report.

mod context;
mod error;
mod stage;

pub use context::{CancelFlag, Context, NoProgress, ProgressEvent, ProgressSink};
pub use error::PipelineError;
pub use stage::{Stage, StageKey};
