//! Images that should share a camera and don't: zoomed pictures of one size without EXIF.

use std::collections::BTreeMap;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::Mapper;
use crate::bundle::{self, BundleConfig, FreeIntrinsics};
use crate::camera::{Camera, Pixel};
use crate::coarse::intrinsics::{add_camera, focal_priors};
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::ransac::absolute_pose;
use crate::scene::{CameraId, ImageId, KeypointIdx, Point3dId, Reconstruction};

/// Tells the random streams of splitting cameras from others.
const STREAM: u64 = 0x7370_6c69_745f_6361;

impl Mapper<'_> {
    /// Gives those images cameras of their own whose points contradict the focal length they share, once there are enough
    /// images to tell. Returns how many.
    pub(super) fn split_cameras(&mut self) -> usize {
        if self.model.images().len() <= self.options.intrinsics.min_model_images_for_focal {
            return 0;
        }
        let ids: Vec<ImageId> = self.model.images().keys().copied().collect();
        let apart: Vec<Option<(Rigid3, Camera)>> = ids.par_iter().map(|&id| self.own_camera(id)).collect();
        let mut split = 0;
        for (id, apart) in ids.into_iter().zip(apart) {
            let Some((pose, camera)) = apart else { continue };
            let camera = add_camera(&mut self.model, camera);
            self.model.set_camera(id, camera);
            self.model.set_pose(id, pose);
            split += 1;
        }
        split
    }

    /// The pose and camera of an image whose points say that its focal length is another than the one it shares.
    fn own_camera(&self, id: ImageId) -> Option<(Rigid3, Camera)> {
        let (image, camera) = (&self.model.images()[&id], self.model.camera_of(id));
        let mut options = self.options.pose.clone();
        options.threshold_px *= self.options.keep_limits().threshold_scale(camera);
        let matches = |seen: Vec<(KeypointIdx, Point3dId)>| -> (Vec<Vector3<f64>>, Vec<Pixel>) {
            let place = |(keypoint, point): (KeypointIdx, Point3dId)| {
                Some((self.model.point(point)?.xyz, image.keypoints[keypoint.index()]))
            };
            seen.into_iter().filter_map(place).unzip()
        };
        let visible = self.visible_points(id);
        if (image.num_observations() as f64) < self.options.settled_share * visible.len() as f64 {
            // Much was filtered: the pose itself may be wrong, and what is left of the points confirms it.
            let (points, pixels) = matches(visible);
            let mut rng = Rng::from_parts(&[self.run.seed, STREAM, u64::from(id.0)]);
            let shared = std::slice::from_ref(camera);
            let placed = absolute_pose::estimate_sharing(&points, &pixels, shared, &options, &mut rng)?;
            return placed.shares.is_none().then_some((placed.pose.cam_from_world, placed.pose.camera));
        }
        let seen = (0u32..).map(KeypointIdx).zip(image.points());
        let (points, pixels) = matches(seen.filter_map(|(keypoint, &point)| Some((keypoint, point?))).collect());
        absolute_pose::own_camera(&points, &pixels, image.cam_from_world, camera, &options)
    }

    /// Adjusts a copy of the model in which every image has a focal length of its own, and splits off those images whose errors
    /// fall by it. That finds images whose own points were bent to fit the shared focal length, which
    /// [`Mapper::split_cameras`] can't see. Returns how many.
    pub(super) fn split_cameras_by_adjustment(&mut self) -> usize {
        let enough = self.model.images().len() > self.options.intrinsics.min_model_images_for_focal;
        if !self.options.intrinsics.refine || !enough {
            return 0;
        }
        let told = |id: &ImageId| self.model.camera_of(*id).focal_source.is_told_by_photographs();
        let shared: BTreeMap<ImageId, CameraId> =
            self.model.images().iter().filter(|(id, _)| told(id)).map(|(&id, image)| (id, image.camera)).collect();
        let mut freed = self.model.clone();
        for &id in shared.keys() {
            let camera = add_camera(&mut freed, self.model.camera_of(id).clone());
            freed.set_camera(id, camera);
        }
        let mut config = BundleConfig::global(&freed, FreeIntrinsics::default());
        for id in shared.keys() {
            let free = FreeIntrinsics { focal: true, ..FreeIntrinsics::default() };
            config.intrinsics.insert(freed.images()[id].camera, free);
        }
        config.focal_priors = focal_priors(&freed, &self.options.intrinsics);
        bundle::adjust_while(&mut freed, &config, &self.options.global_bundle, self.run.keep_going);
        let options = &self.options.pose.sharing;
        let stays = |id: &ImageId| {
            let (own, given) = (freed.camera_of(*id), self.model.camera_of(*id));
            let errors_sq = |model| squared_errors(model, *id, self.max_error_px(given));
            self.model.images()[id].num_observations() < options.min_matches
                || !options.differ(own, given)
                || !options.fall_enough(errors_sq(&freed), errors_sq(&self.model))
        };
        let staying: Vec<ImageId> = shared.keys().copied().filter(stays).collect();
        let split = shared.len() - staying.len();
        if split > 0 {
            for id in staying {
                freed.set_camera(id, shared[&id]);
            }
            self.model = freed;
        }
        split
    }
}

/// The sum of the squared errors of an image's sightings, each at most `limit_px` squared.
fn squared_errors(model: &Reconstruction, image: ImageId, limit_px: f64) -> f64 {
    model.errors_of_image_px(image).map(|(_, error_px)| error_px.min(limit_px).powi(2)).sum()
}
