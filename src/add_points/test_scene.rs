//! A small scene with known truth for this stage's tests: cameras in an arc before a wall in relief.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::{UnitQuaternion, Vector3};

use super::{
    AddPointsError, AddPointsOptions, AddPointsReport, Cancelled, LoadFeatures, PairMatcher, add_matches,
    candidate_pairs, tiles,
};
use crate::camera::{Camera, CameraModel, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::{
    CameraId, DESCRIPTOR_LEN, Descriptor, Features, ImageId, Keypoint, KeypointIdx, Observation, Reconstruction,
};

/// What to build.
pub struct SceneSpec {
    pub images: usize,
    pub points: usize,
    /// Features of each image that show no point.
    pub clutter: usize,
    /// Of how many kinds these are: none, or noisy copies of so many descriptors.
    pub clutter_kinds: Option<usize>,
    pub pixel_noise: f64,
    /// Standard deviation of each byte of a descriptor.
    pub descriptor_noise: f64,
    /// Points with equal descriptors: none, or one description for every so many neighbouring points.
    pub repeat_every: Option<usize>,
    pub seed: u64,
}

impl Default for SceneSpec {
    fn default() -> Self {
        Self {
            images: 6,
            points: 1500,
            clutter: 500,
            clutter_kinds: None,
            pixel_noise: 0.5,
            descriptor_noise: 6.0,
            repeat_every: None,
            seed: 1,
        }
    }
}

/// A scene and its truth.
pub struct TestScene {
    pub points: Vec<Vector3<f64>>,
    /// Features of every image.
    pub features: Vec<Arc<Features>>,
    /// The point each keypoint shows.
    pub truth: Vec<Vec<Option<usize>>>,
    /// All images registered with true poses; no points.
    pub posed: Reconstruction,
}

pub fn random_descriptor(rng: &mut Rng) -> Descriptor {
    // Like a gradient histogram: most bins small, a few large.
    let mut values = [0.0; DESCRIPTOR_LEN];
    values.iter_mut().for_each(|value| *value = -rng.uniform().max(1e-9).ln());
    quantised(&values)
}

fn quantised(values: &[f64; DESCRIPTOR_LEN]) -> Descriptor {
    let norm = values.iter().map(|v| v * v).sum::<f64>().sqrt();
    values.map(|v| (v / norm * 512.0).round().clamp(0.0, 255.0) as u8)
}

fn disturbed(descriptor: &Descriptor, noise: f64, rng: &mut Rng) -> Descriptor {
    quantised(&descriptor.map(|byte| (f64::from(byte) + noise * rng.normal()).max(0.0)))
}

fn camera() -> Camera {
    let mut camera = Camera::centered(CameraModel::OpenCv, 1600, 1200, 1400.0, FocalSource::Known);
    camera.params[4..8].copy_from_slice(&[-0.1, 0.02, 0.001, -0.0005]);
    camera
}

/// Cameras 5 units before the wall, 0.6 apart, converging, each rolled a little.
fn pose(at: usize, images: usize, rng: &mut Rng) -> Rigid3 {
    let along = (at as f64 - (images as f64 - 1.0) / 2.0) * 0.6;
    let center = Vector3::new(along, 0.3 * rng.normal(), -5.0 + 0.2 * rng.normal());
    let turn = Vector3::new(-0.05 * center.y, along * 0.15, 0.1 * rng.normal());
    Rigid3::from_center(UnitQuaternion::from_scaled_axis(turn), &center)
}

pub fn build(spec: &SceneSpec) -> TestScene {
    let mut rng = Rng::from_parts(&[spec.seed]);
    let points: Vec<Vector3<f64>> = (0..spec.points)
        .map(|_| Vector3::new(rng.range(-3.0, 3.0), rng.range(-2.0, 2.0), rng.range(0.0, 1.0)))
        .collect();
    let kinds = spec.repeat_every.unwrap_or(spec.points);
    let kinds: Vec<Descriptor> = (0..kinds).map(|_| random_descriptor(&mut rng)).collect();
    let clutter_kinds: Vec<Descriptor> =
        (0..spec.clutter_kinds.unwrap_or(0)).map(|_| random_descriptor(&mut rng)).collect();
    let sizes: Vec<f64> = (0..spec.points).map(|_| 0.004 / rng.uniform().max(0.02)).collect();
    let turns: Vec<f64> = (0..spec.points).map(|_| rng.range(0.0, std::f64::consts::TAU)).collect();
    let camera = camera();
    let mut posed = Reconstruction::new(BTreeMap::from([(CameraId(0), camera.clone())]));
    let (mut features, mut truth) = (Vec::new(), Vec::new());
    for image in 0..spec.images {
        let cam_from_world = pose(image, spec.images, &mut rng);
        let mut seen: Vec<(Keypoint, Descriptor, Option<usize>)> = Vec::new();
        let (roll, ..) = cam_from_world.rotation.inverse().euler_angles();
        for (index, point) in points.iter().enumerate() {
            let x_in_cam = cam_from_world.apply(point);
            let Some(pixel) = camera.project(&x_in_cam) else { continue };
            let at = pixel.0 + nalgebra::Vector2::new(rng.normal(), rng.normal()) * spec.pixel_noise;
            if !(0.0..1600.0).contains(&at.x) || !(0.0..1200.0).contains(&at.y) {
                continue;
            }
            let scale = sizes[index] * camera.mean_focal_px() / x_in_cam.z;
            let orientation = (turns[index] + roll).rem_euclid(std::f64::consts::TAU);
            let keypoint = keypoint(at.x, at.y, scale, orientation);
            seen.push((keypoint, disturbed(&kinds[index % kinds.len()], spec.descriptor_noise, &mut rng), Some(index)));
        }
        for _ in 0..spec.clutter {
            let scale = 0.3 / rng.uniform().max(0.02);
            let keypoint = keypoint(rng.range(0.0, 1600.0), rng.range(0.0, 1200.0), scale, rng.range(0.0, 6.0));
            let descriptor = if clutter_kinds.is_empty() {
                random_descriptor(&mut rng)
            } else {
                disturbed(&clutter_kinds[rng.below(clutter_kinds.len())], spec.descriptor_noise, &mut rng)
            };
            seen.push((keypoint, descriptor, None));
        }
        seen.sort_by(|a, b| b.0.scale.total_cmp(&a.0.scale));
        let keypoints: Arc<[Pixel]> =
            seen.iter().map(|(k, ..)| Pixel::new(f64::from(k.x), f64::from(k.y))).collect::<Vec<_>>().into();
        posed.register(ImageId(image as u32), CameraId(0), cam_from_world, keypoints);
        truth.push(seen.iter().map(|&(_, _, point)| point).collect());
        let (keypoints, descriptors) = seen.into_iter().map(|(keypoint, descriptor, _)| (keypoint, descriptor)).unzip();
        features.push(Arc::new(Features { keypoints, descriptors }));
    }
    TestScene { points, features, truth, posed }
}

fn keypoint(x: f64, y: f64, scale: f64, orientation: f64) -> Keypoint {
    Keypoint { x: x as f32, y: y as f32, scale: scale as f32, orientation: orientation as f32 }
}

impl TestScene {
    /// The model with the true points among the keypoints of each image's largest scales, seen by at least two images.
    pub fn coarse(&self, fraction: f64) -> Reconstruction {
        let mut tracks: BTreeMap<usize, Vec<Observation>> = BTreeMap::new();
        for (image, truth) in self.truth.iter().enumerate() {
            let top = (truth.len() as f64 * fraction) as usize;
            for (keypoint, point) in truth[..top].iter().enumerate() {
                if let Some(point) = point {
                    tracks.entry(*point).or_default().push(self.observation(image, keypoint));
                }
            }
        }
        let mut model = self.posed.clone();
        for (point, track) in tracks {
            if track.len() >= 2 {
                model.add_point(self.points[point], track, [9; 3]);
            }
        }
        model
    }

    pub fn observation(&self, image: usize, keypoint: usize) -> Observation {
        Observation { image: ImageId(image as u32), keypoint: KeypointIdx(keypoint as u32) }
    }

    /// The keypoint of an image that shows a point.
    pub fn keypoint_of(&self, image: usize, point: usize) -> Option<usize> {
        self.truth[image].iter().position(|&shown| shown == Some(point))
    }

    pub fn truth_of(&self, observation: &Observation) -> Option<usize> {
        self.truth[observation.image.index()][observation.keypoint.index()]
    }

    /// How many keypoint pairs of two images show one point.
    pub fn true_pairs(&self, a: usize, b: usize) -> usize {
        let in_b: std::collections::BTreeSet<usize> = self.truth[b].iter().flatten().copied().collect();
        self.truth[a].iter().flatten().filter(|point| in_b.contains(point)).count()
    }
}

/// The whole stage: chooses pairs, matches them, and adds what they show to the model. With `new_images`, only pairs with
/// one of them are matched (the paper's later iterations).
///
/// # Errors
/// When cancelled (the model is then unchanged), or when features are not those of the model's keypoints.
pub fn add_points(
    model: &mut Reconstruction,
    features: &LoadFeatures,
    new_images: Option<&BTreeSet<ImageId>>,
    options: &AddPointsOptions,
    seed: u64,
    progress: &(dyn Fn(usize, usize) + Sync),
    cancelled: &Cancelled,
) -> Result<AddPointsReport, AddPointsError> {
    let pairs = candidate_pairs(model, new_images, &options.candidate_pairs);
    let done = AtomicUsize::new(0);
    let one_more = || progress(done.fetch_add(1, Ordering::Relaxed) + 1, pairs.len());
    let mut matcher = PairMatcher::new(model, features, options, seed);
    let mut matches = Vec::with_capacity(pairs.len());
    for tile in tiles(model, &pairs, &options.blocks) {
        matcher.prepare(&tile, cancelled)?;
        matches.extend(matcher.match_pairs(&tile, &one_more, cancelled)?);
    }
    Ok(add_matches(model, matches, options, cancelled)?.0)
}
