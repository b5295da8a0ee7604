//! Fills in the report of a run.

use std::collections::BTreeMap;

use super::features::ImageFeatures;
use super::intake::Intake;
use super::measure::{Stopwatch, peak_rss_bytes};
use super::options::ReconstructionOptions;
use super::state::{ModelState, PipelineState, mean_and_median};
use super::{Context, verdict};
use crate::formats::report::{InputSummary, ModelReport, Report, Software, StageReport};
use crate::scene::ImageId;

/// The report of a finished run.
#[expect(clippy::too_many_arguments, reason = "a report gathers everything a run knows")]
pub fn build(
    options: &ReconstructionOptions,
    context: &Context,
    intake: &Intake,
    features: &BTreeMap<ImageId, ImageFeatures>,
    state: &PipelineState,
    stages: Vec<StageReport>,
    notes: Vec<String>,
    watch: &Stopwatch,
) -> Report {
    let pixels: f64 = intake.files.iter().filter_map(|file| file.size).map(|(w, h)| f64::from(w) * f64::from(h)).sum();
    Report {
        software: Software { name: env!("CARGO_PKG_NAME").to_owned(), version: env!("CARGO_PKG_VERSION").to_owned() },
        seed: context.seed,
        threads: context.threads,
        options: serde_json::to_value(options).expect("options serialise"),
        input: InputSummary { images: intake.files.len(), megapixels: pixels / 1e6 },
        wall_s: watch.wall_s(),
        cpu_s: watch.cpu_s(),
        peak_rss_bytes: peak_rss_bytes(),
        stages,
        models: state.models.iter().enumerate().map(|(id, account)| model_report(id, account)).collect(),
        images: verdict::verdicts(intake, features, state),
        notes,
    }
}

fn model_report(id: usize, ModelState { model, history, .. }: &ModelState) -> ModelReport {
    let (mean, median) = mean_and_median(model.reprojection_errors_px());
    let (points, observations) = (model.num_points(), model.num_observations());
    ModelReport {
        id,
        images: model.images().len(),
        points,
        points_3plus: model.num_points_3plus(),
        observations,
        mean_track_length: (points > 0).then(|| observations as f64 / points as f64),
        mean_reprojection_error_px: mean,
        median_reprojection_error_px: median,
        stages: history.clone(),
    }
}
