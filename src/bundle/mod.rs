//! Bundle adjustment: poses, intrinsics and points that together minimise the robust reprojection error.
//!
//!   minimise  1/2 sum rho(|project(camera, R X + t) - keypoint|^2) + 1/2 sum (priors)^2
//!
//! By Levenberg-Marquardt ([`levenberg_marquardt`]) with the points eliminated by the Schur complement ([`elimination`],
//! [`back_substitution`]) and the reduced camera system solved by dense or sparse Cholesky ([`solver`]). Robust losses are
//! handled by reweighting. A point behind a camera costs as much as an error of the image's diagonal, a constant: it neither
//! pulls nor makes the cost infinite, and a step that puts points behind cameras raises the cost.
//!
//! Cost of a step: two passes over the sightings, plus for every point the square of its track length, plus the solution of
//! the reduced system. All of it counts only what takes part, so adjusting a few images of a large model is cheap.
//!
//! Work is shared out in parts that depend on the problem only, and sums are taken in their order: the result is the same, to
//! the last bit, for any number of threads. Small problems have one part and start no thread.

mod back_substitution;
mod config;
mod elimination;
mod levenberg_marquardt;
mod options;
mod pattern;
mod point_block;
mod problem;
mod projection;
mod solver;
#[cfg(test)]
mod tests;

pub use config::{BundleConfig, FocalPrior, FreeIntrinsics, Gauge, PointSelection};
pub use options::{BundleOptions, BundleReport, StopReason};

use crate::scene::Reconstruction;

use levenberg_marquardt::Minimizer;
use problem::Problem;

/// Asked whether to go on. Once it says no it must go on saying so.
pub type KeepGoing<'a> = dyn Fn() -> bool + Sync + 'a;

/// Adjusts what `config` lets change in `model`; the rest stays as it is, to the last bit.
pub fn adjust(model: &mut Reconstruction, config: &BundleConfig, options: &BundleOptions) -> BundleReport {
    adjust_while(model, config, options, &|| true)
}

/// [`adjust`] that ends early once `keep_going` says no, with the best state found until then. It is asked twice a
/// step: the wait is at most a pass over the sightings, or one solution of the reduced system.
pub fn adjust_while(
    model: &mut Reconstruction,
    config: &BundleConfig,
    options: &BundleOptions,
    keep_going: &KeepGoing,
) -> BundleReport {
    let (problem, mut state) = Problem::build(model, config, options);
    let num_variable_points = problem.point_is_variable.iter().filter(|variable| **variable).count();
    let mut report = BundleReport {
        stop: StopReason::NothingToAdjust,
        iterations: 0,
        accepted: 0,
        num_observations: problem.sightings.len(),
        num_variable_images: problem.poses.iter().filter(|pose| pose.slot.is_some()).count(),
        num_variable_points,
        initial_cost: 0.0,
        final_cost: 0.0,
    };
    if problem.sightings.is_empty() || problem.num_unknowns + num_variable_points == 0 {
        return report;
    }
    let Some(mut minimizer) = Minimizer::new(&problem, options) else {
        report.stop = StopReason::NoDescent;
        return report;
    };
    let outcome = minimizer.run(&mut state, keep_going);
    problem.write_back(&state, model);
    BundleReport {
        stop: outcome.stop,
        iterations: outcome.iterations,
        accepted: outcome.accepted,
        initial_cost: outcome.initial_cost,
        final_cost: outcome.final_cost,
        ..report
    }
}
