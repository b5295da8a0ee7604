//! The last adjustment: everything free that the photographs determine, then filtering, a few rounds.

use super::options::ReconstructionOptions;
use super::{Context, PipelineError};
use crate::add_points::remove_strays;
use crate::bundle::{self, BundleConfig, FreeIntrinsics};
use crate::coarse::{KeepLimits, filter, focal_priors, free_intrinsics, merge_agreeing_cameras};
use crate::scene::{Point3dId, Reconstruction};

/// Refines a model in place.
///
/// # Errors
/// Cancellation, asked for at every step of an adjustment.
pub fn refine(
    model: &mut Reconstruction,
    options: &ReconstructionOptions,
    context: &Context,
) -> Result<(), PipelineError> {
    for _ in 0..options.refine.rounds {
        context.check_cancelled()?;
        merge_agreeing_cameras(model, &options.coarse.mapper.intrinsics);
        let mut config = BundleConfig::global(model, FreeIntrinsics::default());
        config.intrinsics = free_intrinsics(model, &options.coarse.mapper.intrinsics);
        config.focal_priors = focal_priors(model, &options.coarse.mapper.intrinsics);
        bundle::adjust_while(model, &config, &options.refine.bundle, &|| !context.cancel.is_cancelled());
        context.check_cancelled()?;
        let all: Vec<Point3dId> = model.points().map(|(id, _)| id).collect();
        let min_triangulation_angle_rad = options.refine.min_triangulation_angle_deg.to_radians();
        let limits = KeepLimits { min_triangulation_angle_rad, ..options.coarse.mapper.keep_limits() };
        if filter(model, &all, &limits) == 0 {
            break;
        }
    }
    remove_strays(model, &options.refine.strays);
    Ok(())
}
