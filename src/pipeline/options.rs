//! All options of a run, nested by stage, with defaults.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::PipelineError;
use super::focals::FocalOptions;
use crate::add_cameras::AddCamerasOptions;
use crate::add_points::{AddPointsOptions, CompletionOptions, StrayOptions};
use crate::bundle::BundleOptions;
use crate::camera::{CameraModel, TYPICAL_FOCAL};
use crate::coarse::MapperOptions;
use crate::coarse::hybrid_match::HybridMatchOptions;
use crate::coarse::look_alikes::LookAlikeOptions;
use crate::coarse::pair_selection::PairSelectionOptions;
use crate::coarse::selection::SelectionOptions;
use crate::features::SiftOptions;
use crate::formats::photograph::PhotographLimits;
use crate::matching::standing::StandingOptions;
use crate::matching::two_view::TwoViewOptions;
use crate::math::RobustLoss;

/// The options of a run. What is not given takes its default; an unknown name is an error.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ReconstructionOptions {
    /// Which photographs are taken, and what is known of their cameras.
    pub intake: IntakeOptions,
    /// SIFT (paper, section 3).
    pub features: SiftOptions,
    /// The coarse model (paper, section 4).
    pub coarse: CoarseOptions,
    /// Localising the other images (paper, section 5).
    pub add_cameras: AddCamerasOptions,
    /// Guided matching and triangulation (paper, section 6).
    pub add_points: AddPointsOptions,
    /// Rounds of adding cameras and points; the paper uses one or two (section 3).
    pub iterations: u32,
    /// The last adjustment.
    pub refine: RefineOptions,
}

impl Default for ReconstructionOptions {
    fn default() -> Self {
        Self {
            intake: IntakeOptions::default(),
            features: SiftOptions::default(),
            coarse: CoarseOptions::default(),
            add_cameras: AddCamerasOptions::default(),
            add_points: AddPointsOptions::default(),
            iterations: 2,
            refine: RefineOptions::default(),
        }
    }
}

/// Which photographs are taken, and what is known of their cameras.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IntakeOptions {
    /// Pictures with a longer long side, in pixels, are shrunk to it before features are sought. Raising it costs time and
    /// memory by its square; COLMAP's value.
    pub max_long_side_px: u32,
    /// Pictures with a shorter side under this many pixels are rejected: they hold too few features to place.
    pub min_side_px: u32,
    /// Pictures of more million pixels are rejected from the header, before they are decoded.
    pub max_megapixels: f64,
    /// Focal length, in units of the long side, assumed where nothing is known: [`TYPICAL_FOCAL`].
    pub default_focal: f64,
    /// Intrinsics known for every picture.
    pub camera: Option<KnownCamera>,
    /// Intrinsics known for single pictures, by name; they go before `camera`.
    pub cameras: BTreeMap<String, KnownCamera>,
    /// Takes a set of ready features (`index.json` and the files it names, as `multistage synthesize` writes them) in place
    /// of photographs; the options of `features` have no effect then, and points stay black.
    pub ready_features: bool,
}

impl Default for IntakeOptions {
    fn default() -> Self {
        Self {
            max_long_side_px: 3200,
            min_side_px: 32,
            max_megapixels: 250.0,
            default_focal: TYPICAL_FOCAL,
            camera: None,
            cameras: BTreeMap::new(),
            ready_features: false,
        }
    }
}

impl IntakeOptions {
    /// What photographs are refused by, before they are decoded.
    pub fn limits(&self) -> PhotographLimits {
        PhotographLimits { min_side_px: self.min_side_px, max_megapixels: self.max_megapixels }
    }
}

/// Known intrinsics: kept as they are, never refined.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct KnownCamera {
    /// The camera model, by COLMAP's name.
    pub model: CameraModel,
    /// Its parameters in COLMAP's order, for pixels of the original picture (first pixel centre at 0.5, 0.5).
    pub params: Vec<f64>,
}

/// The coarse model.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CoarseOptions {
    /// Which features take part.
    pub selection: SelectionOptions,
    /// Which pairs are matched.
    pub pairs: PairSelectionOptions,
    /// How a pair is matched.
    pub matching: HybridMatchOptions,
    /// Which matches are no part of the scene, as they stand still in the frame.
    pub standing: StandingOptions,
    /// How a pair is verified.
    pub two_view: TwoViewOptions,
    /// When votes of pairs settle a focal length.
    pub focals: FocalOptions,
    /// Which verified pairs are cut because they show different places that look alike.
    pub look_alikes: LookAlikeOptions,
    /// Incremental structure from motion.
    pub mapper: MapperOptions,
    /// Share of the readable images that must come into the largest model for the selection to stay as it is; below, a trial
    /// is forgotten, and another selection widened (to 40 %, then to all features).
    pub enough_registered: f64,
}

impl Default for CoarseOptions {
    fn default() -> Self {
        Self {
            selection: SelectionOptions::default(),
            pairs: PairSelectionOptions::default(),
            matching: HybridMatchOptions::default(),
            standing: StandingOptions::default(),
            two_view: TwoViewOptions::default(),
            focals: FocalOptions::default(),
            look_alikes: LookAlikeOptions::default(),
            mapper: MapperOptions::default(),
            enough_registered: 0.8,
        }
    }
}

/// The last adjustment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RefineOptions {
    /// Whether it is done at all; the paper does without (section 3).
    pub enabled: bool,
    /// Rounds of adjusting and filtering, by the limits of `coarse.mapper` but for the angle below.
    pub rounds: usize,
    /// Smallest of the largest angles between two rays of a point that stays, in degrees. Raising it removes points whose
    /// depth is uncertain: at 2 degrees by thirty times the error across the ray.
    pub min_triangulation_angle_deg: f64,
    /// Which points of two sightings are taken for wrong matches.
    pub strays: StrayOptions,
    /// How points of two sightings are looked for in further images once poses are final; none leaves that out.
    pub completion: Option<CompletionOptions>,
    /// The adjustment. Robust by default: guided matches hold a few wrong ones within the limits. Measured against
    /// least squares: temple ring AUC@1 80 for 78, the surveyed fountain unchanged. Reweighting nears its end in many
    /// small steps: at a tolerance of 1e-3 it takes a quarter of the time of 1e-6 and the poses are as good.
    pub bundle: BundleOptions,
}

impl Default for RefineOptions {
    fn default() -> Self {
        Self {
            enabled: true,
            rounds: 2,
            min_triangulation_angle_deg: 2.0,
            strays: StrayOptions::default(),
            completion: Some(CompletionOptions::default()),
            bundle: BundleOptions {
                loss: RobustLoss::Cauchy { scale: 1.0 },
                function_tolerance: 1e-3,
                ..BundleOptions::default()
            },
        }
    }
}

impl ReconstructionOptions {
    /// Reads options from JSON and checks them.
    ///
    /// # Errors
    /// [`PipelineError::InvalidOptions`] with every violation, each naming its field.
    pub fn from_json(json: &serde_json::Value) -> Result<Self, PipelineError> {
        let options: Self = serde_json::from_value(json.clone())
            .map_err(|error| PipelineError::InvalidOptions(vec![error.to_string()]))?;
        options.validate()?;
        Ok(options)
    }

    /// Checks all options together.
    ///
    /// # Errors
    /// [`PipelineError::InvalidOptions`] with every violation.
    pub fn validate(&self) -> Result<(), PipelineError> {
        let mut errors = Vec::new();
        self.features.validate(&mut errors);
        self.coarse.selection.validate(&mut errors);
        self.coarse.pairs.validate(&mut errors);
        self.coarse.matching.validate(&mut errors);
        self.coarse.standing.validate(&mut errors);
        self.coarse.two_view.validate(&mut errors);
        self.coarse.focals.validate(&mut errors);
        self.coarse.look_alikes.validate(&mut errors);
        self.coarse.mapper.validate(&mut errors);
        self.add_cameras.validate(&mut errors);
        self.add_points.validate(&mut errors);
        self.refine.bundle.validate(&mut errors);
        self.refine.strays.validate(&mut errors);
        if let Some(completion) = &self.refine.completion {
            completion.validate(&mut errors);
        }
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(message.to_owned());
            }
        };
        check(self.intake.max_long_side_px >= 64, "intake.max_long_side_px must be at least 64");
        check(self.intake.max_megapixels > 0.0, "intake.max_megapixels must be positive");
        check(
            self.intake.default_focal > 0.1 && self.intake.default_focal < 10.0,
            "intake.default_focal must be in (0.1, 10)",
        );
        check((0.0..=1.0).contains(&self.coarse.enough_registered), "coarse.enough_registered must be in [0, 1]");
        check(
            (0.0..90.0).contains(&self.refine.min_triangulation_angle_deg),
            "refine.min_triangulation_angle_deg must be from 0 to below 90",
        );
        check((1..=10).contains(&self.iterations), "iterations must be from 1 to 10");
        for (name, known) in self
            .intake
            .camera
            .iter()
            .map(|c| ("intake.camera", c))
            .chain(self.intake.cameras.iter().map(|(n, c)| (n.as_str(), c)))
        {
            if known.params.len() != known.model.num_params() || !known.params.iter().all(|p| p.is_finite()) {
                errors.push(format!(
                    "{name}: {} takes {} finite parameters",
                    known.model.colmap_name(),
                    known.model.num_params()
                ));
            }
        }
        if errors.is_empty() { Ok(()) } else { Err(PipelineError::InvalidOptions(errors)) }
    }
}
