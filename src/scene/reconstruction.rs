//! A model: cameras, registered images and points, with both directions of every track kept consistent.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{ApartImages, CameraId, ImageId, KeypointIdx, Point3dId};
use crate::camera::{Camera, Pixel};
use crate::geometry::Rigid3;

/// One sighting of a point: keypoint `keypoint` of image `image`.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Serialize, Deserialize)]
pub struct Observation {
    /// The image.
    pub image: ImageId,
    /// The keypoint in it.
    pub keypoint: KeypointIdx,
}

/// An image with a pose.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct RegisteredImage {
    /// Its intrinsics.
    pub camera: CameraId,
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// Position of every keypoint, in pixels of the original image.
    pub keypoints: Arc<[Pixel]>,
    /// The point each keypoint sees, if any. Kept by [`Reconstruction`].
    pub(super) points: Vec<Option<Point3dId>>,
}

impl RegisteredImage {
    /// The point each keypoint sees, if any.
    pub fn points(&self) -> &[Option<Point3dId>] {
        &self.points
    }

    /// Number of keypoints that see a point.
    pub fn num_observations(&self) -> usize {
        self.points.iter().flatten().count()
    }

    /// The centre of the camera in the world.
    pub fn center_in_world(&self) -> Vector3<f64> {
        self.cam_from_world.target_origin_in_source()
    }
}

/// A triangulated point.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Point3d {
    /// Position in the world.
    pub xyz: Vector3<f64>,
    /// Its sightings, sorted; at most one an image.
    pub track: Vec<Observation>,
    /// Red, green, blue.
    pub color: [u8; 3],
}

/// A model. World coordinates have an arbitrary frame and scale unless a later step fixes them.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Reconstruction {
    /// Intrinsics by id.
    pub cameras: BTreeMap<CameraId, Camera>,
    /// Images, registered or not, that show different places that look alike: no track joins two of them.
    pub apart: ApartImages,
    pub(super) images: BTreeMap<ImageId, RegisteredImage>,
    pub(super) points: Vec<Option<Point3d>>,
    pub(super) num_points: usize,
}

impl Reconstruction {
    /// An empty model with these cameras.
    pub fn new(cameras: BTreeMap<CameraId, Camera>) -> Self {
        Self { cameras, ..Self::default() }
    }

    /// The cameras that registered images use, by id.
    pub fn used_cameras(&self) -> BTreeMap<CameraId, &Camera> {
        self.images.values().map(|image| (image.camera, &self.cameras[&image.camera])).collect()
    }

    /// The registered images by id.
    pub fn images(&self) -> &BTreeMap<ImageId, RegisteredImage> {
        &self.images
    }

    /// A registered image.
    pub fn image(&self, id: ImageId) -> Option<&RegisteredImage> {
        self.images.get(&id)
    }

    /// The intrinsics of a registered image.
    ///
    /// # Panics
    /// When the image is not registered.
    pub fn camera_of(&self, id: ImageId) -> &Camera {
        &self.cameras[&self.images[&id].camera]
    }

    /// Registers an image without sightings.
    ///
    /// # Panics
    /// When it is registered already or its camera is unknown.
    pub fn register(&mut self, id: ImageId, camera: CameraId, cam_from_world: Rigid3, keypoints: Arc<[Pixel]>) {
        assert!(self.cameras.contains_key(&camera), "image {id:?} names an unknown camera {camera:?}");
        let points = vec![None; keypoints.len()];
        let before = self.images.insert(id, RegisteredImage { camera, cam_from_world, keypoints, points });
        assert!(before.is_none(), "image {id:?} is registered twice");
    }

    /// Takes an image out of the model, with its sightings; points left with fewer than two sightings go too.
    pub fn deregister(&mut self, id: ImageId) {
        let Some(image) = self.images.get(&id) else { return };
        let seen: Vec<(KeypointIdx, Point3dId)> =
            (0u32..).map(KeypointIdx).zip(&image.points).filter_map(|(k, p)| p.map(|p| (k, p))).collect();
        for (keypoint, point) in seen {
            self.remove_observation(point, Observation { image: id, keypoint });
        }
        self.images.remove(&id);
    }

    /// Sets the pose of a registered image.
    ///
    /// # Panics
    /// When it is not registered.
    pub fn set_pose(&mut self, id: ImageId, cam_from_world: Rigid3) {
        self.image_mut(id).cam_from_world = cam_from_world;
    }

    /// Moves a registered image to another camera.
    ///
    /// # Panics
    /// When the image or the camera is unknown.
    pub fn set_camera(&mut self, id: ImageId, camera: CameraId) {
        assert!(self.cameras.contains_key(&camera), "unknown camera {camera:?}");
        self.image_mut(id).camera = camera;
    }

    fn image_mut(&mut self, id: ImageId) -> &mut RegisteredImage {
        self.images.get_mut(&id).unwrap_or_else(|| panic!("image {id:?} is not registered"))
    }

    /// Number of points.
    pub fn num_points(&self) -> usize {
        self.num_points
    }

    /// One more than the largest point id ever given.
    pub fn point_id_bound(&self) -> usize {
        self.points.len()
    }

    /// A point.
    pub fn point(&self, id: Point3dId) -> Option<&Point3d> {
        self.points.get(id.index())?.as_ref()
    }

    /// All points, in id order.
    pub fn points(&self) -> impl Iterator<Item = (Point3dId, &Point3d)> {
        (0..).map(Point3dId::new).zip(&self.points).filter_map(|(id, point)| Some((id, point.as_ref()?)))
    }

    /// Adds a point with its sightings and returns its id.
    ///
    /// # Panics
    /// When a sighting is of an unregistered image, of a keypoint that already sees a point, or two are of one image.
    pub fn add_point(&mut self, xyz: Vector3<f64>, mut track: Vec<Observation>, color: [u8; 3]) -> Point3dId {
        track.sort_unstable();
        assert!(track.windows(2).all(|pair| pair[0].image != pair[1].image), "a track sees an image twice");
        let id = Point3dId::new(self.points.len());
        for observation in &track {
            let slot = &mut self.image_mut(observation.image).points[observation.keypoint.index()];
            assert!(slot.is_none(), "{observation:?} already sees a point");
            *slot = Some(id);
        }
        self.points.push(Some(Point3d { xyz, track, color }));
        self.num_points += 1;
        id
    }

    /// Moves a point.
    ///
    /// # Panics
    /// When there is no such point.
    pub fn set_xyz(&mut self, id: Point3dId, xyz: Vector3<f64>) {
        self.point_mut(id).xyz = xyz;
    }

    /// Colours a point.
    ///
    /// # Panics
    /// When there is no such point.
    pub fn set_color(&mut self, id: Point3dId, color: [u8; 3]) {
        self.point_mut(id).color = color;
    }

    fn point_mut(&mut self, id: Point3dId) -> &mut Point3d {
        self.points[id.index()].as_mut().unwrap_or_else(|| panic!("there is no point {id:?}"))
    }

    /// Removes a point and its sightings.
    pub fn remove_point(&mut self, id: Point3dId) {
        let Some(point) = self.points[id.index()].take() else { return };
        self.num_points -= 1;
        for observation in point.track {
            self.image_mut(observation.image).points[observation.keypoint.index()] = None;
        }
    }

    /// Adds a sighting to a point; false (and no change) when the track already sees the image, the keypoint already sees a
    /// point, or the track holds an image apart from this one.
    pub fn add_observation(&mut self, id: Point3dId, observation: Observation) -> bool {
        if self.image_mut(observation.image).points[observation.keypoint.index()].is_some() {
            return false;
        }
        if self.apart_from_track(observation.image, id) {
            return false;
        }
        let track = &mut self.point_mut(id).track;
        let at = track.partition_point(|seen| seen.image < observation.image);
        if track.get(at).is_some_and(|seen| seen.image == observation.image) {
            return false;
        }
        track.insert(at, observation);
        self.image_mut(observation.image).points[observation.keypoint.index()] = Some(id);
        true
    }

    /// Whether an image shows another place than one of those that see a point.
    pub fn apart_from_track(&self, image: ImageId, id: Point3dId) -> bool {
        !self.apart.is_empty()
            && self.point(id).is_some_and(|point| self.apart.from_any(image, point.track.iter().map(|seen| seen.image)))
    }

    /// Removes a sighting; a point left with fewer than two goes too.
    pub fn remove_observation(&mut self, id: Point3dId, observation: Observation) {
        let track = &mut self.point_mut(id).track;
        let Ok(at) = track.binary_search(&observation) else { return };
        track.remove(at);
        let remaining = track.len();
        self.image_mut(observation.image).points[observation.keypoint.index()] = None;
        if remaining < 2 {
            self.remove_point(id);
        }
    }

    /// Joins two points into the first, at `xyz`. False, without change, when both see one image or they see images apart.
    pub fn merge_points(&mut self, into: Point3dId, from: Point3dId, xyz: Vector3<f64>) -> bool {
        let (Some(a), Some(b)) = (self.point(into), self.point(from)) else { return false };
        if into == from || a.track.iter().any(|seen| b.track.iter().any(|other| other.image == seen.image)) {
            return false;
        }
        let track = b.track.clone();
        if track.iter().any(|seen| self.apart_from_track(seen.image, into)) {
            return false;
        }
        self.remove_point(from);
        for observation in track {
            self.add_observation(into, observation);
        }
        self.set_xyz(into, xyz);
        true
    }

    /// The reprojection error of a sighting in pixels; infinite where the point is not in front of the camera.
    ///
    /// # Panics
    /// When the point or the image is unknown.
    pub fn reprojection_error_px(&self, id: Point3dId, observation: Observation) -> f64 {
        let image = &self.images[&observation.image];
        self.error_px(image, &self.cameras[&image.camera], id, &image.keypoints[observation.keypoint.index()])
    }

    /// The point and the [`Reconstruction::reprojection_error_px`] of every sighting of an image, in order of its keypoints.
    ///
    /// # Panics
    /// When the image is unknown.
    pub fn errors_of_image_px(&self, id: ImageId) -> impl Iterator<Item = (Point3dId, f64)> {
        let image = &self.images[&id];
        let camera = &self.cameras[&image.camera];
        let seen = image.points.iter().zip(image.keypoints.iter());
        seen.filter_map(move |(&point, keypoint)| {
            point.map(|point| (point, self.error_px(image, camera, point, keypoint)))
        })
    }

    /// The reprojection error of every sighting of every point, image by image; images are shared out among threads.
    pub fn reprojection_errors_px(&self) -> Vec<f64> {
        let of_image = |(&id, _)| self.errors_of_image_px(id).map(|(_, error_px)| error_px);
        self.images.par_iter().flat_map_iter(of_image).collect()
    }

    fn error_px(&self, image: &RegisteredImage, camera: &Camera, id: Point3dId, keypoint: &Pixel) -> f64 {
        let point = self.points[id.index()].as_ref().expect("the point of a sighting exists");
        match camera.project(&image.cam_from_world.apply(&point.xyz)) {
            Some(pixel) => (pixel.0 - keypoint.0).norm(),
            None => f64::INFINITY,
        }
    }

    /// Number of sightings.
    pub fn num_observations(&self) -> usize {
        self.points().map(|(_, point)| point.track.len()).sum()
    }

    /// Number of points with at least three sightings.
    pub fn num_points_3plus(&self) -> usize {
        self.points().filter(|(_, point)| point.track.len() >= 3).count()
    }

    /// Checks that both directions of every track agree; for tests.
    ///
    /// # Panics
    /// When they do not.
    pub fn assert_consistent(&self) {
        let mut sightings = 0;
        for (id, point) in self.points() {
            assert!(point.track.len() >= 2, "point {id:?} has a track of {}", point.track.len());
            assert!(!point.track.iter().any(|seen| self.apart_from_track(seen.image, id)), "{id:?} joins images apart");
            for seen in &point.track {
                assert_eq!(self.images[&seen.image].points[seen.keypoint.index()], Some(id));
            }
            sightings += point.track.len();
        }
        assert_eq!(sightings, self.images.values().map(RegisteredImage::num_observations).sum::<usize>());
        assert_eq!(self.num_points, self.points().count());
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{CameraModel, FocalSource};

    fn two_images() -> Reconstruction {
        let camera = Camera::centered(CameraModel::SimpleRadial, 100, 100, 100.0, FocalSource::Guess);
        let mut model = Reconstruction::new(BTreeMap::from([(CameraId(0), camera)]));
        let keypoints: Arc<[Pixel]> = vec![Pixel::new(50.0, 50.0), Pixel::new(60.0, 50.0)].into();
        for id in 0..3 {
            model.register(ImageId(id), CameraId(0), Rigid3::identity(), keypoints.clone());
        }
        model
    }

    fn seen(image: u32, keypoint: u32) -> Observation {
        Observation { image: ImageId(image), keypoint: KeypointIdx(keypoint) }
    }

    #[test]
    fn no_track_joins_images_apart() {
        let mut model = two_images();
        model.apart = [(ImageId(2), ImageId(0))].into_iter().collect();
        let a = model.add_point(Vector3::new(0.0, 0.0, 1.0), vec![seen(0, 0), seen(1, 0)], [0; 3]);
        assert!(!model.add_observation(a, seen(2, 0)));
        let b = model.add_point(Vector3::new(0.1, 0.0, 1.0), vec![seen(1, 1), seen(2, 1)], [0; 3]);
        assert!(!model.add_observation(b, seen(0, 1)));
        model.remove_observation(a, seen(1, 0));
        assert!(!model.merge_points(b, a, Vector3::zeros()));
        model.assert_consistent();
    }

    #[test]
    fn tracks_stay_consistent() {
        let mut model = two_images();
        let a = model.add_point(Vector3::new(0.0, 0.0, 1.0), vec![seen(1, 0), seen(0, 0)], [0; 3]);
        assert!(model.add_observation(a, seen(2, 0)) && !model.add_observation(a, seen(2, 1)));
        let b = model.add_point(Vector3::new(0.1, 0.0, 1.0), vec![seen(0, 1), seen(1, 1)], [0; 3]);
        assert!(!model.merge_points(a, b, Vector3::zeros()), "both see image 0");
        model.assert_consistent();
        assert!(model.reprojection_error_px(b, seen(0, 1)) < 1e-9);
        model.remove_observation(b, seen(0, 1));
        assert!(model.point(b).is_none());
        model.deregister(ImageId(0));
        model.assert_consistent();
        assert_eq!(model.point(a).unwrap().track, vec![seen(1, 0), seen(2, 0)]);
    }
}
