//! The pose of a camera from matches of its pixels with points, most of which may be wrong.
//!
//! A camera whose focal length is trusted is placed by P3P. One whose focal length is a guess is placed by P4Pf as well,
//! which solves for the focal length, and the better of both is taken; so is one with an EXIF focal length that explains
//! few of the matches, because cropped photographs keep their EXIF. The result is refined on its inliers with a robust loss.

mod estimators;
mod refinement;
mod sharing;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use self::estimators::{Correspondences, KnownFocal, PinholePose, UnknownFocal};
use self::refinement::{Free, PlacedCamera, refine};
pub use self::sharing::{SharedPose, SharingOptions, estimate_sharing, own_camera};
use super::{RansacOptions, RansacReport, ransac};
use crate::camera::{Camera, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::math::Rng;

/// How to place a camera.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AbsolutePoseOptions {
    /// Reprojection error up to which a match is an inlier, in pixels. Raising it accepts worse points and cameras.
    /// (COLMAP: 12.)
    pub threshold_px: f64,
    /// Fewest inliers of a pose. (Active search: 12; COLMAP: 30.)
    pub min_inliers: usize,
    /// Lowest share of the matches that are inliers of a pose.
    pub min_inlier_ratio: f64,
    /// When to stop drawing samples. Its own inlier ratio bounds the trials only.
    pub ransac: RansacOptions,
    /// An EXIF focal length with a lower inlier ratio than this is doubted: the focal length is solved for as well.
    pub doubt_exif_below_ratio: f64,
    /// Solving for the focal length must gain this factor in inliers over an EXIF focal length to replace it.
    pub doubt_exif_gain: f64,
    /// Least focal length, as a share of the longer side of the image. (COLMAP: 0.1.)
    pub min_focal_ratio: f64,
    /// Greatest focal length, as a share of the longer side of the image. (COLMAP: 10.)
    pub max_focal_ratio: f64,
    /// Refine a focal length from EXIF or estimation too. One that is known stays in any case, a guess is always refined.
    pub refine_trusted_focal: bool,
    /// Refine the first radial distortion coefficient where the model has one and the focal length is not known.
    pub refine_distortion: bool,
    /// Scale of the Cauchy loss of the refinement, in pixels. (COLMAP: 1.)
    pub loss_px: f64,
    /// When an image leaves the camera it should share.
    pub sharing: SharingOptions,
}

impl Default for AbsolutePoseOptions {
    fn default() -> Self {
        Self {
            threshold_px: 12.0,
            min_inliers: 12,
            min_inlier_ratio: 0.1,
            ransac: RansacOptions {
                confidence: 0.9999,
                min_trials: 50,
                max_trials: 10_000,
                min_inlier_ratio: 0.1,
                trials_factor: 2.0,
            },
            doubt_exif_below_ratio: 0.5,
            doubt_exif_gain: 1.2,
            min_focal_ratio: 0.2,
            max_focal_ratio: 8.0,
            refine_trusted_focal: false,
            refine_distortion: false,
            loss_px: 1.0,
            sharing: SharingOptions::default(),
        }
    }
}

impl AbsolutePoseOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.ransac.validate(errors);
        self.sharing.validate(errors);
        for (name, value) in [
            ("threshold_px", self.threshold_px),
            ("loss_px", self.loss_px),
            ("min_focal_ratio", self.min_focal_ratio),
            ("doubt_exif_gain", self.doubt_exif_gain),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                errors.push(format!("{name} must be positive, not {value}"));
            }
        }
        if !(self.max_focal_ratio > self.min_focal_ratio && self.max_focal_ratio.is_finite()) {
            errors.push(format!("max_focal_ratio must exceed min_focal_ratio, not {}", self.max_focal_ratio));
        }
        for (name, value) in
            [("min_inlier_ratio", self.min_inlier_ratio), ("doubt_exif_below_ratio", self.doubt_exif_below_ratio)]
        {
            if !(0.0..=1.0).contains(&value) {
                errors.push(format!("{name} must lie in [0, 1], not {value}"));
            }
        }
        if self.min_inliers < MIN_INLIERS {
            errors.push(format!("min_inliers must be at least {MIN_INLIERS}, not {}", self.min_inliers));
        }
    }
}

/// Fewer points than this fit some pose whatever they are.
const MIN_INLIERS: usize = 4;
/// Rounds of refining on the inliers and collecting them anew.
const REFINEMENT_ROUNDS: usize = 3;

/// A camera in place.
#[derive(Clone, Debug)]
pub struct AbsolutePose {
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// Its intrinsics; the focal length (then `FocalSource::Estimated`) and distortion differ from the given ones only where
    /// they were not trusted or the options allow it.
    pub camera: Camera,
    /// Which matches are inliers.
    pub inliers: Vec<bool>,
    /// How many.
    pub num_inliers: usize,
}

/// The pose of a camera that sees `points[i]` (in the world) at `pixels[i]`; none when too few matches agree on one.
///
/// # Panics
/// When both slices differ in length.
pub fn estimate(
    points: &[Vector3<f64>],
    pixels: &[Pixel],
    camera: &Camera,
    options: &AbsolutePoseOptions,
    rng: &mut Rng,
) -> Option<AbsolutePose> {
    assert_eq!(points.len(), pixels.len(), "as many points as pixels");
    if points.len() < options.min_inliers.max(MIN_INLIERS) {
        return None;
    }
    let focal_px = camera.mean_focal_px();
    let seen_px = pixels.iter().map(|pixel| camera.unproject(pixel).0 * focal_px).collect();
    let correspondences = Correspondences { points, seen_px, focal_px };
    let long_side_px = f64::from(camera.width.max(camera.height));
    let unknown = UnknownFocal {
        correspondences: &correspondences,
        focal_range_px: (options.min_focal_ratio * long_side_px, options.max_focal_ratio * long_side_px),
    };

    let with_focal = ransac(&KnownFocal(&correspondences), options.threshold_px, &options.ransac, rng);
    let count = |report: &Option<RansacReport<PinholePose>>| report.as_ref().map_or(0, |report| report.num_inliers);
    let doubted = match camera.focal_source {
        FocalSource::Guess => true,
        FocalSource::Exif => {
            let few = (options.doubt_exif_below_ratio * points.len() as f64).max(options.min_inliers as f64);
            (count(&with_focal) as f64) < few
        }
        FocalSource::Estimated | FocalSource::Known => false,
    };
    let without_focal = if doubted { ransac(&unknown, options.threshold_px, &options.ransac, rng) } else { None };
    let gain = if camera.focal_source == FocalSource::Guess { 1.0 } else { options.doubt_exif_gain };
    let solved = count(&without_focal) as f64 > gain * count(&with_focal) as f64;
    let model = if solved { without_focal } else { with_focal }?.model;

    let free_focal = solved
        || match camera.focal_source {
            FocalSource::Guess => true,
            FocalSource::Exif | FocalSource::Estimated => options.refine_trusted_focal,
            FocalSource::Known => false,
        };
    let free = Free { focal: free_focal, k1: options.refine_distortion && camera.focal_source != FocalSource::Known };
    let mut placed = PlacedCamera { cam_from_world: model.cam_from_world(), camera: camera.clone() };
    if solved {
        let (fx, fy) = camera.focal();
        let factor = model.focal_px / focal_px;
        placed.camera.set_focal(fx * factor, fy * factor);
    }
    let (placed, inliers) = refine_on_inliers(placed, points, pixels, free, options)?;

    let num_inliers = inliers.iter().filter(|&&inlier| inlier).count();
    let mut camera = placed.camera;
    let (low, high) = unknown.focal_range_px;
    let focal_fits = !free_focal || (low..=high).contains(&camera.mean_focal_px());
    if free_focal {
        camera.focal_source = FocalSource::Estimated;
    }
    let enough = num_inliers >= options.min_inliers.max(MIN_INLIERS)
        && num_inliers as f64 >= options.min_inlier_ratio * points.len() as f64;
    (enough && focal_fits).then_some(AbsolutePose {
        cam_from_world: placed.cam_from_world,
        camera,
        inliers,
        num_inliers,
    })
}

/// Refines a camera on its inliers and collects them anew, until they stay.
fn refine_on_inliers(
    mut placed: PlacedCamera,
    points: &[Vector3<f64>],
    pixels: &[Pixel],
    free: Free,
    options: &AbsolutePoseOptions,
) -> Option<(PlacedCamera, Vec<bool>)> {
    let threshold_sq = options.threshold_px * options.threshold_px;
    let collect = |placed: &PlacedCamera| -> Vec<bool> {
        points.iter().zip(pixels).map(|(point, pixel)| placed.residual_sq(point, pixel) < threshold_sq).collect()
    };
    let mut inliers = collect(&placed);
    for _ in 0..REFINEMENT_ROUNDS {
        let data: Vec<_> = (0..points.len()).filter(|&i| inliers[i]).map(|i| (points[i], pixels[i])).collect();
        if data.len() < MIN_INLIERS {
            return None;
        }
        placed = refine(placed, &data, free, options.loss_px);
        let next = collect(&placed);
        if next == inliers {
            break;
        }
        inliers = next;
    }
    Some((placed, inliers))
}

#[cfg(test)]
mod tests;
