//! Adjustment of scenes with known truth.

use std::sync::OnceLock;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use super::*;
use crate::camera::CameraModel;
use crate::geometry::Rigid3;
use crate::math::RobustLoss;
use crate::scene::{CameraId, ImageId};
use crate::synthetic::{Layout, ModelDifference, SceneOptions, compare, generate, perturbed};
use nalgebra::Vector3;

fn tight() -> BundleOptions {
    BundleOptions { function_tolerance: 1e-14, gradient_tolerance: 1e-9, max_iterations: 100, ..Default::default() }
}

/// Everything but the principal points, known focal lengths too.
fn everything(model: &Reconstruction) -> BundleConfig {
    let free = model.cameras.keys().map(|&id| (id, FreeIntrinsics::FOCAL_AND_DISTORTION)).collect();
    BundleConfig { intrinsics: free, ..BundleConfig::global(model, FreeIntrinsics::default()) }
}

fn error(model: &Reconstruction, truth: &Reconstruction) -> ModelDifference {
    compare(model, truth).expect("the models share images")
}

fn bytes(model: &Reconstruction) -> String {
    serde_json::to_string(model).expect("models serialise")
}

#[test]
fn converges_to_the_truth() {
    for camera_model in CameraModel::ALL {
        for shared_camera in [true, false] {
            let scene = SceneOptions { camera_model, shared_camera, num_points: 400, ..Default::default() };
            let truth = generate(&scene).truth;
            let mut model = perturbed(&truth, 1.0, 0.05, 0.05, true, 1);
            let report = adjust(&mut model, &everything(&truth), &tight());
            model.assert_consistent();
            let difference = error(&model, &truth);
            assert!(report.final_cost < 1e-9, "{camera_model:?} shared {shared_camera}: {report:?}");
            assert!(difference.max_center_error < 1e-6, "{camera_model:?} {difference:?} {report:?}");
            assert!(report.iterations < 25, "{report:?}");
            for (id, camera) in &model.cameras {
                assert!((camera.mean_focal_px() / truth.cameras[id].mean_focal_px() - 1.0).abs() < 1e-6);
            }
        }
    }
}

#[test]
fn noise_leaves_the_expected_error() {
    let scene = SceneOptions { pixel_noise_px: 0.5, num_points: 1500, ..Default::default() };
    let truth = generate(&scene).truth;
    let mut model = perturbed(&truth, 1.0, 0.02, 0.05, true, 2);
    let report = adjust(&mut model, &everything(&truth), &BundleOptions::default());
    assert!(report.converged() && report.iterations < 20, "{report:?}");
    let unknowns = 6 * 10 - 7 + 3 + 3 * report.num_variable_points;
    let redundancy = (2 * report.num_observations - unknowns) as f64;
    let sigma = (2.0 * report.final_cost / redundancy).sqrt();
    assert!((sigma - 0.5).abs() < 0.02, "{sigma} {report:?}");
    let difference = error(&model, &truth);
    assert!(difference.max_center_error < 2e-3 && difference.max_rotation_error_deg < 0.1, "{difference:?}");
}

#[test]
fn a_free_principal_point_is_found_and_a_prior_holds_it() {
    let scene = SceneOptions { num_points: 1000, num_images: 20, ..Default::default() };
    let truth = generate(&scene).truth;
    let mut model = truth.clone();
    model.cameras.get_mut(&CameraId(0)).expect("there is one camera").set_principal_point(510.0, 395.0);
    let config = BundleConfig::global(&model, FreeIntrinsics::ALL);
    let mut found = model.clone();
    adjust(&mut found, &config, &BundleOptions { principal_point_sigma: None, ..tight() });
    let offset = |model: &Reconstruction| {
        (model.cameras[&CameraId(0)].principal_point().0 - nalgebra::Vector2::new(500.0, 400.0)).norm()
    };
    assert!(offset(&found) < 1e-5, "{}", offset(&found));
    let mut moved = truth.clone();
    moved.cameras.get_mut(&CameraId(0)).expect("there is one camera").width += 40;
    let shifted = |sigma| {
        let mut model = moved.clone();
        adjust(&mut model, &config, &BundleOptions { principal_point_sigma: Some(sigma), ..tight() });
        offset(&model)
    };
    assert!(shifted(0.1) < 0.5 && shifted(1e-6) > 19.9, "{} {}", shifted(0.1), shifted(1e-6));
}

#[test]
fn a_focal_prior_holds_a_focal_length_that_sightings_leave_open() {
    let scene = SceneOptions { num_images: 3, num_points: 300, pixel_noise_px: 1.0, ..Default::default() };
    let truth = generate(&scene).truth;
    let mut model = truth.clone();
    let prior = FocalPrior { focal_px: 1100.0, sigma_log: 1e-5 };
    let config = BundleConfig { focal_priors: [(CameraId(0), prior)].into(), ..everything(&model) };
    model.cameras.get_mut(&CameraId(0)).expect("there is one camera").set_focal(1000.0, 1000.0);
    adjust(&mut model, &config, &BundleOptions::default());
    assert!((model.cameras[&CameraId(0)].mean_focal_px() - 1100.0).abs() < 0.5);
}

#[test]
fn what_is_constant_stays_to_the_last_bit() {
    let truth = generate(&SceneOptions { num_images: 20, pixel_noise_px: 0.5, ..Default::default() }).truth;
    let before = perturbed(&truth, 0.2, 0.01, 0.01, false, 4);
    let mut model = before.clone();
    let variable = [ImageId(3), ImageId(4)];
    let held = before.image(ImageId(3)).and_then(|image| image.points().iter().flatten().next().copied());
    let held = held.expect("the image sees a point");
    let config = BundleConfig { constant_points: [held].into(), ..BundleConfig::local(variable) };
    let report = adjust(&mut model, &config, &BundleOptions::default());
    assert!(report.final_cost < 0.5 * report.initial_cost, "{report:?}");
    assert_eq!((report.num_variable_images, model.cameras.clone()), (2, before.cameras.clone()));
    for (id, image) in before.images() {
        assert_eq!(model.images()[id].cam_from_world == image.cam_from_world, !variable.contains(id), "{id:?}");
    }
    for (id, point) in before.points() {
        let takes_part = id != held && point.track.iter().any(|seen| variable.contains(&seen.image));
        assert_eq!(model.point(id).expect("no point goes").xyz != point.xyz, takes_part, "{id:?}");
    }
}

#[test]
fn one_image_against_constant_points_is_resection() {
    let truth = generate(&SceneOptions::default()).truth;
    let mut model = perturbed(&truth, 2.0, 0.05, 0.0, false, 5);
    for (id, point) in truth.points() {
        model.set_xyz(id, point.xyz);
    }
    let config = BundleConfig {
        constant_points: truth.points().map(|(id, _)| id).collect(),
        ..BundleConfig::local([ImageId(2)])
    };
    let report = adjust(&mut model, &config, &tight());
    assert_eq!(report.num_variable_points, 0);
    assert_eq!(report.num_observations, truth.images()[&ImageId(2)].num_observations());
    let expected = truth.images()[&ImageId(2)].center_in_world();
    assert!((model.images()[&ImageId(2)].center_in_world() - expected).norm() < 1e-8, "{report:?}");
}

#[test]
fn robust_losses_withstand_gross_errors() {
    let scene = SceneOptions {
        gross_error_ratio: 0.1,
        pixel_noise_px: 0.3,
        num_points: 1000,
        num_images: 12,
        ..Default::default()
    };
    let truth = generate(&scene).truth;
    let start = perturbed(&truth, 0.3, 0.01, 0.01, false, 6);
    let error_with = |loss| {
        let mut model = start.clone();
        adjust(&mut model, &everything(&start), &BundleOptions { loss, ..Default::default() });
        error(&model, &truth).max_center_error
    };
    assert!(error_with(RobustLoss::Trivial) > 0.01, "{}", error_with(RobustLoss::Trivial));
    for loss in [RobustLoss::Cauchy { scale: 1.0 }, RobustLoss::SoftL1 { scale: 0.5 }, RobustLoss::Huber { scale: 0.5 }]
    {
        assert!(error_with(loss) < 5e-3, "{loss:?} {}", error_with(loss));
    }
}

#[test]
fn the_gauge_is_held_as_asked() {
    let truth = generate(&SceneOptions { pixel_noise_px: 0.5, ..Default::default() }).truth;
    let start = perturbed(&truth, 1.0, 0.03, 0.0, false, 7);
    let unmoved = |gauge| {
        let mut model = start.clone();
        let config = BundleConfig { gauge, ..BundleConfig::global(&start, FreeIntrinsics::default()) };
        let report = adjust(&mut model, &config, &tight());
        let poses =
            model.images().iter().filter(|(id, image)| image.cam_from_world == start.images()[id].cam_from_world);
        let coordinates = model.images().iter().filter(|(id, image)| {
            let before = start.images()[id].cam_from_world;
            (0..3).any(|k| image.cam_from_world.translation[k] == before.translation[k])
        });
        (poses.count(), coordinates.count(), report.final_cost)
    };
    let (two, free) = (unmoved(Gauge::TwoImages), unmoved(Gauge::Free));
    assert_eq!(((two.0, two.1), (free.0, free.1)), ((1, 2), (0, 0)));
    assert!((two.2 / free.2 - 1.0).abs() < 1e-6, "{two:?} {free:?}");
}

#[test]
fn sparse_and_dense_agree() {
    for shared_camera in [true, false] {
        let scene = SceneOptions {
            layout: Layout::Street,
            num_images: 60,
            num_points: 2000,
            pixel_noise_px: 0.5,
            shared_camera,
            ..Default::default()
        };
        let truth = generate(&scene).truth;
        let start = perturbed(&truth, 0.3, 0.005, 0.01, false, 8);
        let run = |max_dense_unknowns| {
            let mut model = start.clone();
            let options = BundleOptions { max_dense_unknowns, ..Default::default() };
            let report = adjust(&mut model, &everything(&start), &options);
            (model, report)
        };
        let ((dense, a), (sparse, b)) = (run(10_000), run(0));
        assert!((a.final_cost / b.final_cost - 1.0).abs() < 1e-6, "{a:?} {b:?}");
        assert!(error(&sparse, &dense).max_center_error < 1e-4, "{a:?} {b:?}");
        assert!(a.final_cost < 0.13 * 2.0 * a.num_observations as f64, "{a:?}");
    }
}

#[test]
fn the_number_of_threads_changes_no_bit() {
    let scene = SceneOptions {
        layout: Layout::Street,
        num_images: 40,
        num_points: 8000,
        pixel_noise_px: 0.5,
        ..Default::default()
    };
    let start = perturbed(&generate(&scene).truth, 0.3, 0.005, 0.01, false, 9);
    let (problem, _) = problem::Problem::build(&start, &everything(&start), &BundleOptions::default());
    assert!(pattern::Pattern::new(&problem, 900).parts.len() > 3, "the problem is large enough to be shared out");
    let run = |threads| {
        let mut model = start.clone();
        let options = BundleOptions { max_iterations: 4, ..Default::default() };
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("threads start");
        let report = pool.install(|| adjust(&mut model, &everything(&start), &options));
        (bytes(&model), report)
    };
    assert_eq!(run(1), run(4));
}

/// A model whose adjustment takes many steps, each long enough to be felt.
fn large() -> Reconstruction {
    let scene = SceneOptions {
        layout: Layout::Orbit,
        num_images: 120,
        num_points: 40_000,
        pixel_noise_px: 0.5,
        detection_ratio: 0.5,
        distractor_ratio: 0.0,
        ..Default::default()
    };
    perturbed(&generate(&scene).truth, 0.5, 0.01, 0.02, false, 11)
}

#[test]
fn an_adjustment_that_is_told_to_stop_stops_within_a_step() {
    let start = large();
    let tight = tight();
    let whole = Instant::now();
    let steps = adjust(&mut start.clone(), &everything(&start), &BundleOptions { max_iterations: 4, ..tight.clone() });
    let step = whole.elapsed() / steps.iterations as u32;
    assert_eq!((steps.stop, steps.iterations), (StopReason::MaxIterations, 4), "the problem takes more steps");
    // Asked twice a step: in the middle of the second, and before the third.
    for (asked_before, accepted) in [(3, 1), (4, 2)] {
        let (mut model, asked) = (start.clone(), AtomicUsize::new(0));
        let stopped: OnceLock<Instant> = OnceLock::new();
        let keep_going = || {
            let goes_on = asked.fetch_add(1, Ordering::Relaxed) < asked_before;
            if !goes_on {
                stopped.get_or_init(Instant::now);
            }
            goes_on
        };
        let report = adjust_while(&mut model, &everything(&start), &tight, &keep_going);
        let took = stopped.get().expect("it was asked").elapsed();
        assert!(took < 2 * step + Duration::from_millis(200), "{took:?} for steps of {step:?}");
        assert_eq!((report.stop, report.accepted), (StopReason::Interrupted, accepted), "{report:?}");
        assert!(report.final_cost < report.initial_cost && !report.converged());
        // What it leaves is what as many whole steps leave.
        let mut same = start.clone();
        adjust(&mut same, &everything(&start), &BundleOptions { max_iterations: accepted, ..tight.clone() });
        assert_eq!(bytes(&model), bytes(&same));
    }
}

#[test]
fn points_behind_cameras_do_no_harm() {
    let truth = generate(&SceneOptions::default()).truth;
    let mut model = perturbed(&truth, 0.2, 0.01, 0.0, false, 10);
    let behind: Vec<_> = truth.points().map(|(id, _)| id).step_by(50).collect();
    for &id in &behind {
        let image = model.point(id).expect("the point exists").track[0].image;
        let away = model.images()[&image].cam_from_world.inverse().apply(&Vector3::new(0.1, 0.1, -1.0));
        model.set_xyz(id, away);
    }
    let robust = BundleOptions { loss: RobustLoss::Cauchy { scale: 1.0 }, ..Default::default() };
    let report = adjust(&mut model, &everything(&truth), &robust);
    assert!(report.final_cost.is_finite() && report.final_cost < report.initial_cost, "{report:?}");
    for &id in &behind {
        model.remove_point(id);
    }
    adjust(&mut model, &everything(&truth), &tight());
    assert!(error(&model, &truth).max_center_error < 1e-6);
}

#[test]
fn nonsense_is_survived() {
    let truth = generate(&SceneOptions { num_images: 4, num_points: 100, ..Default::default() }).truth;
    let mut empty = Reconstruction::default();
    let report = adjust(&mut empty, &BundleConfig::local([ImageId(0)]), &BundleOptions::default());
    assert_eq!(report.stop, StopReason::NothingToAdjust);
    let mut model = truth.clone();
    assert_eq!(
        adjust(&mut model, &BundleConfig::default(), &BundleOptions::default()).stop,
        StopReason::NothingToAdjust
    );
    model.set_pose(ImageId(0), Rigid3::new(nalgebra::UnitQuaternion::identity(), Vector3::repeat(f64::NAN)));
    let report = adjust(&mut model, &everything(&truth), &BundleOptions::default());
    assert_eq!(report.accepted, 0, "{report:?}");
    let mut model = truth.clone();
    let report = adjust(&mut model, &everything(&truth), &BundleOptions { max_iterations: 0, ..Default::default() });
    assert_eq!((report.iterations, bytes(&model)), (0, bytes(&truth)));
}

#[test]
fn bad_options_are_named() {
    let mut errors = Vec::new();
    BundleOptions::default().validate(&mut errors);
    assert!(errors.is_empty());
    let bad = BundleOptions {
        loss: RobustLoss::Huber { scale: -1.0 },
        gradient_tolerance: f64::NAN,
        initial_damping: 0.0,
        principal_point_sigma: Some(0.0),
        ..Default::default()
    };
    bad.validate(&mut errors);
    assert_eq!(errors.len(), 4, "{errors:?}");
}
