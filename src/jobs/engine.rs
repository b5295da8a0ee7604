//! What the executor runs: the pipeline in the service, something quick in tests.

use std::path::PathBuf;

use crate::formats::report::Report;
use crate::pipeline::{Context, Needs, PipelineError, ReconstructionOptions, RunPaths, Stage, estimate, reconstruct};

/// Makes models out of photographs. Called from a thread of the job's own; may take hours and may panic.
pub trait Engine: Send + Sync + 'static {
    /// Whether the options can be used.
    ///
    /// # Errors
    /// Every violation, as sentences.
    fn validate(&self, options: &serde_json::Value) -> Result<(), Vec<String>>;

    /// What a run on these photographs will take.
    ///
    /// # Errors
    /// Why that can't be said.
    fn needs(&self, images: &[PathBuf], options: &serde_json::Value) -> Result<Needs, PipelineError>;

    /// Runs to the end. That no model could be made is no error: the report then lists none.
    ///
    /// # Errors
    /// Why there is no report.
    fn run(&self, paths: &RunPaths, options: &serde_json::Value, context: &Context) -> Result<Report, PipelineError>;
}

/// The pipeline.
#[derive(Clone, Copy, Debug, Default)]
pub struct PipelineEngine;

fn parse(options: &serde_json::Value) -> Result<ReconstructionOptions, PipelineError> {
    // The path names the field: of `{"coarse": {"mapper": 3}}` it says `coarse.mapper: invalid type`.
    let options: ReconstructionOptions = serde_path_to_error::deserialize(options)
        .map_err(|error| PipelineError::InvalidOptions(vec![error.to_string()]))?;
    options.validate()?;
    Ok(options)
}

impl Engine for PipelineEngine {
    fn validate(&self, options: &serde_json::Value) -> Result<(), Vec<String>> {
        match parse(options) {
            Ok(_) => Ok(()),
            Err(PipelineError::InvalidOptions(errors)) => Err(errors),
            Err(error) => Err(vec![error.to_string()]),
        }
    }

    fn needs(&self, images: &[PathBuf], options: &serde_json::Value) -> Result<Needs, PipelineError> {
        let needs = estimate(images, &parse(options)?);
        needs.map_err(|source| PipelineError::Io { stage: Stage::Intake, path: PathBuf::new(), source })
    }

    fn run(&self, paths: &RunPaths, options: &serde_json::Value, context: &Context) -> Result<Report, PipelineError> {
        reconstruct(paths, &parse(options)?, context)
    }
}
