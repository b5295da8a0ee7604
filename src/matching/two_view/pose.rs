//! Relative poses of verified pairs.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::camera::Normalized;
use crate::geometry::Rigid3;
use crate::geometry::epipolar::{choose_by_cheirality, decompose_essential, depths, essential_from_fundamental};
use crate::geometry::homography::{decompose_homography, rotation_between};
use crate::ransac::{EssentialEstimator, Estimator, PointPair};

/// A relative pose and how well its pairs fix depth.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RelativePose {
    /// The pose, of unit translation.
    pub b_from_a: Rigid3,
    /// Inliers in front of both cameras.
    pub num_in_front: usize,
    /// Median angle in radians between the rays of those.
    pub median_triangulation_angle_rad: f64,
}

/// Matches behind a camera are dropped when their rays differ by more than this many thresholds (as an angle); with nearly
/// parallel rays the sign of the depth is noise.
const MIN_CLEAR_ANGLE_THRESHOLDS: f64 = 2.0;

/// The angle in radians between the rays of a pair once turned into one frame.
fn ray_angle_rad(b_from_a: &Rigid3, pair: &PointPair) -> f64 {
    let turned = b_from_a.rotation * pair.a.push(1.0);
    let ray = pair.b.push(1.0);
    turned.cross(&ray).norm().atan2(turned.dot(&ray))
}

/// The pose among candidates that has most of the masked pairs in front; takes the pairs that are clearly behind out of the
/// mask.
fn choose(candidates: &[Rigid3], pairs: &[PointPair], mask: &mut [bool], threshold: f64) -> Option<RelativePose> {
    let seen: Vec<(Normalized, Normalized)> = pairs
        .iter()
        .zip(mask.iter())
        .filter(|&(_, &inlier)| inlier)
        .map(|(pair, _)| (Normalized(pair.a), Normalized(pair.b)))
        .collect();
    let (mut b_from_a, num_in_front) = choose_by_cheirality(candidates, &seen)?;
    b_from_a.translation.try_normalize_mut(f64::MIN_POSITIVE)?;
    let mut angles_rad = Vec::with_capacity(num_in_front);
    for (pair, inlier) in pairs.iter().zip(mask.iter_mut()).filter(|(_, inlier)| **inlier) {
        let angle_rad = ray_angle_rad(&b_from_a, pair);
        let in_front = depths(&b_from_a, &pair.a.push(1.0), &pair.b.push(1.0)).is_some_and(|(a, b)| a > 0.0 && b > 0.0);
        if in_front {
            angles_rad.push(angle_rad);
        } else if angle_rad > MIN_CLEAR_ANGLE_THRESHOLDS * threshold {
            *inlier = false;
        }
    }
    let middle = angles_rad.len() / 2;
    let (_, &mut median, _) = angles_rad.select_nth_unstable_by(middle, f64::total_cmp);
    Some(RelativePose { b_from_a, num_in_front, median_triangulation_angle_rad: median })
}

/// The pose of an essential matrix.
pub(super) fn of_essential(
    essential: &Matrix3<f64>,
    pairs: &[PointPair],
    mask: &mut [bool],
    threshold: f64,
) -> Option<RelativePose> {
    choose(&decompose_essential(essential)?, pairs, mask, threshold)
}

/// The pose of a homography on the planes z = 1; the motions that put the plane in front of the camera compete.
pub(super) fn of_homography(
    homography: &Matrix3<f64>,
    pairs: &[PointPair],
    mask: &mut [bool],
    threshold: f64,
) -> Option<RelativePose> {
    let on_plane = || pairs.iter().zip(mask.iter()).filter(|&(_, &inlier)| inlier).map(|(pair, _)| pair);
    let same_side: f64 = on_plane().map(|pair| pair.b.push(1.0).dot(&(homography * pair.a.push(1.0))).signum()).sum();
    let motions = decompose_homography(&(homography * same_side.signum()))?;
    let visible = |normal: &Vector3<f64>| on_plane().filter(|pair| normal.dot(&pair.a.push(1.0)) > 0.0).count();
    let counts = motions.map(|motion| visible(&motion.normal));
    let most = counts.into_iter().max()?;
    let candidates: Vec<Rigid3> =
        motions.iter().zip(counts).filter(|&(_, count)| count == most).map(|(motion, _)| motion.b_from_a).collect();
    choose(&candidates, pairs, mask, threshold)
}

/// The pose of a fundamental matrix under given calibrations, refined on all pairs.
pub(super) fn of_fundamental(
    fundamental: &Matrix3<f64>,
    calibration_a: &Matrix3<f64>,
    calibration_b: &Matrix3<f64>,
    pairs: &[PointPair],
    threshold: f64,
) -> Option<RelativePose> {
    let mut essential = essential_from_fundamental(fundamental, calibration_a, calibration_b)?;
    let all: Vec<usize> = (0..pairs.len()).collect();
    for _ in 0..REFINEMENTS {
        let Some(refined) = EssentialEstimator(pairs).refine(&essential, &all, threshold * threshold) else { break };
        essential = refined;
    }
    of_essential(&essential, pairs, &mut vec![true; pairs.len()], threshold)
}

/// Refinements (of a few Gauss-Newton steps each) of an essential matrix made from a fundamental one.
const REFINEMENTS: usize = 3;

/// Whether a mere rotation explains at least `ratio` of the masked pairs.
pub(super) fn is_rotation(pairs: &[PointPair], mask: &[bool], threshold: f64, ratio: f64) -> bool {
    let rays: Vec<(Vector3<f64>, Vector3<f64>)> = pairs
        .iter()
        .zip(mask)
        .filter(|&(_, &inlier)| inlier)
        .map(|(pair, _)| (pair.a.push(1.0).normalize(), pair.b.push(1.0).normalize()))
        .collect();
    let Some(rotation) = rotation_between(rays.iter().map(|(a, b)| (a, b))) else { return false };
    let agree = rays
        .iter()
        .filter(|(a, b)| {
            let turned = rotation * a;
            turned.z > 0.0 && (turned.xy() / turned.z - b.xy() / b.z).norm() < threshold
        })
        .count();
    agree as f64 >= ratio * rays.len() as f64
}
