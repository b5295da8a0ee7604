//! The localised images into the model, all at once, and their inliers into its tracks (paper, end of section 5).

use std::collections::BTreeMap;
use std::sync::Arc;

use super::pose::{Intrinsics, pixel, place};
use super::{LoadFeatures, LocalizeFailure, Localized, PoseOptions};
use crate::camera::{Camera, FocalSource, Pixel};
use crate::coarse::add_camera;
use crate::math::Rng;
use crate::scene::{CameraId, Features, ImageId, KeypointIdx, Observation, Reconstruction};

/// Tells this step's random streams from others.
const STREAM: u64 = 0x6170_706c_7969_6d67;

/// What was added.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AppliedReport {
    /// Images added.
    pub images_added: usize,
    /// Sightings added to tracks.
    pub observations_added: usize,
    /// Images whose pose did not hold with the intrinsics they have to share.
    pub rejected: BTreeMap<ImageId, LocalizeFailure>,
}

/// Registers the localised images and appends their inliers to the tracks. Images that are registered already are left out.
///
/// Images may share a camera that the model did not use before, and then each has estimated its focal length on its own.
/// The estimate with most inliers is taken for all of them, and the others are placed again with it.
pub fn apply(
    model: &mut Reconstruction,
    localized: &BTreeMap<ImageId, Localized>,
    features: &LoadFeatures,
    options: &PoseOptions,
    seed: u64,
) -> AppliedReport {
    let mut report = AppliedReport::default();
    let settled = settle_cameras(model, localized);
    for (&id, camera) in &settled {
        model.cameras.insert(id, camera.clone());
    }
    for (&id, found) in localized {
        if model.image(id).is_some() {
            continue;
        }
        let features = features(id);
        let (camera, pose, inliers) = match found.camera_id {
            None => (add_camera(model, found.camera.clone()), found.cam_from_world, found.inliers.clone()),
            Some(camera) if model.cameras[&camera].params == found.camera.params => {
                (camera, found.cam_from_world, found.inliers.clone())
            }
            Some(camera) => {
                let fixed = [Camera { focal_source: FocalSource::Known, ..model.cameras[&camera].clone() }];
                let mut rng = Rng::from_parts(&[seed, STREAM, u64::from(id.0)]);
                let intrinsics = Intrinsics::Shared(&fixed);
                match place(model, &features, &intrinsics, &found.inliers, found.method, options, &mut rng) {
                    Ok(placed) => (camera, placed.pose.cam_from_world, placed.inliers),
                    Err(failure) => {
                        report.rejected.insert(id, failure);
                        continue;
                    }
                }
            }
        };
        model.register(id, camera, pose, pixels(&features));
        report.images_added += 1;
        for seen in inliers {
            let observation = Observation { image: id, keypoint: seen.keypoint };
            let near = model.point(seen.point).is_some()
                && model.reprojection_error_px(seen.point, observation) <= options.max_track_error_px;
            report.observations_added += usize::from(near && model.add_observation(seen.point, observation));
        }
    }
    report
}

/// The intrinsics of the cameras that no image of the model uses yet: those of the image with most inliers.
fn settle_cameras(model: &Reconstruction, localized: &BTreeMap<ImageId, Localized>) -> BTreeMap<CameraId, Camera> {
    let mut best: BTreeMap<CameraId, &Localized> = BTreeMap::new();
    for found in localized.values() {
        let Some(camera) = found.camera_id else { continue };
        let used = model.images().values().any(|image| image.camera == camera);
        if !used && best.get(&camera).is_none_or(|best| found.inliers.len() > best.inliers.len()) {
            best.insert(camera, found);
        }
    }
    best.into_iter().map(|(id, found)| (id, found.camera.clone())).collect()
}

fn pixels(features: &Features) -> Arc<[Pixel]> {
    (0..features.len() as u32).map(|keypoint| pixel(features, KeypointIdx(keypoint))).collect()
}
