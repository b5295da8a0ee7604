//! What the executor runs: the pipeline in the service, something quick in tests.

use std::path::PathBuf;

use crate::formats::report::Report;
use crate::pipeline::{Context, PipelineError};

/// The folders of a run.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RunPaths {
    /// Photographs; read only.
    pub images_dir: PathBuf,
    /// Takes the outputs; empty at the start.
    pub out_dir: PathBuf,
    /// Keeps what an interrupted run goes on from.
    pub work_dir: PathBuf,
}

/// Makes models out of photographs. Called from a thread of the job's own; may take hours and may panic.
pub trait Engine: Send + Sync + 'static {
    /// Whether the options can be used.
    ///
    /// # Errors
    /// Every violation, as sentences.
    fn validate(&self, options: &serde_json::Value) -> Result<(), Vec<String>>;

    /// Runs to the end. That no model could be made is no error: the report then lists none.
    ///
    /// # Errors
    /// Why there is no report.
    fn run(&self, paths: &RunPaths, options: &serde_json::Value, context: &Context) -> Result<Report, PipelineError>;
}
