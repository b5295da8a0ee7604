//! Options of the verification of pairs.

use serde::{Deserialize, Serialize};

use crate::camera::Camera;
use crate::ransac::RansacOptions;

/// How to verify a pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TwoViewOptions {
    /// Error up to which a match is an inlier, in pixels of an image whose longer side is `reference_long_side_px`; it shrinks
    /// with smaller images. Raising it accepts worse matches. (COLMAP: 4, whatever the size.)
    pub threshold_px: f64,
    /// The longer side of the images `threshold_px` is meant for, in pixels.
    pub reference_long_side_px: f64,
    /// The threshold does not fall below this, in pixels: keypoints of small images are no more exact than about a third
    /// of a pixel, and lens distortion is not known yet.
    pub min_threshold_px: f64,
    /// Fewest inliers of a pair. (COLMAP: 15.)
    pub min_inliers: usize,
    /// Lowest share of the matches that are inliers of a pair: of several hundred wrong matches more than `min_inliers` can
    /// agree by chance.
    pub min_inlier_ratio: f64,
    /// When to stop drawing samples. (At the most trials, samples of five find an inlier ratio of 0.25 with probability 0.98.)
    pub ransac: RansacOptions,
    /// The most trials for the fundamental matrix of cameras without trusted focal lengths: its samples of seven need more
    /// trials and each costs a sixth.
    pub max_uncalibrated_trials: usize,
    /// The essential matrix stands while it has at least this share of the inliers of the fundamental matrix. (COLMAP: 0.95.)
    pub min_essential_ratio: f64,
    /// The pair is planar or panoramic when the homography has at least this share of the inliers of the epipolar matrix.
    /// (COLMAP: 0.8.)
    pub planar_ratio: f64,
    /// A homography with at least this share of the inliers may have degenerated the fundamental matrix of a scene with a
    /// dominant plane, which is then searched from the plane too.
    pub dominant_plane_ratio: f64,
    /// A planar pair is panoramic when a mere rotation has at least this share of the inliers of its homography.
    pub panoramic_ratio: f64,
}

impl Default for TwoViewOptions {
    fn default() -> Self {
        Self {
            threshold_px: 4.0,
            reference_long_side_px: 3200.0,
            min_threshold_px: 2.0,
            min_inliers: 15,
            min_inlier_ratio: 0.1,
            ransac: RansacOptions { max_trials: 4000, trials_factor: 1.5, ..RansacOptions::default() },
            max_uncalibrated_trials: 20_000,
            min_essential_ratio: 0.95,
            planar_ratio: 0.8,
            dominant_plane_ratio: 0.4,
            panoramic_ratio: 0.95,
        }
    }
}

impl TwoViewOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.ransac.validate(errors);
        for (name, value) in [
            ("threshold_px", self.threshold_px),
            ("reference_long_side_px", self.reference_long_side_px),
            ("min_threshold_px", self.min_threshold_px),
        ] {
            if !(value > 0.0 && value.is_finite()) {
                errors.push(format!("{name} must be positive, not {value}"));
            }
        }
        if !(0.0..=1.0).contains(&self.min_inlier_ratio) {
            errors.push(format!("min_inlier_ratio must lie in [0, 1], not {}", self.min_inlier_ratio));
        }
        if self.max_uncalibrated_trials < self.ransac.min_trials {
            errors.push(format!("max_uncalibrated_trials is below min_trials: {}", self.max_uncalibrated_trials));
        }
        for (name, value) in [
            ("min_essential_ratio", self.min_essential_ratio),
            ("planar_ratio", self.planar_ratio),
            ("dominant_plane_ratio", self.dominant_plane_ratio),
            ("panoramic_ratio", self.panoramic_ratio),
        ] {
            if !(value > 0.0 && value <= 1.0) {
                errors.push(format!("{name} must lie between 0 and 1, not {value}"));
            }
        }
        if self.min_inliers < MIN_INLIERS {
            errors.push(format!("min_inliers must be at least {MIN_INLIERS}, not {}", self.min_inliers));
        }
    }

    /// The threshold for a camera, on its plane z = 1.
    pub(super) fn threshold_normalized(&self, camera: &Camera) -> f64 {
        let long_side_px = f64::from(camera.width.max(camera.height));
        let px = (self.threshold_px * long_side_px / self.reference_long_side_px).max(self.min_threshold_px);
        camera.px_to_normalized(px)
    }
}

/// Fewer pairs than this fit some fundamental matrix whatever they are.
pub(super) const MIN_INLIERS: usize = 8;
