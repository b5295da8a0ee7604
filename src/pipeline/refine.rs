//! The last adjustment: everything free that the photographs determine, then filtering, a few rounds; and what the final poses
//! tell about points that two images see.

use std::sync::Arc;

use super::features::StoredFeatures;
use super::options::ReconstructionOptions;
use super::state::ModelState;
use super::{Context, PipelineError, Stage};
use crate::add_points::{Completer, CompletionOptions, remove_strays};
use crate::bundle::{self, BundleConfig, FreeIntrinsics};
use crate::coarse::{KeepLimits, filter, focal_priors, free_intrinsics, merge_agreeing_cameras};
use crate::scene::{Features, ImageId, Point3dId};

/// Refines a model in place; returns how many points of two sightings were found again.
///
/// # Errors
/// Cancellation, asked for at every step of an adjustment, or features that were lost.
pub fn refine(
    state: &mut ModelState,
    features: &StoredFeatures<'_>,
    options: &ReconstructionOptions,
    context: &Context,
) -> Result<usize, PipelineError> {
    let model = &mut state.model;
    let min_triangulation_angle_rad = options.refine.min_triangulation_angle_deg.to_radians();
    let limits = KeepLimits { min_triangulation_angle_rad, ..options.coarse.mapper.keep_limits() };
    for _ in 0..options.refine.rounds {
        context.check_cancelled()?;
        merge_agreeing_cameras(model, &options.coarse.mapper.intrinsics);
        let mut config = BundleConfig::global(model, FreeIntrinsics::default());
        config.intrinsics = free_intrinsics(model, &options.coarse.mapper.intrinsics);
        config.focal_priors = focal_priors(model, &options.coarse.mapper.intrinsics);
        bundle::adjust_while(model, &config, &options.refine.bundle, &|| !context.cancel.is_cancelled());
        context.check_cancelled()?;
        let all: Vec<Point3dId> = model.points().map(|(id, _)| id).collect();
        if filter(model, &all, &limits) == 0 {
            break;
        }
    }
    let completed = match &options.refine.completion {
        Some(completion) => complete(state, features, (completion, &limits), options, context)?,
        None => 0,
    };
    state.unconfirmed = Vec::new();
    remove_strays(&mut state.model, &options.refine.strays);
    Ok(completed)
}

/// Looks for further sightings of points of two; returns how many points got some.
fn complete(
    state: &mut ModelState,
    features: &StoredFeatures<'_>,
    (completion, limits): (&CompletionOptions, &KeepLimits),
    options: &ReconstructionOptions,
    context: &Context,
) -> Result<usize, PipelineError> {
    let load = |id: ImageId| -> Arc<Features> { Arc::new(features.read(id, None)) };
    let cancelled = || context.cancel.is_cancelled();
    let completer = Completer { features: &load, completion, options: &options.add_points, cancelled: &cancelled };
    let completed = completer.run(&mut state.model, &state.unconfirmed);
    context.check_cancelled()?;
    features.check(Stage::Refine)?;
    let completed = completed.expect("neither cancelled nor with lost features");
    filter(&mut state.model, &completed, limits);
    Ok(completed.len())
}
