//! The next image and its pose.

use nalgebra::Vector3;

use super::{Mapper, Unregistered};
use crate::camera::{Camera, Pixel};
use crate::coarse::intrinsics::{add_camera, cameras_to_share};
use crate::math::Rng;
use crate::ransac::absolute_pose;
use crate::scene::{ImageId, KeypointIdx, Observation, Point3dId};

/// Levels of the pyramid whose occupied cells score how evenly an image sees the model.
const PYRAMID_LEVELS: u32 = 6;
/// Tells the random streams of this stage from others.
const STREAM: u64 = 0x7265_6769_7374_6572;

impl Mapper<'_> {
    /// The keypoints of an image whose tracks have a point the image is not yet a sighting of.
    pub(super) fn visible_points(&self, image: ImageId) -> Vec<(KeypointIdx, Point3dId)> {
        self.tracks
            .of(image)
            .iter()
            .filter_map(|&(keypoint, track)| Some((keypoint, self.live_point(track)?)))
            .collect()
    }

    /// Registers the image that sees the model best; tries the others in turn when its pose fails. None when no image can be
    /// registered.
    pub(super) fn register_next(&mut self, min_inliers: usize) -> Option<ImageId> {
        let mut ranking: Vec<(u64, ImageId)> = Vec::new();
        for &image in self.component {
            let is_spent =
                |count: Option<&u32>| count.is_some_and(|count| *count >= self.options.max_registration_trials);
            let spent = is_spent(self.trials.get(&image)) || is_spent(self.drops.get(&image));
            if self.model.image(image).is_some() || spent {
                continue;
            }
            let visible = self.visible_points(image);
            if visible.len() >= self.options.min_visible_points {
                ranking.push((self.visibility_score(image, &visible), image));
            } else {
                self.failures.insert(image, Unregistered::TooFewPoints { visible: visible.len() });
            }
        }
        ranking.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
        let keep_going = self.run.keep_going;
        let mut in_turn = ranking.into_iter().map(|(_, image)| image).take_while(|_| keep_going());
        in_turn.find(|&image| self.try_register(image, min_inliers))
    }

    /// Schönberger and Frahm's score: over pyramid levels of 2^l x 2^l cells, the occupied cells weighted by their number a
    /// side, so that points spread over the image count more than as many in one corner.
    fn visibility_score(&self, image: ImageId, visible: &[(KeypointIdx, Point3dId)]) -> u64 {
        let input = &self.input.images[&image];
        let camera = &self.input.cameras[&input.camera];
        let side = 1usize << PYRAMID_LEVELS;
        let mut occupied = vec![false; side * side];
        for &(keypoint, _) in visible {
            let at = input.keypoints[keypoint.index()].0;
            let cell = |x: f64, size: u32| ((x / f64::from(size) * side as f64) as usize).min(side - 1);
            occupied[cell(at.y, camera.height) * side + cell(at.x, camera.width)] = true;
        }
        let mut score = 0;
        let mut width = side;
        while width > 1 {
            score += (occupied.iter().filter(|&&cell| cell).count() * width) as u64;
            let half = width / 2;
            let mut coarser = vec![false; half * half];
            for row in 0..width {
                for column in 0..width {
                    coarser[(row / 2) * half + column / 2] |= occupied[row * width + column];
                }
            }
            occupied = coarser;
            width = half;
        }
        score
    }

    /// Estimates the pose of an image from the points it sees and registers it.
    fn try_register(&mut self, image: ImageId, min_inliers: usize) -> bool {
        let trial = self.trials.entry(image).or_insert(0);
        *trial += 1;
        let trial = *trial;
        let visible = self.visible_points(image);
        let input = &self.input.images[&image];
        let points: Vec<Vector3<f64>> =
            visible.iter().map(|&(_, id)| self.model.point(id).map(|point| point.xyz).unwrap_or_default()).collect();
        let pixels: Vec<Pixel> = visible.iter().map(|&(keypoint, _)| input.keypoints[keypoint.index()]).collect();
        let own = &self.model.cameras[&input.camera];
        let shareable = cameras_to_share(&self.model, input.camera, own);
        let mut options = self.options.pose.clone();
        options.threshold_px *= self.options.keep_limits().threshold_scale(own);
        options.min_inliers = min_inliers;
        if self.model.images().len() <= self.options.intrinsics.min_model_images_for_focal {
            // The shared focal length itself may still be a guess: it is no measure of others.
            options.sharing.min_matches = usize::MAX;
        }
        let mut rng = Rng::from_parts(&[self.run.seed, STREAM, u64::from(image.0), u64::from(trial)]);
        let placed = if shareable.is_empty() {
            let pose = absolute_pose::estimate(&points, &pixels, own, &options, &mut rng);
            pose.map(|pose| (Some(input.camera), pose))
        } else {
            let cameras: Vec<Camera> = shareable.iter().map(|id| self.model.cameras[id].clone()).collect();
            let placed = absolute_pose::estimate_sharing(&points, &pixels, &cameras, &options, &mut rng);
            placed.map(|placed| (placed.shares.map(|at| shareable[at]), placed.pose))
        };
        let Some((camera, pose)) = placed else {
            self.failures.insert(image, Unregistered::PoseFailed { visible: visible.len(), inliers: 0 });
            return false;
        };
        let inliers = pose.inliers.iter().filter(|&&inlier| inlier).count();
        if self.rotations.contradicts_pose(
            &self.model,
            image,
            &pose.cam_from_world,
            inliers,
            &self.options.rotation_cycles,
        ) {
            self.failures.insert(image, Unregistered::TurnedOtherwise { visible: visible.len(), inliers });
            return false;
        }
        let camera = match camera {
            Some(shared) => {
                if shareable.is_empty() {
                    self.model.cameras.insert(shared, pose.camera);
                }
                shared
            }
            None => add_camera(&mut self.model, pose.camera),
        };
        self.model.register(image, camera, pose.cam_from_world, input.keypoints.clone());
        let max_error_px = self.max_error_px(&self.model.cameras[&camera]);
        for (&(keypoint, point), &inlier) in visible.iter().zip(&pose.inliers) {
            let seen = Observation { image, keypoint };
            if inlier {
                self.model.add_observation(point, seen);
                if self.model.reprojection_error_px(point, seen) > max_error_px {
                    self.model.remove_observation(point, seen);
                }
            }
        }
        self.failures.remove(&image);
        true
    }
}
