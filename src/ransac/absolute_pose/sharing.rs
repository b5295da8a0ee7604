//! Whether an image that should share a camera does.
//!
//! Pictures of one size without EXIF are taken for one camera's until they say otherwise: an image that fits clearly better
//! with a focal length of its own was zoomed, or is another camera's.

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::refinement::{Free, PlacedCamera, refine};
use super::{AbsolutePose, AbsolutePoseOptions, estimate};
use crate::camera::{Camera, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::math::Rng;

/// What an image must show to get a camera of its own.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SharingOptions {
    /// Share by which its own focal length must differ from the shared one. A pose and its focal length are hardly ever told
    /// to better than 2 % by one image.
    pub min_focal_difference: f64,
    /// Share by which the sum of squared errors must fall with its own focal length.
    pub min_error_fall: f64,
    /// Matches that must agree with its own focal length; fewer say nothing. The largest number keeps all images at what they
    /// share.
    pub min_matches: usize,
}

impl Default for SharingOptions {
    fn default() -> Self {
        Self { min_focal_difference: 0.05, min_error_fall: 0.25, min_matches: 30 }
    }
}

impl SharingOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if !(self.min_focal_difference > 0.0 && self.min_focal_difference.is_finite()) {
            errors.push(format!("sharing.min_focal_difference must be positive, not {}", self.min_focal_difference));
        }
        if !(self.min_error_fall > 0.0 && self.min_error_fall < 1.0) {
            errors.push(format!("sharing.min_error_fall must lie between 0 and 1, not {}", self.min_error_fall));
        }
    }

    /// Whether two focal lengths differ by enough.
    pub fn differ(&self, a: &Camera, b: &Camera) -> bool {
        (a.mean_focal_px() / b.mean_focal_px()).ln().abs() > self.min_focal_difference.ln_1p()
    }

    /// Whether a sum of squared errors with an own focal length falls enough below that with the shared one.
    pub fn fall_enough(&self, own_errors_sq: f64, shared_errors_sq: f64) -> bool {
        own_errors_sq < (1.0 - self.min_error_fall) * shared_errors_sq
    }
}

/// An image in place.
#[derive(Clone, Debug)]
pub struct SharedPose {
    /// Its pose and intrinsics.
    pub pose: AbsolutePose,
    /// Which of the cameras it shares; none when it needs intrinsics of its own.
    pub shares: Option<usize>,
}

/// The pose of an image that should share one of `cameras` (in their present state), or, where none fits and another focal
/// length does, one with a camera of its own. Cameras that are known are never left; one with an EXIF focal length only where
/// it explains few of the matches.
///
/// # Panics
/// When `cameras` is empty, or points and pixels differ in number.
pub fn estimate_sharing(
    points: &[Vector3<f64>],
    pixels: &[Pixel],
    cameras: &[Camera],
    options: &AbsolutePoseOptions,
    rng: &mut Rng,
) -> Option<SharedPose> {
    let mut best: Option<(usize, AbsolutePose)> = None;
    for (at, camera) in cameras.iter().enumerate() {
        let fixed = Camera { focal_source: FocalSource::Known, ..camera.clone() };
        let Some(mut pose) = estimate(points, pixels, &fixed, options, rng) else { continue };
        pose.camera.focal_source = camera.focal_source;
        if best.as_ref().is_none_or(|(_, best)| pose.num_inliers > best.num_inliers) {
            best = Some((at, pose));
        }
    }
    let nearest = &cameras[best.as_ref().map_or(0, |(at, _)| *at)];
    let few = options.doubt_exif_below_ratio * points.len() as f64;
    let doubted = match nearest.focal_source {
        FocalSource::Known => false,
        FocalSource::Exif => best.as_ref().is_none_or(|(_, pose)| (pose.num_inliers as f64) < few),
        FocalSource::Guess | FocalSource::Estimated => true,
    };
    if doubted && points.len() >= options.sharing.min_matches {
        let free = Camera { focal_source: FocalSource::Guess, ..nearest.clone() };
        if let Some(own) = estimate(points, pixels, &free, options, rng)
            && own.num_inliers >= options.sharing.min_matches
            && options.sharing.differ(&own.camera, nearest)
            && best.as_ref().is_none_or(|(_, shared)| fits_better(&own, shared, points, pixels, options))
        {
            return Some(SharedPose { pose: own, shares: None });
        }
    }
    best.map(|(at, pose)| SharedPose { pose, shares: Some(at) })
}

/// Whether the squared errors of the matches that either pose explains fall by as much as they must.
fn fits_better(
    own: &AbsolutePose,
    shared: &AbsolutePose,
    points: &[Vector3<f64>],
    pixels: &[Pixel],
    options: &AbsolutePoseOptions,
) -> bool {
    let explained = |i: usize| own.inliers[i] || shared.inliers[i];
    let errors = |pose: &AbsolutePose| -> f64 {
        let placed = PlacedCamera { cam_from_world: pose.cam_from_world, camera: pose.camera.clone() };
        let matches = points.iter().zip(pixels).enumerate().filter(|(i, _)| explained(*i));
        let limit_sq = options.threshold_px * options.threshold_px;
        matches.map(|(_, (point, pixel))| placed.residual_sq(point, pixel).min(limit_sq)).sum()
    };
    options.sharing.fall_enough(errors(own), errors(shared))
}

/// A first step towards another focal length is followed from this share of the difference that counts on. Images in place
/// mostly pull much less, and one step costs a thirtieth of the refinement.
const FOLLOWED_PULL: f64 = 0.25;

/// The pose and camera of a placed image once its focal length is freed, when the points it sees (which stay) say that its own
/// is another than the one it shares.
pub fn own_camera(
    points: &[Vector3<f64>],
    pixels: &[Pixel],
    cam_from_world: Rigid3,
    camera: &Camera,
    options: &AbsolutePoseOptions,
) -> Option<(Rigid3, Camera)> {
    if points.len() < options.sharing.min_matches || camera.focal_source >= FocalSource::Known {
        return None;
    }
    let data: Vec<(Vector3<f64>, Pixel)> = points.iter().copied().zip(pixels.iter().copied()).collect();
    let placed = PlacedCamera { cam_from_world, camera: camera.clone() };
    let pull = placed.focal_pull(&data, options.loss_px)?;
    if pull.abs() < FOLLOWED_PULL * options.sharing.min_focal_difference.ln_1p() {
        return None;
    }
    let refined = |focal: bool| refine(placed.clone(), &data, Free { focal, k1: false }, options.loss_px);
    let limit_sq = options.threshold_px * options.threshold_px;
    let errors =
        |placed: &PlacedCamera| -> f64 { data.iter().map(|(x, p)| placed.residual_sq(x, p).min(limit_sq)).sum() };
    let (shared, own) = (refined(false), refined(true));
    if !options.sharing.fall_enough(errors(&own), errors(&shared)) || !options.sharing.differ(&own.camera, camera) {
        return None;
    }
    let mut camera = own.camera;
    camera.focal_source = FocalSource::Estimated;
    Some((own.cam_from_world, camera))
}
