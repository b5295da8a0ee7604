//! How a bundle adjustment goes about it, and what it tells.

use serde::{Deserialize, Serialize};

use crate::math::RobustLoss;

/// Options of [`super::adjust`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BundleOptions {
    /// Loss of the reprojection error; its scale is in pixels.
    pub loss: RobustLoss,
    /// Most steps tried, taken or not. More costs time and matters little once converged.
    pub max_iterations: usize,
    /// Stops when a step lowers the cost by less than this share of it. Ceres' default.
    pub function_tolerance: f64,
    /// Stops when no entry of the gradient of the cost (squared pixels per unit of the parameter) is larger.
    /// Raising it ends sooner.
    pub gradient_tolerance: f64,
    /// Stops when a step is smaller than this share of the parameters. Ceres' default.
    pub parameter_tolerance: f64,
    /// Damping of the first step, as a share of the diagonal of the normal equations. Measured on 360 perturbed scenes of 3 to
    /// 10 images: from 1e-3 down to 1e-6 more of them reach the minimum, in fewer steps.
    pub initial_damping: f64,
    /// Standard deviation of a free principal point about the image centre, as a share of the longer image side; none leaves it
    /// without a prior. It weighs against reprojection errors of one pixel. Consumer cameras stay within 1 to 2 %.
    pub principal_point_sigma: Option<f64>,
    /// Reduced camera systems with more unknowns than this are solved sparsely, if they are sparse. Measured: dense wins
    /// up to about 150 images.
    pub max_dense_unknowns: usize,
}

impl Default for BundleOptions {
    fn default() -> Self {
        Self {
            loss: RobustLoss::Trivial,
            max_iterations: 50,
            function_tolerance: 1e-6,
            gradient_tolerance: 1e-4,
            parameter_tolerance: 1e-8,
            initial_damping: 1e-6,
            principal_point_sigma: Some(0.02),
            max_dense_unknowns: 900,
        }
    }
}

impl BundleOptions {
    /// Adds a sentence for every value that makes no sense.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let Self {
            loss,
            max_iterations: _,
            function_tolerance,
            gradient_tolerance,
            parameter_tolerance,
            initial_damping,
            principal_point_sigma,
            max_dense_unknowns: _,
        } = self;
        loss.validate("bundle.loss", errors);
        for (name, value) in [
            ("function_tolerance", function_tolerance),
            ("gradient_tolerance", gradient_tolerance),
            ("parameter_tolerance", parameter_tolerance),
        ] {
            if !(value.is_finite() && *value >= 0.0) {
                errors.push(format!("bundle.{name} must be a number of at least 0, not {value}"));
            }
        }
        if !(initial_damping.is_finite() && *initial_damping > 0.0) {
            errors.push(format!("bundle.initial_damping must be positive, not {initial_damping}"));
        }
        if let Some(sigma) = principal_point_sigma
            && !(sigma.is_finite() && *sigma > 0.0)
        {
            errors.push(format!("bundle.principal_point_sigma must be positive, not {sigma}"));
        }
    }
}

/// Why a bundle adjustment ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum StopReason {
    /// A step lowered the cost by too little to go on.
    CostConverged,
    /// The gradient vanished.
    GradientConverged,
    /// A step was too small to go on.
    ParametersConverged,
    /// The most iterations were reached.
    MaxIterations,
    /// No damping made a step that lowers the cost: as good as converged, or not a number somewhere.
    NoDescent,
    /// There was nothing to change, or no sighting to go by.
    NothingToAdjust,
    /// Somebody asked to stop.
    Interrupted,
}

/// What [`super::adjust`] did.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct BundleReport {
    /// Why it ended.
    pub stop: StopReason,
    /// Steps tried.
    pub iterations: usize,
    /// Steps taken.
    pub accepted: usize,
    /// Sightings that took part.
    pub num_observations: usize,
    /// Poses that could change.
    pub num_variable_images: usize,
    /// Points that could change.
    pub num_variable_points: usize,
    /// Half the sum of the losses of all squared reprojection errors and priors, before.
    pub initial_cost: f64,
    /// The same, after.
    pub final_cost: f64,
}

impl BundleReport {
    /// Whether it ended by itself.
    pub fn converged(&self) -> bool {
        !matches!(self.stop, StopReason::MaxIterations | StopReason::NothingToAdjust | StopReason::Interrupted)
    }
}
