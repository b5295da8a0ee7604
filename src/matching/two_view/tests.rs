use super::*;
use crate::camera::CameraModel;
use crate::geometry::epipolar::sampson_error_sq;
use nalgebra::{UnitQuaternion, Vector3};

const MATCHES: usize = 300;

#[derive(Clone, Copy, PartialEq)]
enum Shape {
    Deep,
    Plane,
    /// Four of five points on one plane.
    MostlyPlane,
    /// Cameras at one place.
    Rotation,
}

struct Scene {
    b_from_a: Rigid3,
    camera: Camera,
    pixels_a: Vec<Pixel>,
    pixels_b: Vec<Pixel>,
    matches: Vec<(KeypointIdx, KeypointIdx)>,
}

impl Scene {
    /// Matches of keypoints with half a pixel of noise, the first `outliers` of them wrong.
    fn new(rng: &mut Rng, shape: Shape, outliers: usize) -> Self {
        let mut camera = Camera::centered(CameraModel::SimpleRadial, 3000, 2000, 2600.0, FocalSource::Exif);
        camera.params[CameraModel::SimpleRadial.distortion_index()] = -0.05;
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.05, -0.2, 0.03));
        let center = if shape == Shape::Rotation { Vector3::zeros() } else { Vector3::new(1.0, 0.1, 0.2) };
        let b_from_a = Rigid3::from_center(rotation, &center);
        let (mut pixels_a, mut pixels_b, mut matches) = (Vec::new(), Vec::new(), Vec::new());
        while matches.len() < MATCHES {
            let i = matches.len();
            let on_plane = match shape {
                Shape::Plane => true,
                Shape::MostlyPlane => !i.is_multiple_of(5),
                Shape::Deep | Shape::Rotation => false,
            };
            let (u, v) = (rng.range(-0.55, 0.55), rng.range(-0.36, 0.36));
            let depth = if on_plane { 5.0 / (1.0 + 0.4 * u + 0.1 * v) } else { rng.range(3.0, 9.0) };
            let x = Vector3::new(u, v, 1.0) * depth;
            let mut pixel = |x: &Vector3<f64>| {
                camera.project(x).map(|p| Pixel::new(p.0.x + 0.5 * rng.normal(), p.0.y + 0.5 * rng.normal()))
            };
            let (Some(a), Some(b)) = (pixel(&x), pixel(&b_from_a.apply(&x))) else { continue };
            let wrong = Pixel::new(rng.range(0.0, 3000.0), rng.range(0.0, 2000.0));
            pixels_a.push(a);
            pixels_b.insert(0, if i < outliers { wrong } else { b });
            matches.push((KeypointIdx(i as u32), KeypointIdx((MATCHES - 1 - i) as u32)));
        }
        Self { b_from_a, camera, pixels_a, pixels_b, matches }
    }

    fn verify(&self, camera: &Camera, rng: &mut Rng) -> Option<TwoViewGeometry> {
        let options = TwoViewOptions::default();
        verify(&self.pixels_a, &self.pixels_b, &self.matches, camera, camera, &options, rng)
    }

    fn assert_pose(&self, found: &Rigid3, tolerance: f64) {
        let turn = found.rotation.angle_to(&self.b_from_a.rotation);
        let shift = (found.translation - self.b_from_a.translation.normalize()).norm();
        assert!(turn < tolerance && shift < 5.0 * tolerance, "turn {turn}, shift {shift}");
    }
}

fn kept(geometry: &TwoViewGeometry, outliers: usize) -> (usize, usize) {
    let right = geometry.inliers.iter().filter(|(a, _)| a.index() >= outliers).count();
    (right, geometry.inliers.len() - right)
}

#[test]
fn a_deep_scene_is_calibrated_and_its_pose_right() {
    let mut rng = Rng::from_parts(&[1]);
    for outliers in [0, 100, 180, 210] {
        let scene = Scene::new(&mut rng, Shape::Deep, outliers);
        let geometry = scene.verify(&scene.camera, &mut rng).unwrap();
        assert_eq!(geometry.config, TwoViewConfig::Calibrated);
        scene.assert_pose(&geometry.b_from_a.unwrap(), 5e-3);
        let (right, wrong) = kept(&geometry, outliers);
        assert!(right >= MATCHES - outliers - 3 && wrong <= 6, "{outliers} outliers: {right} {wrong}");
        let angle = geometry.median_triangulation_angle_rad.unwrap();
        assert!((0.1..0.3).contains(&angle), "{angle}");
        for &(a, b) in &geometry.inliers {
            let ideal = |p: &Pixel| scene.camera.undistort_pixel(p).0;
            let (a, b) = (ideal(&scene.pixels_a[a.index()]), ideal(&scene.pixels_b[b.index()]));
            assert!(sampson_error_sq(&geometry.fundamental.unwrap(), &a, &b).sqrt() < 4.0);
        }
    }
}

#[test]
fn a_guessed_focal_length_gives_a_fundamental_matrix_and_later_a_pose() {
    let mut rng = Rng::from_parts(&[2]);
    let scene = Scene::new(&mut rng, Shape::Deep, 100);
    let mut guess = scene.camera.clone();
    guess.set_focal(3600.0, 3600.0);
    guess.focal_source = FocalSource::Guess;
    let geometry = scene.verify(&guess, &mut rng).unwrap();
    assert_eq!(geometry.config, TwoViewConfig::Uncalibrated);
    assert!(geometry.b_from_a.is_none() && geometry.fundamental.is_some());
    let options = TwoViewOptions::default();
    let pose =
        geometry.relative_pose(&scene.pixels_a, &scene.pixels_b, &scene.camera, &scene.camera, &options).unwrap();
    scene.assert_pose(&pose.b_from_a, 1e-2);
    assert!(pose.num_in_front > 190);
}

#[test]
fn a_lying_exif_focal_length_shows() {
    let mut rng = Rng::from_parts(&[3]);
    let scene = Scene::new(&mut rng, Shape::Deep, 60);
    let mut lying = scene.camera.clone();
    lying.set_focal(1300.0, 1300.0);
    let geometry = scene.verify(&lying, &mut rng).unwrap();
    assert_eq!(geometry.config, TwoViewConfig::Uncalibrated);
    assert!(geometry.num_f_inliers > geometry.num_e_inliers);
}

#[test]
fn planes_and_rotations_are_recognised() {
    let mut rng = Rng::from_parts(&[4]);
    for outliers in [0, 120] {
        let scene = Scene::new(&mut rng, Shape::Plane, outliers);
        let geometry = scene.verify(&scene.camera, &mut rng).unwrap();
        assert_eq!(geometry.config, TwoViewConfig::Planar);
        assert!(geometry.b_from_a.is_some() && geometry.homography.is_some());
        let (right, wrong) = kept(&geometry, outliers);
        assert!(right >= MATCHES - outliers - 6 && wrong <= 6, "{right} {wrong}");

        let scene = Scene::new(&mut rng, Shape::Rotation, outliers);
        let geometry = scene.verify(&scene.camera, &mut rng).unwrap();
        assert_eq!(geometry.config, TwoViewConfig::Panoramic);
        assert!(geometry.b_from_a.is_none());

        let mut guess = scene.camera.clone();
        guess.focal_source = FocalSource::Guess;
        assert_eq!(scene.verify(&guess, &mut rng).unwrap().config, TwoViewConfig::PlanarOrPanoramic);
    }
}

#[test]
fn the_motion_of_a_plane_comes_from_its_homography() {
    let mut rng = Rng::from_parts(&[5]);
    let scene = Scene::new(&mut rng, Shape::Plane, 0);
    let geometry = scene.verify(&scene.camera, &mut rng).unwrap();
    let k = scene.camera.calibration_matrix();
    let h = k.try_inverse().unwrap() * geometry.homography.unwrap() * k;
    let pairs = point_pairs(&scene.pixels_a, &scene.pixels_b, &scene.matches, &scene.camera, &scene.camera);
    let found = pose::of_homography(&h, &pairs, &mut vec![true; MATCHES], 1e-3).unwrap();
    assert!(found.num_in_front == MATCHES);
    // Two motions put a plane in front of both cameras; the true one must be among the candidates, the found one valid.
    let motions = crate::geometry::homography::decompose_homography(&h).unwrap();
    assert!(motions.iter().any(|m| m.b_from_a.rotation.angle_to(&scene.b_from_a.rotation) < 5e-3));
}

#[test]
fn a_dominant_plane_does_not_spoil_the_fundamental_matrix() {
    let mut rng = Rng::from_parts(&[6]);
    for _ in 0..5 {
        let scene = Scene::new(&mut rng, Shape::MostlyPlane, 60);
        let mut guess = scene.camera.clone();
        guess.focal_source = FocalSource::Guess;
        let options = TwoViewOptions { planar_ratio: 0.95, ..TwoViewOptions::default() };
        let geometry =
            verify(&scene.pixels_a, &scene.pixels_b, &scene.matches, &guess, &guess, &options, &mut rng).unwrap();
        assert_eq!(geometry.config, TwoViewConfig::Uncalibrated);
        let off_plane = geometry.inliers.iter().filter(|(a, _)| a.index() >= 60 && a.index().is_multiple_of(5)).count();
        assert!(off_plane >= 44, "{off_plane} of 48 off the plane");
    }
}

#[test]
fn random_and_few_matches_give_nothing() {
    let mut rng = Rng::from_parts(&[7]);
    let mut scene = Scene::new(&mut rng, Shape::Deep, MATCHES);
    for _ in 0..5 {
        assert!(scene.verify(&scene.camera, &mut rng).is_none());
    }
    scene.matches.truncate(60);
    assert!(scene.verify(&scene.camera, &mut rng).is_none());
    scene.matches.truncate(10);
    assert!(scene.verify(&scene.camera, &mut rng).is_none());
    let mut errors = Vec::new();
    TwoViewOptions::default().validate(&mut errors);
    assert!(errors.is_empty(), "{errors:?}");
}
