//! Verification of the matches of an image pair by its two-view geometry.
//!
//! With both focal lengths trusted the pair gets an essential matrix (five-point), otherwise a fundamental matrix
//! (seven-point); a homography stands beside it to recognise planes and mere rotations. Everything runs on undistorted
//! positions on the planes z = 1 (a guessed focal length only scales them), so the three share one threshold.
//!
//! A model is searched only as hard as it could matter: the budget of the fundamental matrix beside an essential matrix is
//! what it takes to beat it, that of the homography what it takes to make the pair planar, and none is searched for
//! models with fewer inliers than a pair needs.
//!
//! Decisions, after COLMAP's: the essential matrix stands unless the fundamental matrix has clearly more inliers, which tells
//! a wrong focal length (crops keep their EXIF); a homography with nearly as many inliers makes the pair planar or panoramic.

mod options;
mod pose;

use nalgebra::{Matrix3, UnitQuaternion};
use serde::{Deserialize, Serialize};

use crate::camera::{Camera, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::geometry::epipolar::{essential_from_pose, fundamental_from_essential};
use crate::geometry::homography::decompose_homography;
use crate::math::Rng;
use crate::ransac::{
    EssentialEstimator, Estimator, FundamentalEstimator, HomographyEstimator, HomographyModel,
    PlaneAndParallaxEstimator, PointPair, RansacOptions, RansacReport, ransac,
};
use crate::scene::KeypointIdx;

use options::MIN_INLIERS;
pub use options::TwoViewOptions;
pub use pose::RelativePose;

/// What kind of geometry a pair has.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum TwoViewConfig {
    /// An essential matrix.
    Calibrated,
    /// A fundamental matrix: a focal length is unknown, or the one stated does not fit.
    Uncalibrated,
    /// A plane seen by calibrated cameras at different places.
    Planar,
    /// Calibrated cameras at one place: no point can be triangulated.
    Panoramic,
    /// A homography of cameras without trusted focal lengths: one of both, it can't be told which.
    PlanarOrPanoramic,
}

impl TwoViewConfig {
    /// Whether the epipolar geometry, and so the fundamental matrix, is well determined.
    pub fn has_epipolar_geometry(self) -> bool {
        matches!(self, Self::Calibrated | Self::Uncalibrated)
    }
}

/// The geometry of a verified pair. Matrices map from image a to image b: `p_b^T F p_a = 0`, `p_b ~ H p_a`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TwoViewGeometry {
    /// What kind it is.
    pub config: TwoViewConfig,
    /// The matches that agree with it, in the order given.
    pub inliers: Vec<(KeypointIdx, KeypointIdx)>,
    /// Between undistorted pixels, of unit Frobenius norm. Absent where only the homography is certain.
    pub fundamental: Option<Matrix3<f64>>,
    /// Between the planes z = 1; for calibrated pairs.
    pub essential: Option<Matrix3<f64>>,
    /// Between undistorted pixels, of unit Frobenius norm, where one was found.
    pub homography: Option<Matrix3<f64>>,
    /// The relative pose, of unit translation; for calibrated and planar pairs.
    pub b_from_a: Option<Rigid3>,
    /// Median angle in radians under which the inliers in front of both cameras are seen from their centres; where there is
    /// a pose.
    pub median_triangulation_angle_rad: Option<f64>,
    /// Inliers of the essential matrix, where one was searched.
    pub num_e_inliers: usize,
    /// Inliers of the fundamental matrix, where one was searched.
    pub num_f_inliers: usize,
    /// Inliers of the homography; 0 where none with enough inliers to matter was found.
    pub num_h_inliers: usize,
}

/// What the searches of one pair share.
struct Search<'a> {
    pairs: Vec<PointPair>,
    threshold: f64,
    options: &'a TwoViewOptions,
}

impl Search<'_> {
    /// The fewest inliers of a pair with this many matches.
    fn min_inliers(&self) -> usize {
        let share = (self.options.min_inlier_ratio * self.pairs.len() as f64).ceil() as usize;
        self.options.min_inliers.max(share)
    }

    /// The best model, searched as long as one with `fewest` inliers could be missed; none below the inliers a pair needs.
    fn find<E: Estimator<N>, const N: usize>(
        &self,
        estimator: &E,
        fewest: f64,
        max_trials: usize,
        rng: &mut Rng,
    ) -> Option<RansacReport<E::Model>> {
        let base = &self.options.ransac;
        let wanted = fewest.max(self.min_inliers() as f64) / self.pairs.len() as f64;
        let min_inlier_ratio = wanted.clamp(base.min_inlier_ratio, 1.0);
        let limits = RansacOptions { min_inlier_ratio, max_trials, ..base.clone() };
        let report = ransac(estimator, self.threshold, &limits, rng)?;
        (report.num_inliers >= self.min_inliers()).then_some(report)
    }

    /// The fundamental matrix of a scene with a dominant plane, when it beats `found`.
    fn beyond_dominant_plane(
        &self,
        found: &RansacReport<Matrix3<f64>>,
        plane: &RansacReport<HomographyModel>,
        rng: &mut Rng,
    ) -> Option<RansacReport<Matrix3<f64>>> {
        let off_plane: Vec<usize> = (0..self.pairs.len()).filter(|&i| !plane.inliers[i]).collect();
        let estimator = PlaneAndParallaxEstimator { pairs: &self.pairs, b_from_a: plane.model.b_from_a, off_plane };
        let start = ransac(&estimator, self.threshold, &self.options.ransac, rng)?;
        let refined = self.refined(&FundamentalEstimator(&self.pairs), &start.model);
        (refined.cost < found.cost).then_some(refined)
    }

    /// The best of an essential matrix and those of the motions of a homography. Two motions explain the matches on a
    /// plane equally well, so the one that has more of them in front of both cameras is taken.
    fn with_plane_motions(
        &self,
        found: RansacReport<Matrix3<f64>>,
        plane: &RansacReport<HomographyModel>,
    ) -> RansacReport<Matrix3<f64>> {
        let in_front = |report: &RansacReport<Matrix3<f64>>| {
            let mut mask = report.inliers.clone();
            pose::of_essential(&report.model, &self.pairs, &mut mask, self.threshold);
            mask.iter().filter(|&&inlier| inlier).count()
        };
        let mut most = in_front(&found);
        let mut best = found;
        for motion in decompose_homography(&plane.model.b_from_a).iter().flatten() {
            let Some(essential) = essential_from_pose(&motion.b_from_a) else { continue };
            let refined = self.refined(&EssentialEstimator(&self.pairs), &essential);
            let count = in_front(&refined);
            if count > most {
                (best, most) = (refined, count);
            }
        }
        best
    }

    /// An epipolar matrix refined on its inliers and scored.
    fn refined<E: Estimator<N, Model = Matrix3<f64>>, const N: usize>(
        &self,
        estimator: &E,
        start: &Matrix3<f64>,
    ) -> RansacReport<Matrix3<f64>> {
        let threshold_sq = self.threshold * self.threshold;
        let mut model = *start;
        for _ in 0..REFINEMENTS {
            let inliers: Vec<usize> =
                (0..self.pairs.len()).filter(|&i| estimator.residual_sq(&model, i) < threshold_sq).collect();
            let Some(better) = estimator.refine(&model, &inliers, threshold_sq) else { break };
            model = better;
        }
        let residuals_sq = || (0..self.pairs.len()).map(|i| estimator.residual_sq(&model, i));
        let inliers: Vec<bool> = residuals_sq().map(|residual_sq| residual_sq < threshold_sq).collect();
        let num_inliers = inliers.iter().filter(|&&inlier| inlier).count();
        RansacReport { model, inliers, num_inliers, cost: residuals_sq().map(|r| r.min(threshold_sq)).sum(), trials: 0 }
    }
}

/// Refinements (of a few Gauss-Newton steps each) of a matrix that did not come from the robust loop.
const REFINEMENTS: usize = 3;

/// The undistorted positions of matched keypoints on the planes z = 1.
fn point_pairs(
    pixels_a: &[Pixel],
    pixels_b: &[Pixel],
    matches: &[(KeypointIdx, KeypointIdx)],
    camera_a: &Camera,
    camera_b: &Camera,
) -> Vec<PointPair> {
    matches
        .iter()
        .map(|(a, b)| PointPair {
            a: camera_a.unproject(&pixels_a[a.index()]).0,
            b: camera_b.unproject(&pixels_b[b.index()]).0,
        })
        .collect()
}

/// The two-view geometry of a pair of images, whose keypoints are `pixels_a` and `pixels_b`; none when too few matches agree.
pub fn verify(
    pixels_a: &[Pixel],
    pixels_b: &[Pixel],
    matches: &[(KeypointIdx, KeypointIdx)],
    camera_a: &Camera,
    camera_b: &Camera,
    options: &TwoViewOptions,
    rng: &mut Rng,
) -> Option<TwoViewGeometry> {
    if matches.len() < options.min_inliers.max(MIN_INLIERS) {
        return None;
    }
    let threshold = 0.5 * (options.threshold_normalized(camera_a) + options.threshold_normalized(camera_b));
    let search = Search { pairs: point_pairs(pixels_a, pixels_b, matches, camera_a, camera_b), threshold, options };
    let calibrated = camera_a.focal_source != FocalSource::Guess && camera_b.focal_source != FocalSource::Guess;

    let max_trials = options.ransac.max_trials;
    let by_e = if calibrated { search.find(&EssentialEstimator(&search.pairs), 0.0, max_trials, rng) } else { None };
    let num_e = by_e.as_ref().map_or(0, |report| report.num_inliers);
    let to_beat_e = num_e as f64 / options.min_essential_ratio;
    let max_f_trials = if calibrated { max_trials } else { options.max_uncalibrated_trials };
    let by_f = search.find(&FundamentalEstimator(&search.pairs), to_beat_e, max_f_trials, rng);
    let num_f = by_f.as_ref().map_or(0, |report| report.num_inliers);
    let to_be_planar = options.dominant_plane_ratio * num_e.max(num_f) as f64;
    let by_h = search.find(&HomographyEstimator(&search.pairs), to_be_planar, max_trials, rng);
    let num_h = by_h.as_ref().map_or(0, |report| report.num_inliers);

    let essential_stands = by_e.is_some() && num_e as f64 >= options.min_essential_ratio * num_f as f64;
    let num_epipolar = if essential_stands { num_e } else { num_f };
    let planar = by_h.is_some() && num_h as f64 >= options.planar_ratio * num_epipolar as f64;

    let calibration_a = camera_a.calibration_matrix();
    let calibration_b = camera_b.calibration_matrix();
    let in_pixels = |normalized: &Matrix3<f64>| fundamental_from_essential(normalized, &calibration_a, &calibration_b);
    let homography = by_h.as_ref().and_then(|report| {
        let h = calibration_b * report.model.b_from_a * calibration_a.try_inverse()?;
        Some(h / h.norm())
    });
    let mut geometry = TwoViewGeometry {
        config: TwoViewConfig::PlanarOrPanoramic,
        inliers: Vec::new(),
        fundamental: None,
        essential: None,
        homography,
        b_from_a: None,
        median_triangulation_angle_rad: None,
        num_e_inliers: num_e,
        num_f_inliers: num_f,
        num_h_inliers: num_h,
    };
    let mut mask: Vec<bool>;
    match (by_e, by_f, by_h) {
        (Some(e), _, by_h) if essential_stands => {
            let plane = by_h.filter(|_| planar);
            let e = match &plane {
                Some(plane) => search.with_plane_motions(e, plane),
                None => e,
            };
            mask = e.inliers;
            geometry.config = TwoViewConfig::Calibrated;
            geometry.num_e_inliers = e.num_inliers;
            geometry.essential = Some(e.model);
            geometry.fundamental = in_pixels(&e.model);
            if let Some(h) = &plane {
                let rotates = pose::is_rotation(&search.pairs, &h.inliers, threshold, options.panoramic_ratio);
                geometry.config = if rotates { TwoViewConfig::Panoramic } else { TwoViewConfig::Planar };
                if rotates {
                    mask.clone_from(&h.inliers);
                }
            }
            if geometry.config == TwoViewConfig::Panoramic {
                (geometry.essential, geometry.fundamental) = (None, None);
            } else if let Some(found) = pose::of_essential(&e.model, &search.pairs, &mut mask, threshold) {
                geometry.b_from_a = Some(found.b_from_a);
                geometry.median_triangulation_angle_rad = Some(found.median_triangulation_angle_rad);
            }
        }
        (_, _, Some(h)) if planar => {
            mask = h.inliers;
            // Where the fundamental matrix has beaten an essential one, the focal lengths do not fit: no pose.
            if calibrated && num_e == 0 {
                let rotates = pose::is_rotation(&search.pairs, &mask, threshold, options.panoramic_ratio);
                geometry.config = if rotates { TwoViewConfig::Panoramic } else { TwoViewConfig::Planar };
                if !rotates
                    && let Some(found) = pose::of_homography(&h.model.b_from_a, &search.pairs, &mut mask, threshold)
                {
                    geometry.b_from_a = Some(found.b_from_a);
                    geometry.median_triangulation_angle_rad = Some(found.median_triangulation_angle_rad);
                }
            }
        }
        (_, Some(f), by_h) => {
            let better = by_h.as_ref().and_then(|plane| search.beyond_dominant_plane(&f, plane, rng));
            let f = better.unwrap_or(f);
            geometry.config = TwoViewConfig::Uncalibrated;
            geometry.num_f_inliers = f.num_inliers;
            geometry.fundamental = in_pixels(&f.model);
            mask = f.inliers;
        }
        _ => return None,
    }
    geometry.inliers = matches.iter().zip(&mask).filter(|&(_, &inlier)| inlier).map(|(pair, _)| *pair).collect();
    (geometry.inliers.len() >= search.min_inliers()).then_some(geometry)
}

impl TwoViewGeometry {
    /// How camera b is turned against camera a: by the relative pose or, of a panoramic pair, by its homography `K_b R K_a^-1`.
    pub fn rotation(&self, camera_a: &Camera, camera_b: &Camera) -> Option<UnitQuaternion<f64>> {
        if let Some(b_from_a) = &self.b_from_a {
            return Some(b_from_a.rotation);
        }
        let homography = self.homography.filter(|_| self.config == TwoViewConfig::Panoramic)?;
        let scaled = camera_b.calibration_matrix().try_inverse()? * homography * camera_a.calibration_matrix();
        Some(UnitQuaternion::from_matrix(&(scaled * scaled.determinant().signum())))
    }

    /// The relative pose under cameras that may have changed since the pair was verified (a focal length found later): from
    /// the fundamental matrix, made essential and refined on the inliers. None for pairs without epipolar geometry.
    pub fn relative_pose(
        &self,
        pixels_a: &[Pixel],
        pixels_b: &[Pixel],
        camera_a: &Camera,
        camera_b: &Camera,
        options: &TwoViewOptions,
    ) -> Option<RelativePose> {
        let pairs = point_pairs(pixels_a, pixels_b, &self.inliers, camera_a, camera_b);
        let threshold = 0.5 * (options.threshold_normalized(camera_a) + options.threshold_normalized(camera_b));
        pose::of_fundamental(
            self.fundamental.as_ref()?,
            &camera_a.calibration_matrix(),
            &camera_b.calibration_matrix(),
            &pairs,
            threshold,
        )
    }
}

#[cfg(test)]
mod tests;
