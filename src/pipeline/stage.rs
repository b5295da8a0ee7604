//! Names and order of the stages.

use serde::{Deserialize, Serialize};

/// A stage of the pipeline, in order.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Stage {
    /// Read headers and EXIF, refuse what can't be read, group cameras.
    Intake,
    /// SIFT of every image.
    Features,
    /// Match the features of the largest scales, verify pairs.
    CoarseMatch,
    /// Incremental structure from motion on them.
    CoarseModel,
    /// Localise the other images against the model.
    AddCameras,
    /// Guided matching of all features, triangulation, merging.
    AddPoints,
    /// Bundle adjustment of everything.
    Refine,
    /// Write the outputs.
    Export,
}

impl Stage {
    /// Every stage, in order.
    pub const ALL: [Self; 8] = [
        Self::Intake,
        Self::Features,
        Self::CoarseMatch,
        Self::CoarseModel,
        Self::AddCameras,
        Self::AddPoints,
        Self::Refine,
        Self::Export,
    ];

    /// The name in reports and on the wire.
    pub fn name(self) -> &'static str {
        match self {
            Self::Intake => "intake",
            Self::Features => "features",
            Self::CoarseMatch => "coarse_match",
            Self::CoarseModel => "coarse_model",
            Self::AddCameras => "add_cameras",
            Self::AddPoints => "add_points",
            Self::Refine => "refine",
            Self::Export => "export",
        }
    }
}

/// A stage of one iteration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub struct StageKey {
    /// The stage.
    pub stage: Stage,
    /// 1-based for the iterated stages (`add_cameras`, `add_points`), else none.
    pub iteration: Option<u32>,
}

impl std::fmt::Display for StageKey {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        match self.iteration {
            Some(iteration) => write!(f, "{}/{iteration}", self.stage.name()),
            None => f.write_str(self.stage.name()),
        }
    }
}
