//! From correspondences to a pose that is good enough, or the reason why not.

use serde::{Deserialize, Serialize};

use super::correspondences::Correspondence;
use super::{LocalizationMethod, PoseOptions};
use crate::camera::{Camera, Pixel};
use crate::math::Rng;
use crate::ransac::absolute_pose::{AbsolutePose, AbsolutePoseOptions, SharedPose, estimate, estimate_sharing};
use crate::scene::{Features, KeypointIdx, Reconstruction};

/// Why an image could not be localised: how far the method came that came farthest.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize, thiserror::Error)]
#[serde(rename_all = "snake_case")]
pub enum LocalizeFailure {
    /// The image has no features.
    #[error("the image has no features")]
    NoFeatures,
    /// The model has no points.
    #[error("the model has no points")]
    EmptyModel,
    /// Too few of its features resemble points of the model.
    #[error("only {found} features match points of the model, {needed} are needed")]
    TooFewCorrespondences {
        /// Correspondences found.
        found: usize,
        /// Correspondences a pose is tried with.
        needed: usize,
        /// The method that found them.
        method: LocalizationMethod,
    },
    /// The correspondences do not agree on a pose.
    #[error(
        "of {correspondences} matches with points of the model only {inliers} agree on a pose, {needed} are needed"
    )]
    TooFewInliers {
        /// The most that agree.
        inliers: usize,
        /// Correspondences found.
        correspondences: usize,
        /// Inliers that are needed.
        needed: usize,
        /// The method that found them.
        method: LocalizationMethod,
    },
    /// The pose is turned another way than the pairs with the image say.
    #[error(
        "a pose that {inliers} matches with points of the model agree on is turned another way than pairs of photographs say"
    )]
    TurnedOtherwise {
        /// Correspondences that agree with the pose.
        inliers: usize,
        /// Correspondences found.
        correspondences: usize,
    },
}

impl LocalizeFailure {
    /// How far it came: a pose with inliers before correspondences, more before fewer.
    pub(super) fn progress(&self) -> (usize, usize) {
        match *self {
            Self::NoFeatures | Self::EmptyModel => (0, 0),
            Self::TooFewCorrespondences { found, .. } => (0, found),
            Self::TooFewInliers { inliers, correspondences, .. }
            | Self::TurnedOtherwise { inliers, correspondences } => (1 + inliers, correspondences),
        }
    }
}

/// A pose below this many inliers is not told apart from none.
const FEWEST_INLIERS: usize = 6;

/// What is known of the intrinsics of an image.
pub(super) enum Intrinsics<'a> {
    /// It shares one of these cameras of the model, unless the correspondences say that none fits.
    Shared(&'a [Camera]),
    /// No image of the model has its camera; this is the start.
    Unused(&'a Camera),
}

/// An image in place and the correspondences that agree.
pub(super) struct Placed {
    /// Its pose and intrinsics.
    pub pose: AbsolutePose,
    /// Which of the given cameras it shares; none where it has intrinsics of its own.
    pub shares: Option<usize>,
    /// The correspondences that agree.
    pub inliers: Vec<Correspondence>,
}

/// The pose by these correspondences.
pub(super) fn place(
    model: &Reconstruction,
    features: &Features,
    intrinsics: &Intrinsics<'_>,
    correspondences: &[Correspondence],
    method: LocalizationMethod,
    options: &PoseOptions,
    rng: &mut Rng,
) -> Result<Placed, LocalizeFailure> {
    let known: Vec<_> = correspondences
        .iter()
        .filter_map(|seen| Some((model.point(seen.point)?.xyz, pixel(features, seen.keypoint), *seen)))
        .collect();
    if known.len() < options.min_correspondences {
        let needed = options.min_correspondences;
        return Err(LocalizeFailure::TooFewCorrespondences { found: known.len(), needed, method });
    }
    let points: Vec<_> = known.iter().map(|(point, _, _)| *point).collect();
    let pixels: Vec<_> = known.iter().map(|(_, pixel, _)| *pixel).collect();
    // Accepted here, not there, so that a failure can say how many inliers there were.
    let estimation =
        AbsolutePoseOptions { min_inliers: FEWEST_INLIERS, min_inlier_ratio: 0.0, ..options.estimation.clone() };
    let found = match intrinsics {
        Intrinsics::Shared(cameras) => estimate_sharing(&points, &pixels, cameras, &estimation, rng),
        Intrinsics::Unused(camera) => {
            estimate(&points, &pixels, camera, &estimation, rng).map(|pose| SharedPose { pose, shares: None })
        }
    };
    let needed = options.min_inliers.max((options.min_inlier_ratio * known.len() as f64).ceil() as usize);
    match found {
        Some(placed) if placed.pose.num_inliers >= needed => {
            let agreeing = known.iter().zip(&placed.pose.inliers).filter(|(_, inlier)| **inlier);
            let inliers = agreeing.map(|((_, _, seen), _)| *seen).collect();
            Ok(Placed { pose: placed.pose, shares: placed.shares, inliers })
        }
        other => {
            let inliers = other.map_or(0, |placed| placed.pose.num_inliers);
            Err(LocalizeFailure::TooFewInliers { inliers, correspondences: known.len(), needed, method })
        }
    }
}

/// Where a keypoint lies.
pub(super) fn pixel(features: &Features, keypoint: KeypointIdx) -> Pixel {
    let keypoint = &features.keypoints[keypoint.index()];
    Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))
}
