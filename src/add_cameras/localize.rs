//! One image against the model: the unit of work of this stage.

use std::collections::BTreeMap;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::active_search::active_search;
use super::direct_match::direct_match;
use super::pose::{Intrinsics, place};
use super::ranked_match::{ranked_images, ranked_match};
use super::{
    AddCamerasCancelled, AddCamerasOptions, Cancelled, Correspondence, LoadFeatures, LocalizationMethod,
    LocalizeFailure, MatchCounts, ModelSnapshot, Outcome, Progress,
};
use crate::camera::Camera;
use crate::coarse::cameras_to_share;
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::{CameraId, Features, ImageId, Reconstruction};

/// Tells this stage's random streams from others.
const STREAM: u64 = 0x6c6f_6361_6c69_7a65;

/// An image to localise.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct QueryImage {
    /// The image.
    pub image: ImageId,
    /// Its camera.
    pub camera_id: CameraId,
    /// What is known of that camera when the model does not have it.
    pub camera: Camera,
}

/// A localised image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Localized {
    /// The camera of the model it shares, or that of its group where no image of the model has it yet; none where it needs one
    /// of its own.
    pub camera_id: Option<CameraId>,
    /// The intrinsics its pose belongs to.
    pub camera: Camera,
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// The correspondences that agree with the pose, by keypoint.
    pub inliers: Vec<Correspondence>,
    /// All correspondences.
    pub num_correspondences: usize,
    /// What found them.
    pub method: LocalizationMethod,
}

/// Localises an image: each method in turn until one gives a pose that is accepted.
///
/// # Errors
/// Why none did: the failure of the method that came farthest.
#[expect(clippy::too_many_arguments, reason = "everything the unit of work depends on, so that it is a pure function")]
pub fn localize_image(
    snapshot: &ModelSnapshot,
    model: &Reconstruction,
    query: &QueryImage,
    features: &Features,
    load: &LoadFeatures,
    match_counts: &MatchCounts,
    options: &AddCamerasOptions,
    seed: u64,
) -> Outcome {
    if features.is_empty() {
        return Err(LocalizeFailure::NoFeatures);
    }
    if snapshot.is_empty() {
        return Err(LocalizeFailure::EmptyModel);
    }
    let shareable =
        cameras_to_share(model, query.camera_id, model.cameras.get(&query.camera_id).unwrap_or(&query.camera));
    let cameras: Vec<Camera> = shareable.iter().map(|id| model.cameras[id].clone()).collect();
    let intrinsics = if cameras.is_empty() { Intrinsics::Unused(&query.camera) } else { Intrinsics::Shared(&cameras) };
    let mut failure: Option<LocalizeFailure> = None;
    for (turn, &method) in (0u64..).zip(&options.methods) {
        let mut correspondences = match method {
            LocalizationMethod::ActiveSearch => active_search(snapshot, features, &options.active_search),
            LocalizationMethod::DirectMatch => direct_match(snapshot, features, &options.direct_match),
            LocalizationMethod::RankedMatch => {
                let ranked = ranked_images(model, query.image, match_counts, options.ranked_match.images);
                ranked_match(model, features, &ranked, load, &options.ranked_match)
            }
        };
        correspondences.retain(|seen| !model.apart_from_track(query.image, seen.point));
        let mut pose_options = options.pose.clone();
        if method == LocalizationMethod::RankedMatch {
            pose_options.min_correspondences = pose_options.min_correspondences.max(options.ranked_match.more_than + 1);
        }
        let mut rng = Rng::from_parts(&[seed, STREAM, u64::from(query.image.0), turn]);
        match place(model, features, &intrinsics, &correspondences, method, &pose_options, &mut rng) {
            Ok(placed) => {
                let group = cameras.is_empty().then_some(query.camera_id);
                return Ok(Localized {
                    camera_id: placed.shares.map(|at| shareable[at]).or(group),
                    camera: placed.pose.camera,
                    cam_from_world: placed.pose.cam_from_world,
                    inliers: placed.inliers,
                    num_correspondences: correspondences.len(),
                    method,
                });
            }
            Err(next) => {
                if failure.is_none_or(|before| next.progress() > before.progress()) {
                    failure = Some(next);
                }
            }
        }
    }
    Err(failure.unwrap_or(LocalizeFailure::EmptyModel))
}

/// Localises many images in parallel, each on its own.
///
/// # Errors
/// When cancelled.
#[expect(clippy::too_many_arguments, reason = "as for one image, with progress and cancelling")]
pub fn localize_all(
    snapshot: &ModelSnapshot,
    model: &Reconstruction,
    queries: &[QueryImage],
    load: &LoadFeatures,
    match_counts: &MatchCounts,
    options: &AddCamerasOptions,
    seed: u64,
    progress: &Progress,
    cancelled: &Cancelled,
) -> Result<BTreeMap<ImageId, Outcome>, AddCamerasCancelled> {
    let done = AtomicUsize::new(0);
    let outcomes: Vec<_> = queries
        .par_iter()
        .map(|query| {
            if cancelled() {
                return Err(AddCamerasCancelled);
            }
            let features = load(query.image);
            let outcome = localize_image(snapshot, model, query, &features, load, match_counts, options, seed);
            progress(done.fetch_add(1, Ordering::Relaxed) + 1, queries.len());
            Ok((query.image, outcome))
        })
        .collect::<Result<_, _>>()?;
    Ok(outcomes.into_iter().collect())
}
