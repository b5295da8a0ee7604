//! The registered images as triangulation needs them: by rank, with their allowances in pixels.

use nalgebra::{UnitQuaternion, Vector3};

use super::options::{PixelScaling, TriangulationOptions};
use crate::camera::{Camera, Normalized, Pixel};
use crate::geometry::Rigid3;
use crate::geometry::triangulation::triangulation_angle_rad;
use crate::scene::{ImageId, KeypointIdx, Observation, Reconstruction, RegisteredImage};

/// A keypoint of the image of some rank; ordered as [`Observation`]s are.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Sighting {
    /// Rank of the image in the table.
    pub rank: u32,
    /// The keypoint.
    pub keypoint: KeypointIdx,
}

/// The registered images of a model, in id order.
pub struct ViewTable<'a> {
    ids: Vec<ImageId>,
    views: Vec<TableView<'a>>,
    /// The first node of each image when the keypoints of all images are numbered through, and their number at the end.
    first_node: Vec<usize>,
}

struct TableView<'a> {
    image: &'a RegisteredImage,
    camera: &'a Camera,
    center_in_world: Vector3<f64>,
    world_from_cam: UnitQuaternion<f64>,
    max_error_px: f64,
    max_two_view_error_px: f64,
}

impl<'a> ViewTable<'a> {
    /// Of all registered images.
    pub fn new(model: &'a Reconstruction, options: &TriangulationOptions, scaling: &PixelScaling) -> Self {
        let mut first_node = vec![0];
        let mut views = Vec::with_capacity(model.images().len());
        for (&id, image) in model.images() {
            let camera = model.camera_of(id);
            let px_scale = scaling.factor(camera);
            views.push(TableView {
                image,
                camera,
                center_in_world: image.center_in_world(),
                world_from_cam: image.cam_from_world.rotation.inverse(),
                max_error_px: options.max_reprojection_error_px * px_scale,
                max_two_view_error_px: options.max_two_view_error_px * px_scale,
            });
            first_node.push(first_node[first_node.len() - 1] + image.keypoints.len());
        }
        Self { ids: model.images().keys().copied().collect(), views, first_node }
    }

    /// Number of images.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether no image is registered.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }

    /// The rank of an image; none when it is not registered.
    pub fn rank(&self, id: ImageId) -> Option<u32> {
        self.ids.binary_search(&id).ok().map(|rank| rank as u32)
    }

    /// The image of a rank.
    pub fn image(&self, rank: u32) -> &'a RegisteredImage {
        self.views[rank as usize].image
    }

    /// A model's observation as a sighting.
    ///
    /// # Panics
    /// When its image is not registered.
    pub fn sighting(&self, observation: &Observation) -> Sighting {
        let rank = self.rank(observation.image).expect("an observation's image is registered");
        Sighting { rank, keypoint: observation.keypoint }
    }

    /// A sighting as a model's observation.
    pub fn observation(&self, seen: Sighting) -> Observation {
        Observation { image: self.ids[seen.rank as usize], keypoint: seen.keypoint }
    }

    /// The number of a sighting among all keypoints of all images.
    pub fn node(&self, seen: Sighting) -> usize {
        self.first_node[seen.rank as usize] + seen.keypoint.index()
    }

    /// Number of keypoints of all images.
    pub fn num_nodes(&self) -> usize {
        self.first_node[self.ids.len()]
    }

    /// The squared reprojection error of a point, in units of the image's squared allowance: 1 is just allowed. Infinite for
    /// a point not in front of the camera.
    #[inline]
    pub fn relative_error_sq(&self, seen: Sighting, xyz: &Vector3<f64>) -> f64 {
        let view = &self.views[seen.rank as usize];
        self.error_sq_px(seen, xyz) / (view.max_error_px * view.max_error_px)
    }

    /// The sightings, of these, whose reprojection errors are allowed.
    pub fn agreeing(&self, track: &[Sighting], xyz: &Vector3<f64>) -> Vec<Sighting> {
        track.iter().copied().filter(|&seen| self.relative_error_sq(seen, xyz) <= 1.0).collect()
    }

    /// Whether a point's reprojection error is small enough for a point with two sightings.
    pub fn fits_two_view(&self, seen: Sighting, xyz: &Vector3<f64>) -> bool {
        self.error_sq_px(seen, xyz).sqrt() <= self.views[seen.rank as usize].max_two_view_error_px
    }

    fn error_sq_px(&self, seen: Sighting, xyz: &Vector3<f64>) -> f64 {
        let view = &self.views[seen.rank as usize];
        match view.camera.project(&view.image.cam_from_world.apply(xyz)) {
            Some(pixel) => (pixel.0 - view.image.keypoints[seen.keypoint.index()].0).norm_squared(),
            None => f64::INFINITY,
        }
    }

    /// Pose and normalised position of a sighting.
    pub fn view(&self, seen: Sighting) -> (Rigid3, Normalized) {
        let view = &self.views[seen.rank as usize];
        let pixel: &Pixel = &view.image.keypoints[seen.keypoint.index()];
        (view.image.cam_from_world, view.camera.unproject(pixel))
    }

    /// Centre and direction, in the world, of the ray through a sighting; the direction has z = 1 in the camera.
    pub fn ray(&self, seen: Sighting) -> (Vector3<f64>, Vector3<f64>) {
        let view = &self.views[seen.rank as usize];
        let normalized = view.camera.unproject(&view.image.keypoints[seen.keypoint.index()]);
        (view.center_in_world, view.world_from_cam * normalized.homogeneous())
    }

    /// Whether the rays of any two sightings meet at a point at an angle of at least this.
    pub fn has_angle(&self, track: &[Sighting], xyz: &Vector3<f64>, min_angle_rad: f64) -> bool {
        let center = |seen: &Sighting| &self.views[seen.rank as usize].center_in_world;
        track.iter().enumerate().any(|(later, a)| {
            track[..later].iter().any(|b| triangulation_angle_rad(center(a), center(b), xyz) >= min_angle_rad)
        })
    }
}
