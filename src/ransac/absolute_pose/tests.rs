use super::*;
use crate::camera::CameraModel;
use crate::solvers::test_scenes::{random_points_in_front, random_pose};

const POINTS: usize = 200;

/// A camera of true focal length `focal_px` that sees 200 points with half a pixel of noise, the first `outliers` anywhere.
fn scene(rng: &mut Rng, focal_px: f64, outliers: usize, k1: f64) -> (Rigid3, Camera, Vec<Vector3<f64>>, Vec<Pixel>) {
    let mut camera = Camera::centered(CameraModel::SimpleRadial, 1600, 1200, focal_px, FocalSource::Known);
    camera.params[CameraModel::SimpleRadial.distortion_index()] = k1;
    let pose = random_pose(rng);
    let points = random_points_in_front::<POINTS>(rng, &pose).to_vec();
    let pixels = points
        .iter()
        .enumerate()
        .map(|(i, x)| {
            if i < outliers {
                return Pixel::new(rng.range(0.0, 1600.0), rng.range(0.0, 1200.0));
            }
            let pixel = camera.project(&pose.apply(x)).unwrap().0;
            Pixel::new(pixel.x + 0.5 * rng.normal(), pixel.y + 0.5 * rng.normal())
        })
        .collect();
    (pose, camera, points, pixels)
}

fn assert_close(found: &AbsolutePose, truth: &Rigid3, focal_px: f64, tolerance: f64) {
    let turn = found.cam_from_world.rotation.angle_to(&truth.rotation);
    let shift = (found.cam_from_world.target_origin_in_source() - truth.target_origin_in_source()).norm();
    let focal = found.camera.mean_focal_px() / focal_px - 1.0;
    assert!(
        turn < tolerance && shift < 10.0 * tolerance && focal.abs() < 10.0 * tolerance,
        "turn {turn}, shift {shift}, focal {focal}"
    );
}

#[test]
fn a_known_camera_is_placed_among_eighty_per_cent_outliers() {
    let mut rng = Rng::from_parts(&[1]);
    for round in 0..30 {
        let outliers = [0, 100, 140, 160][round % 4];
        let (pose, camera, points, pixels) = scene(&mut rng, 1400.0, outliers, -0.05);
        let found = estimate(&points, &pixels, &camera, &AbsolutePoseOptions::default(), &mut rng).unwrap();
        assert_close(&found, &pose, 1400.0, 2e-3);
        assert!(
            found.num_inliers >= POINTS - outliers - 2
                && found.inliers[outliers..].iter().filter(|&&i| i).count() >= POINTS - outliers - 2
        );
        assert_eq!(found.camera, camera);
    }
}

#[test]
fn a_guessed_focal_length_is_found() {
    let mut rng = Rng::from_parts(&[2]);
    for round in 0..20 {
        let outliers = [0, 60, 100, 120][round % 4];
        let focal_px = [900.0, 1400.0, 3500.0][round % 3];
        let (pose, mut camera, points, pixels) = scene(&mut rng, focal_px, outliers, 0.0);
        camera.set_focal(1920.0, 1920.0);
        camera.focal_source = FocalSource::Guess;
        let found = estimate(&points, &pixels, &camera, &AbsolutePoseOptions::default(), &mut rng).unwrap();
        assert_close(&found, &pose, focal_px, 6e-3);
        assert_eq!(found.camera.focal_source, FocalSource::Estimated);
    }
}

#[test]
fn a_lying_exif_focal_length_is_overruled_and_a_true_one_kept() {
    let mut rng = Rng::from_parts(&[3]);
    for factor in [0.5, 2.0, 1.0] {
        let (pose, mut camera, points, pixels) = scene(&mut rng, 1400.0, 80, 0.0);
        camera.set_focal(1400.0 * factor, 1400.0 * factor);
        camera.focal_source = FocalSource::Exif;
        let found = estimate(&points, &pixels, &camera, &AbsolutePoseOptions::default(), &mut rng).unwrap();
        assert_close(&found, &pose, 1400.0, 6e-3);
        let wanted = if factor == 1.0 { FocalSource::Exif } else { FocalSource::Estimated };
        assert_eq!(found.camera.focal_source, wanted);
    }
}

#[test]
fn distortion_is_refined_on_request() {
    let mut rng = Rng::from_parts(&[4]);
    let (pose, mut camera, points, pixels) = scene(&mut rng, 1400.0, 40, -0.1);
    let at = camera.model.distortion_index();
    camera.params[at] = 0.0;
    camera.focal_source = FocalSource::Exif;
    let options =
        AbsolutePoseOptions { refine_distortion: true, refine_trusted_focal: true, ..AbsolutePoseOptions::default() };
    let found = estimate(&points, &pixels, &camera, &options, &mut rng).unwrap();
    assert_close(&found, &pose, 1400.0, 3e-3);
    assert!((found.camera.params[at] + 0.1).abs() < 0.02, "{}", found.camera.params[at]);
}

#[test]
fn a_facade_seen_at_a_slant_fixes_the_focal_length() {
    let mut rng = Rng::from_parts(&[5]);
    let truth = Camera::centered(CameraModel::SimplePinhole, 1600, 1200, 1500.0, FocalSource::Known);
    let turn = nalgebra::UnitQuaternion::from_scaled_axis(Vector3::new(0.2, 0.8, 0.1));
    let pose = Rigid3::from_center(turn, &(turn.inverse() * Vector3::new(0.0, 0.0, -6.0)));
    let (mut points, mut pixels) = (Vec::new(), Vec::new());
    while points.len() < 100 {
        let x = Vector3::new(rng.range(-3.0, 3.0), rng.range(-3.0, 3.0), 0.0);
        let pixel = truth.project(&pose.apply(&x)).unwrap().0;
        points.push(x);
        pixels.push(Pixel::new(pixel.x + 0.3 * rng.normal(), pixel.y + 0.3 * rng.normal()));
    }
    let guess = Camera::centered(CameraModel::SimplePinhole, 1600, 1200, 1920.0, FocalSource::Guess);
    let found = estimate(&points, &pixels, &guess, &AbsolutePoseOptions::default(), &mut rng).unwrap();
    assert_close(&found, &pose, 1500.0, 1e-2);
}

#[test]
fn random_matches_and_too_few_give_nothing() {
    let mut rng = Rng::from_parts(&[6]);
    let (_, camera, points, pixels) = scene(&mut rng, 1400.0, POINTS, 0.0);
    let options = AbsolutePoseOptions::default();
    assert!(estimate(&points, &pixels, &camera, &options, &mut rng).is_none());
    assert!(estimate(&points[..5], &pixels[..5], &camera, &options, &mut rng).is_none());
    let mut errors = Vec::new();
    options.validate(&mut errors);
    assert!(errors.is_empty(), "{errors:?}");
}

#[test]
fn the_same_seed_gives_the_same_camera() {
    let mut rng = Rng::from_parts(&[7]);
    let (_, camera, points, pixels) = scene(&mut rng, 1400.0, 100, 0.0);
    let run = || {
        let mut rng = Rng::from_parts(&[1, 2]);
        estimate(&points, &pixels, &camera, &AbsolutePoseOptions::default(), &mut rng).unwrap().cam_from_world
    };
    assert_eq!(run(), run());
}
