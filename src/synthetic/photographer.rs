//! Takes the features of a scene image by image, so that sets of thousands of images need the memory of one.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::layout::SurfacePoint;
use super::scene::{SceneOptions, Stream};
use crate::camera::{Camera, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::{
    CameraId, DESCRIPTOR_LEN, Descriptor, Features, ImageId, Keypoint, KeypointIdx, Observation, Reconstruction,
};

/// A position undistorted again may differ from what was distorted by this, in units of the focal length, before it counts as
/// folded back by the distortion.
const MAX_FOLD: f64 = 1e-6;

/// A scene ready to be photographed. Images may be taken in any order and in parallel: each depends on its number only.
pub struct Photographer<'a> {
    options: &'a SceneOptions,
    cameras: BTreeMap<CameraId, Camera>,
    points: Vec<Appearance>,
}

/// What an image is besides its features: its place and what its keypoints see.
#[derive(Clone, Debug)]
pub struct Picture {
    /// Its intrinsics.
    pub camera: CameraId,
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// Position of every keypoint, with its noise.
    pub pixels: Arc<[Pixel]>,
    /// Rank of the surface point that each keypoint sees; none for distractors.
    points: Vec<Option<u32>>,
}

/// What all sightings of a point share, but for its look, which is large and made anew for each.
struct Appearance {
    surface: SurfacePoint,
    size: f64,
    orientation: f32,
    color: [u8; 3],
}

/// A keypoint before its image's features are sorted.
struct Sighting {
    keypoint: Keypoint,
    pixel: Pixel,
    descriptor: Descriptor,
    point: Option<u32>,
}

/// The expected value of every entry of a descriptor, up to scale.
type Look = [f64; DESCRIPTOR_LEN];

impl<'a> Photographer<'a> {
    /// Lays out the scene of these options.
    pub fn new(options: &'a SceneOptions) -> Self {
        let num_cameras = match options.shared_camera {
            true if options.zoom == 1.0 => 1,
            true => 2,
            false => options.num_images,
        };
        let cameras = (0..num_cameras).map(|id| {
            let factor = match options.shared_camera {
                true => [1.0, options.zoom][id],
                false => 1.0 + 0.05 * Stream::Camera.rng(options, id).range(-1.0, 1.0),
            };
            (CameraId(id as u32), camera(options, factor))
        });
        let points = (0..options.num_points).map(|id| appearance(options, id).0).collect();
        Self { options, cameras: cameras.collect(), points }
    }

    /// The intrinsics of the images.
    pub fn cameras(&self) -> &BTreeMap<CameraId, Camera> {
        &self.cameras
    }

    /// Image `index` and its features.
    pub fn photograph(&self, index: usize) -> (Picture, Features) {
        let options = self.options;
        let camera = CameraId((index % self.cameras.len()) as u32);
        let pose = options.layout.pose(index, options.num_images, &mut Stream::Pose.rng(options, index));
        let sightings = self.sightings(&self.cameras[&camera], &pose, &mut Stream::Image.rng(options, index));
        let picture = Picture {
            camera,
            cam_from_world: pose,
            pixels: sightings.iter().map(|sighting| sighting.pixel).collect(),
            points: sightings.iter().map(|sighting| sighting.point).collect(),
        };
        let features = Features {
            keypoints: sightings.iter().map(|sighting| sighting.keypoint).collect(),
            descriptors: sightings.iter().map(|sighting| sighting.descriptor).collect(),
        };
        (picture, features)
    }

    /// The true model of all images, given in order.
    pub fn truth(&self, pictures: Vec<Picture>) -> Reconstruction {
        let mut truth = Reconstruction::new(self.cameras.clone());
        let mut tracks = vec![Vec::new(); self.points.len()];
        for (image, picture) in (0u32..).map(ImageId).zip(pictures) {
            for (keypoint, point) in (0u32..).map(KeypointIdx).zip(&picture.points) {
                if let Some(point) = *point {
                    tracks[point as usize].push(Observation { image, keypoint });
                }
            }
            truth.register(image, picture.camera, picture.cam_from_world, picture.pixels);
        }
        for (point, track) in self.points.iter().zip(tracks) {
            if track.len() >= 2 {
                truth.add_point(point.surface.xyz, track, point.color);
            }
        }
        truth
    }

    /// Everything an image detects, sorted as [`Features`] asks.
    fn sightings(&self, camera: &Camera, pose: &Rigid3, rng: &mut Rng) -> Vec<Sighting> {
        let options = self.options;
        let (width, height) = (f64::from(options.width), f64::from(options.height));
        let center = pose.target_origin_in_source();
        let mut sightings = Vec::new();
        for (id, point) in self.points.iter().enumerate() {
            let detected = rng.uniform() < options.detection_ratio;
            let gross = rng.uniform() < options.gross_error_ratio;
            let error = rng.range(20.0, 100.0);
            let angle = rng.range(0.0, std::f64::consts::TAU);
            let noise = nalgebra::Vector2::new(rng.normal(), rng.normal()) * options.pixel_noise_px;
            if !detected || !point.surface.faces(&center) {
                continue;
            }
            let x_in_cam = pose.apply(&point.surface.xyz);
            let Some(exact) = camera.project(&x_in_cam) else { continue };
            if !(0.0..width).contains(&exact.0.x) || !(0.0..height).contains(&exact.0.y) {
                continue;
            }
            // Far outside the field of view a distortion polynomial turns back and puts points into the picture that no lens
            // shows there.
            let seen_at = camera.unproject(&exact).0 - x_in_cam.xy() / x_in_cam.z;
            if seen_at.norm() > MAX_FOLD {
                continue;
            }
            let displacement = if gross {
                nalgebra::Vector2::new(angle.cos(), angle.sin()) * error
            } else {
                nalgebra::Vector2::zeros()
            };
            let pixel = Pixel(exact.0 + noise + displacement);
            let scale = (point.size * camera.mean_focal_px() / x_in_cam.z) as f32;
            let descriptor = describe(&appearance(options, id).1, options.descriptor_noise, rng);
            sightings.push(sighting(pixel, scale, point.orientation, descriptor, Some(id as u32)));
        }
        for _ in 0..(options.distractor_ratio * sightings.len() as f64) as usize {
            let pixel = Pixel::new(rng.range(0.0, width), rng.range(0.0, height));
            let scale = (2.0 * (0.5 * rng.normal()).exp()) as f32;
            let orientation = rng.range(0.0, std::f64::consts::TAU) as f32;
            let look = random_look(rng);
            sightings.push(sighting(pixel, scale, orientation, describe(&look, 0.0, rng), None));
        }
        sightings.sort_by(|a, b| {
            let (a, b) = (&a.keypoint, &b.keypoint);
            b.scale
                .total_cmp(&a.scale)
                .then(a.y.total_cmp(&b.y))
                .then(a.x.total_cmp(&b.x))
                .then(a.orientation.total_cmp(&b.orientation))
        });
        sightings
    }
}

fn camera(options: &SceneOptions, focal_factor: f64) -> Camera {
    let focal_px = options.focal_px * focal_factor;
    let mut camera =
        Camera::centered(options.camera_model, options.width, options.height, focal_px, FocalSource::Known);
    let at = camera.model.distortion_index();
    let n = camera.model.num_params() - at;
    camera.params[at..at + n].copy_from_slice(&options.distortion[..n]);
    camera
}

/// A point and its look.
fn appearance(options: &SceneOptions, id: usize) -> (Appearance, Look) {
    let rng = &mut Stream::Point.rng(options, id);
    let surface = options.layout.point(options.num_images, rng);
    let size = 0.01 * (0.5 * rng.normal()).exp();
    let orientation = rng.range(0.0, std::f64::consts::TAU) as f32;
    let look = random_look(rng);
    let color = std::array::from_fn(|_| rng.below(256) as u8);
    (Appearance { surface, size, orientation, color }, look)
}

fn random_look(rng: &mut Rng) -> Look {
    std::array::from_fn(|_| rng.uniform().powi(4))
}

/// The quantised RootSIFT descriptor of a look with relative noise.
fn describe(look: &Look, noise: f64, rng: &mut Rng) -> Descriptor {
    let noisy: Look = std::array::from_fn(|i| (look[i] * (1.0 + noise * rng.normal())).max(0.0));
    let sum: f64 = noisy.iter().sum();
    std::array::from_fn(|i| (512.0 * (noisy[i] / sum).sqrt()).round().min(255.0) as u8)
}

fn sighting(pixel: Pixel, scale: f32, orientation: f32, descriptor: Descriptor, point: Option<u32>) -> Sighting {
    let keypoint = Keypoint { x: pixel.0.x as f32, y: pixel.0.y as f32, scale, orientation };
    Sighting { keypoint, pixel, descriptor, point }
}
