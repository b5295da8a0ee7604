//! Seeded scenes with known truth: cameras, poses, points, tracks, features with descriptors, and pairwise matches.
//!
//! Keypoints are the exact projections plus the noise and the gross errors asked for; with neither, the truth's
//! reprojection errors are 0. Keypoints are sorted as [`Features`] asks, so keypoint `i` of the model and feature `i` are
//! the same.

use std::collections::BTreeMap;

use nalgebra::{UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::layout::Layout;
use super::photographer::Photographer;
use crate::camera::CameraModel;
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::{Features, ImageId, KeypointIdx, Reconstruction};

/// What to generate.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SceneOptions {
    /// Seed of everything random.
    pub seed: u64,
    /// How cameras and points lie to each other.
    pub layout: Layout,
    /// Number of images.
    pub num_images: usize,
    /// Number of surface points; those seen by fewer than two images do not enter the truth.
    pub num_points: usize,
    /// Columns of every image.
    pub width: u32,
    /// Rows of every image.
    pub height: u32,
    /// Camera model of all images.
    pub camera_model: CameraModel,
    /// Focal length in pixels.
    pub focal_px: f64,
    /// Factor of the focal length in every other image of a shared camera, as after zooming; 1: none.
    pub zoom: f64,
    /// Distortion `(k1, k2, p1, p2)`; what the model lacks is ignored.
    pub distortion: [f64; 4],
    /// One camera for all images; otherwise one each, with focal lengths that differ by some percent.
    pub shared_camera: bool,
    /// Standard deviation of the noise of keypoints, per coordinate, in pixels.
    pub pixel_noise_px: f64,
    /// Share of sightings whose keypoint lies grossly wrong (20 to 100 pixels off), in 0..1.
    pub gross_error_ratio: f64,
    /// Probability that an image detects a point it could see, in 0..1.
    pub detection_ratio: f64,
    /// Keypoints an image has besides those of points, as a share of the latter; their descriptors are random.
    pub distractor_ratio: f64,
    /// Share of the matches of each pair that are wrong, in 0..1.
    pub outlier_ratio: f64,
    /// Relative noise of descriptor entries from sighting to sighting.
    pub descriptor_noise: f64,
}

impl Default for SceneOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            layout: Layout::Orbit,
            num_images: 10,
            num_points: 800,
            width: 1000,
            height: 800,
            camera_model: CameraModel::SimpleRadial,
            focal_px: 1100.0,
            zoom: 1.0,
            distortion: [-0.05, 0.01, 0.0005, -0.0005],
            shared_camera: true,
            pixel_noise_px: 0.0,
            gross_error_ratio: 0.0,
            detection_ratio: 0.9,
            distractor_ratio: 0.2,
            outlier_ratio: 0.0,
            descriptor_noise: 0.1,
        }
    }
}

/// Matched keypoints of two images, in ascending order.
pub type PairMatches = Vec<(KeypointIdx, KeypointIdx)>;

/// A scene with its truth.
#[derive(Clone, Debug)]
pub struct SyntheticScene {
    /// True cameras, poses and points; tracks name all sightings. Keypoints carry the noise.
    pub truth: Reconstruction,
    /// The features of every image.
    pub features: BTreeMap<ImageId, Features>,
    /// Matches of every pair (smaller id first) that shares a point, wrong ones among them as asked.
    pub matches: BTreeMap<(ImageId, ImageId), PairMatches>,
}

/// Streams of the generator.
#[repr(u64)]
#[derive(Clone, Copy)]
pub(super) enum Stream {
    Camera = 1,
    Pose,
    Point,
    Image,
    Matches,
    Perturbation,
}

impl Stream {
    /// The generator of item `id`.
    pub(super) fn rng(self, options: &SceneOptions, id: usize) -> Rng {
        Rng::from_parts(&[options.seed, self as u64, id as u64])
    }
}

/// Generates the scene of these options; always the same one.
pub fn generate(options: &SceneOptions) -> SyntheticScene {
    let photographer = Photographer::new(options);
    let mut features = BTreeMap::new();
    let mut pictures = Vec::with_capacity(options.num_images);
    for index in 0..options.num_images {
        let (picture, found) = photographer.photograph(index);
        features.insert(ImageId(index as u32), found);
        pictures.push(picture);
    }
    let truth = photographer.truth(pictures);
    let matches = matches_of(options, &truth, &mut Stream::Matches.rng(options, 0));
    SyntheticScene { truth, features, matches }
}

fn matches_of(
    options: &SceneOptions,
    truth: &Reconstruction,
    rng: &mut Rng,
) -> BTreeMap<(ImageId, ImageId), PairMatches> {
    let mut matches: BTreeMap<(ImageId, ImageId), PairMatches> = BTreeMap::new();
    for (_, point) in truth.points() {
        for (at, a) in point.track.iter().enumerate() {
            for b in &point.track[at + 1..] {
                matches.entry((a.image, b.image)).or_default().push((a.keypoint, b.keypoint));
            }
        }
    }
    for ((a, b), pairs) in &mut matches {
        let (a, b) = (truth.images()[a].keypoints.len(), truth.images()[b].keypoints.len());
        for pair in pairs.iter_mut() {
            if rng.uniform() < options.outlier_ratio {
                *pair = (KeypointIdx(rng.below(a) as u32), KeypointIdx(rng.below(b) as u32));
            }
        }
        pairs.sort_unstable();
        pairs.dedup_by_key(|pair| pair.0);
    }
    matches
}

/// A model with every pose, point and focal length moved away from its place, for tests of refinement.
///
/// Rotations turn by `rotation_deg` about random axes, centres move by `share` of the mean distance of cameras from the
/// centroid of the points, points by `share` of the root mean square spread of the points, focal lengths by `focal_share`
/// up or down, and distortion becomes 0 when `forget_distortion`.
pub fn perturbed(
    truth: &Reconstruction,
    rotation_deg: f64,
    share: f64,
    focal_share: f64,
    forget_distortion: bool,
    seed: u64,
) -> Reconstruction {
    let stream = |kind: u64, id: u32| Rng::from_parts(&[seed, Stream::Perturbation as u64, kind, u64::from(id)]);
    let direction = |rng: &mut Rng| Vector3::new(rng.normal(), rng.normal(), rng.normal()).normalize();
    let mut model = truth.clone();
    let count = truth.num_points().max(1) as f64;
    let centroid = truth.points().map(|(_, point)| point.xyz).sum::<Vector3<f64>>() / count;
    let spread = (truth.points().map(|(_, point)| (point.xyz - centroid).norm_squared()).sum::<f64>() / count).sqrt();
    let reach = truth.images().values().map(|image| (image.center_in_world() - centroid).norm()).sum::<f64>()
        / truth.images().len().max(1) as f64;
    for (&id, image) in truth.images() {
        let mut rng = stream(0, id.0);
        let turn = UnitQuaternion::from_scaled_axis(direction(&mut rng) * rotation_deg.to_radians());
        let center = image.center_in_world() + direction(&mut rng) * (share * reach);
        model.set_pose(id, Rigid3::from_center(turn * image.cam_from_world.rotation, &center));
    }
    for (id, point) in truth.points() {
        model.set_xyz(id, point.xyz + direction(&mut stream(1, id.index() as u32)) * (share * spread));
    }
    for (id, camera) in &mut model.cameras {
        let sign = if stream(2, id.0).uniform() < 0.5 { -1.0 } else { 1.0 };
        let (fx, fy) = camera.focal();
        camera.set_focal(fx * (1.0 + sign * focal_share), fy * (1.0 + sign * focal_share));
        if forget_distortion {
            let at = camera.model.distortion_index();
            camera.params[at..].fill(0.0);
        }
    }
    model
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::Descriptor;

    #[test]
    fn exact_scenes_reproject_exactly() {
        for layout in [Layout::Orbit, Layout::Facade, Layout::Street] {
            for shared_camera in [true, false] {
                let options = SceneOptions { layout, shared_camera, num_images: 8, ..SceneOptions::default() };
                let scene = generate(&options);
                scene.truth.assert_consistent();
                assert!(scene.truth.num_points() > 250, "{layout:?}: {}", scene.truth.num_points());
                assert!(scene.truth.reprojection_errors_px().iter().all(|&error| error < 1e-9));
                for (id, features) in &scene.features {
                    let image = &scene.truth.images()[id];
                    assert!(image.num_observations() >= 80, "{layout:?} {id:?}: {}", image.num_observations());
                    assert_eq!(features.len(), image.keypoints.len());
                    assert!(features.keypoints.windows(2).all(|pair| pair[0].scale >= pair[1].scale));
                }
            }
        }
    }

    #[test]
    fn no_lens_shows_what_lies_beyond_its_field_of_view() {
        // Along a street there are points at up to 75 degrees from the axis, which a barrel distortion folds into the image.
        let options = SceneOptions {
            layout: Layout::Street,
            num_images: 60,
            num_points: 6000,
            camera_model: CameraModel::SimpleRadial,
            ..SceneOptions::default()
        };
        let truth = generate(&options).truth;
        assert!(truth.num_observations() > 10_000);
        for (_, point) in truth.points() {
            for seen in &point.track {
                let x_in_cam = truth.images()[&seen.image].cam_from_world.apply(&point.xyz);
                assert!(x_in_cam.xy().norm() < x_in_cam.z, "{x_in_cam}");
            }
        }
    }

    #[test]
    fn noise_and_outliers_are_as_asked() {
        let options = SceneOptions {
            pixel_noise_px: 0.5,
            gross_error_ratio: 0.1,
            outlier_ratio: 0.3,
            num_points: 2000,
            ..SceneOptions::default()
        };
        let scene = generate(&options);
        let errors = scene.truth.reprojection_errors_px();
        let inliers: Vec<f64> = errors.iter().copied().filter(|&error| error < 10.0).collect();
        let gross = 1.0 - inliers.len() as f64 / errors.len() as f64;
        assert!((gross - 0.1).abs() < 0.02, "{gross}");
        let mean_sq = inliers.iter().map(|error| error * error).sum::<f64>() / inliers.len() as f64;
        assert!((mean_sq / 0.5 - 1.0).abs() < 0.05, "{mean_sq}");
        let (mut right, mut all) = (0, 0);
        for ((a, b), pairs) in &scene.matches {
            let (a, b) = (&scene.truth.images()[a], &scene.truth.images()[b]);
            for (i, j) in pairs {
                all += 1;
                let point = a.points()[i.index()];
                right += usize::from(point.is_some() && point == b.points()[j.index()]);
            }
        }
        assert!((f64::from(right as u32) / f64::from(all) - 0.72).abs() < 0.08, "{right} of {all}");
    }

    #[test]
    fn descriptors_tell_points_apart() {
        let scene = generate(&SceneOptions { num_points: 200, ..SceneOptions::default() });
        let distance_sq = |a: &Descriptor, b: &Descriptor| -> i32 {
            a.iter().zip(b).map(|(&a, &b)| (i32::from(a) - i32::from(b)).pow(2)).sum()
        };
        let (a, b) = (&scene.features[&ImageId(0)], &scene.features[&ImageId(1)]);
        for &(i, j) in &scene.matches[&(ImageId(0), ImageId(1))] {
            let own = distance_sq(&a.descriptors[i.index()], &b.descriptors[j.index()]);
            for (other, descriptor) in b.descriptors.iter().enumerate() {
                let distance = distance_sq(&a.descriptors[i.index()], descriptor);
                assert!(other == j.index() || f64::from(own) < 0.25 * f64::from(distance));
            }
        }
    }

    #[test]
    fn a_seed_names_one_scene() {
        let options = SceneOptions { pixel_noise_px: 1.0, ..SceneOptions::default() };
        let (a, b) = (generate(&options), generate(&options));
        assert_eq!(serde_json::to_string(&a.truth).unwrap(), serde_json::to_string(&b.truth).unwrap());
        assert_eq!((&a.features, &a.matches), (&b.features, &b.matches));
        let other = generate(&SceneOptions { seed: 1, ..options });
        assert_ne!(a.features, other.features);
    }
}
