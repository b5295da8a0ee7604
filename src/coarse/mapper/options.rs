//! Options of the incremental mapper.

use serde::{Deserialize, Serialize};

use crate::bundle::BundleOptions;
use crate::coarse::IntrinsicsOptions;
use crate::coarse::filter::KeepLimits;
use crate::coarse::rotation_cycles::RotationCycleOptions;
use crate::ransac::absolute_pose::AbsolutePoseOptions;

/// Options of the incremental mapper. Pixel thresholds hold for images of `reference_long_side_px` and scale with the image
/// size; the start values are COLMAP's incremental mapper's.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MapperOptions {
    /// Long side, in pixels, of an image the pixel thresholds are meant for.
    pub reference_long_side_px: f64,
    /// Smallest factor by which a small image shrinks the pixel thresholds.
    pub min_threshold_scale: f64,
    /// Inlier matches an initial pair should have; relaxed step by step when no pair has them.
    pub initial_min_inliers: usize,
    /// Median triangulation angle, in degrees, an initial pair should have; relaxed likewise.
    pub initial_min_angle_deg: f64,
    /// How often both are halved before giving up.
    pub initial_relaxations: usize,
    /// Pairs tried as initial pair, best first, at each level of relaxation.
    pub initial_trials: usize,
    /// Share of an initial pair's matches that must survive its two-view adjustment.
    pub initial_min_survivors: f64,
    /// Visible points an image needs before its pose is tried.
    pub min_visible_points: usize,
    /// Fewest inliers an accepted pose has.
    pub min_pose_inliers: usize,
    /// Fewest inliers of a pose accepted when nothing else can be registered any more.
    pub min_pose_inliers_relaxed: usize,
    /// How often an image is tried before it is left out, between two adjustments, and how often it may be placed and lose its
    /// points again before it is left out for good.
    pub max_registration_trials: u32,
    /// Robust pose estimation.
    pub pose: AbsolutePoseOptions,
    /// Largest reprojection error, in pixels, of a sighting that is kept.
    pub max_reprojection_error_px: f64,
    /// Smallest angle, in degrees, between two rays of a kept point.
    pub min_triangulation_angle_deg: f64,
    /// Images adjusted around a new one.
    pub local_images: usize,
    /// Growth in images or points after which everything is adjusted.
    pub global_growth: f64,
    /// Rounds of adjust-and-filter at most in one global adjustment.
    pub global_rounds: usize,
    /// Share of sightings changed under which the rounds stop.
    pub global_change: f64,
    /// Local adjustment.
    pub local_bundle: BundleOptions,
    /// Global adjustment.
    pub global_bundle: BundleOptions,
    /// Which intrinsics are estimated.
    pub intrinsics: IntrinsicsOptions,
    /// When a pose contradicts the rotations of much stronger pairs and is not taken. Pairs themselves are held against
    /// stronger ones by the same measure.
    pub rotation_cycles: RotationCycleOptions,
    /// Share of the points an image should see that it must keep for its pose to count as settled; below, it is placed anew
    /// to find out whether it shares its camera.
    pub settled_share: f64,
    /// Share of a component's images a model should reach before other initial pairs are tried.
    pub satisfied_share: f64,
    /// Initial pairs a component is started from at most.
    pub max_starts: usize,
    /// Smallest model that is kept.
    pub min_model_images: usize,
}

impl Default for MapperOptions {
    fn default() -> Self {
        Self {
            reference_long_side_px: 2000.0,
            min_threshold_scale: 0.5,
            initial_min_inliers: 100,
            initial_min_angle_deg: 16.0,
            initial_relaxations: 3,
            initial_trials: 20,
            initial_min_survivors: 0.5,
            min_visible_points: 15,
            min_pose_inliers: 30,
            min_pose_inliers_relaxed: 15,
            max_registration_trials: 3,
            pose: AbsolutePoseOptions { min_inlier_ratio: 0.25, ..AbsolutePoseOptions::default() },
            max_reprojection_error_px: 4.0,
            min_triangulation_angle_deg: 1.5,
            local_images: 6,
            global_growth: 1.1,
            global_rounds: 5,
            global_change: 0.0005,
            local_bundle: BundleOptions::default(),
            global_bundle: BundleOptions::default(),
            intrinsics: IntrinsicsOptions::default(),
            rotation_cycles: RotationCycleOptions::default(),
            settled_share: 0.6,
            satisfied_share: 0.8,
            max_starts: 3,
            min_model_images: 3,
        }
    }
}

impl MapperOptions {
    /// Adds every violation to `errors`.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(format!("coarse.mapper.{message}"));
            }
        };
        check(self.reference_long_side_px > 0.0, "reference_long_side_px must be positive");
        check(
            self.min_threshold_scale > 0.0 && self.min_threshold_scale <= 1.0,
            "min_threshold_scale must be in (0, 1]",
        );
        check(self.max_reprojection_error_px > 0.0, "max_reprojection_error_px must be positive");
        check(self.global_growth > 1.0, "global_growth must be above 1");
        check(self.min_model_images >= 2, "min_model_images must be at least 2");
        check(self.min_pose_inliers_relaxed >= 6, "min_pose_inliers_relaxed must be at least 6");
        check(self.max_starts >= 1, "max_starts must be at least 1");
        check((0.0..=1.0).contains(&self.satisfied_share), "satisfied_share must be in [0, 1]");
        let positive = |value: f64| value.is_finite() && value > 0.0;
        check(positive(self.intrinsics.typical_focal), "intrinsics.typical_focal must be positive");
        let sigma_log = self.intrinsics.typical_focal_sigma_log;
        check(sigma_log.is_none_or(positive), "intrinsics.typical_focal_sigma_log must be positive or null");
        self.rotation_cycles.validate(errors);
    }

    /// What sightings and points must keep.
    pub fn keep_limits(&self) -> KeepLimits {
        KeepLimits {
            max_reprojection_error_px: self.max_reprojection_error_px,
            reference_long_side_px: self.reference_long_side_px,
            min_threshold_scale: self.min_threshold_scale,
            min_triangulation_angle_rad: self.min_triangulation_angle_deg.to_radians(),
        }
    }
}
