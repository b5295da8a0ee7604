//! `report.json`: what a run did, stage by stage and photograph by photograph. An unknown number is null, never 0.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

/// The account of a run.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Report {
    /// The program that made it.
    pub software: Software,
    /// The run's seed.
    pub seed: u64,
    /// Worker threads.
    pub threads: usize,
    /// The options of the run, with defaults filled in.
    pub options: serde_json::Value,
    /// The input as a whole.
    pub input: InputSummary,
    /// Wall-clock seconds of the whole run.
    pub wall_s: f64,
    /// CPU seconds of the whole run.
    pub cpu_s: f64,
    /// Largest resident set of the process.
    pub peak_rss_bytes: Option<u64>,
    /// Every stage that ran, in order.
    pub stages: Vec<StageReport>,
    /// The models, largest first.
    pub models: Vec<ModelReport>,
    /// Every input image, in name order.
    pub images: Vec<ImageReport>,
    /// Pairs of photographs that match but show different places, and were cut.
    pub look_alikes: Vec<LookAlikePair>,
    /// Plain sentences a person should read: what was widened, cut or left out, and why.
    pub notes: Vec<String>,
}

/// Name and version.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Software {
    /// `multistage`
    pub name: String,
    /// Semantic version.
    pub version: String,
}

/// The input as a whole.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct InputSummary {
    /// Files offered as photographs.
    pub images: usize,
    /// Pixels of those that could be read, in millions.
    pub megapixels: f64,
}

/// One stage (of one iteration).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct StageReport {
    /// `intake`, `features`, `coarse_match`, `coarse_model`, `add_cameras`, `add_points`, `refine` or `export`.
    pub name: String,
    /// 1-based for the iterated stages, else null.
    pub iteration: Option<u32>,
    /// Wall-clock seconds.
    pub wall_s: f64,
    /// CPU seconds.
    pub cpu_s: f64,
    /// Whether the result was re-used from an earlier, interrupted run.
    pub reused: bool,
    /// Named counts: pairs tried, pairs verified, images added, points before and after, ...
    pub counts: BTreeMap<String, f64>,
}

/// A pair that was cut because its photographs show different places that look alike.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct LookAlikePair {
    /// Name of the one photograph.
    pub first: String,
    /// Name of the other.
    pub second: String,
    /// Its verified matches.
    pub matches: usize,
    /// Of those, how many join what the stronger pairs hold for one point too.
    pub agreeing: usize,
    /// How much of what the photographs show the pair matches, 0 to 1; what few photographs show counts most.
    pub strength: f64,
    /// The weakest link of the strongest chain of pairs between the two, on the same scale.
    pub chain_strength: f64,
    /// Median distance between the two places, in units of their distance from the camera; null where it is not known.
    pub displacement: Option<f64>,
    /// Whether the two are held apart for good: no point is seen by both.
    pub apart: bool,
}

/// One model (connected component).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelReport {
    /// Rank, 0 the largest; the folder name under `sparse`, `bundle` and `ply`.
    pub id: usize,
    /// Registered images.
    pub images: usize,
    /// Points.
    pub points: usize,
    /// Points with at least three observations.
    pub points_3plus: usize,
    /// Observations.
    pub observations: usize,
    /// Mean observations of a point.
    pub mean_track_length: Option<f64>,
    /// Mean over all observations of the distance between keypoint and projected point.
    pub mean_reprojection_error_px: Option<f64>,
    /// Median of the same.
    pub median_reprojection_error_px: Option<f64>,
    /// The model after each stage that changed it.
    pub stages: Vec<ModelStage>,
}

/// A model as one stage left it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelStage {
    /// Stage name, with the iteration where there is one: `add_points/1`.
    pub stage: String,
    /// Registered images.
    pub images: usize,
    /// Points.
    pub points: usize,
    /// Points with at least three observations.
    pub points_3plus: usize,
    /// Mean reprojection error.
    pub mean_reprojection_error_px: Option<f64>,
    /// Median reprojection error.
    pub median_reprojection_error_px: Option<f64>,
}

/// What became of an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ImageState {
    /// It has a pose in a model.
    Registered,
    /// It was read, but no pose was found.
    Unregistered,
    /// It could not be used at all.
    Rejected,
}

/// The verdict on one image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ImageReport {
    /// Path relative to the input folder, with `/`.
    pub name: String,
    /// Of the file's bytes, in hexadecimal.
    pub sha256: Option<String>,
    /// Columns of the original.
    pub width: Option<u32>,
    /// Rows of the original.
    pub height: Option<u32>,
    /// What became of it.
    pub state: ImageState,
    /// The model it is in.
    pub model: Option<usize>,
    /// Features found.
    pub features: Option<usize>,
    /// The stage that registered it: `coarse_model`, `add_cameras/1`, ...
    pub registered_in: Option<String>,
    /// Observations in the final model.
    pub inliers: Option<usize>,
    /// Its mean reprojection error.
    pub mean_reprojection_error_px: Option<f64>,
    /// Focal length in pixels in the final model.
    pub focal_px: Option<f64>,
    /// Machine-readable code of why it is not in a model; null when it is.
    pub reason: Option<String>,
    /// A sentence on what happened and what to do about it; null when it is in a model.
    pub advice: Option<String>,
}
