//! A COLMAP model as its files have it, and as our own.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;

use crate::camera::{Camera, Pixel};
use crate::formats::FormatError;
use crate::geometry::Rigid3;
use crate::scene::{CameraId, ImageId, KeypointIdx, Observation, Reconstruction};

/// A model as its files have it, with their ids.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ColmapModel {
    /// Intrinsics by camera id.
    pub cameras: BTreeMap<u32, Camera>,
    /// Registered images by image id.
    pub images: BTreeMap<u32, ColmapImage>,
    /// Points by point id.
    pub points: BTreeMap<u64, ColmapPoint>,
}

/// A registered image.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapImage {
    /// Its camera's id.
    pub camera_id: u32,
    /// Its name, usually a path relative to a folder of images.
    pub name: String,
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// Its keypoints.
    pub points2d: Vec<ColmapPoint2d>,
}

/// A keypoint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ColmapPoint2d {
    /// Where it is.
    pub pixel: Pixel,
    /// The id of the point it sees.
    pub point_id: Option<u64>,
}

/// A point.
#[derive(Clone, Debug, PartialEq)]
pub struct ColmapPoint {
    /// Position in the world.
    pub xyz: Vector3<f64>,
    /// Red, green, blue.
    pub color: [u8; 3],
    /// Mean reprojection error in pixels.
    pub error_px: f64,
    /// Its sightings: image id and rank of the keypoint.
    pub track: Vec<(u32, u32)>,
}

const FILE: &str = "COLMAP model";

impl ColmapModel {
    /// The model as a [`Reconstruction`], and the names of its images: ids are those of the files less one, points are numbered
    /// in the order of their ids.
    ///
    /// # Errors
    /// When ids dangle, or a track sees an image twice or a keypoint that another has.
    pub fn into_reconstruction(self) -> Result<(Reconstruction, BTreeMap<ImageId, String>), FormatError> {
        let malformed = |message: String| FormatError::malformed(FILE, message);
        let zero_based = |id: u32| id.checked_sub(1).ok_or_else(|| malformed("an id is 0".into()));
        let mut cameras = BTreeMap::new();
        for (id, camera) in self.cameras {
            cameras.insert(CameraId(zero_based(id)?), camera);
        }
        let mut model = Reconstruction::new(cameras);
        let mut names = BTreeMap::new();
        for (id, image) in self.images {
            let (image_id, camera) = (ImageId(zero_based(id)?), CameraId(zero_based(image.camera_id)?));
            if !model.cameras.contains_key(&camera) {
                return Err(malformed(format!("image {id} names the unknown camera {}", image.camera_id)));
            }
            let keypoints: Arc<[Pixel]> = image.points2d.iter().map(|point| point.pixel).collect();
            model.register(image_id, camera, image.cam_from_world, keypoints);
            names.insert(image_id, image.name);
        }
        for (id, point) in self.points {
            let mut track = Vec::new();
            for (image, keypoint) in point.track {
                let seen = Observation { image: ImageId(zero_based(image)?), keypoint: KeypointIdx(keypoint) };
                let free = model.image(seen.image).and_then(|image| image.points().get(seen.keypoint.index()));
                if free != Some(&None) {
                    return Err(malformed(format!("point {id} sees a keypoint that is absent or taken")));
                }
                track.push(seen);
            }
            track.sort_unstable();
            if track.windows(2).any(|pair| pair[0].image == pair[1].image) {
                return Err(malformed(format!("point {id} sees an image twice")));
            }
            model.add_point(point.xyz, track, point.color);
        }
        Ok((model, names))
    }
}
