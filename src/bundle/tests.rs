//! Adjustment of scenes with known truth.

use super::*;
use crate::camera::CameraModel;
use crate::synthetic::{ModelDifference, SceneOptions, compare, generate, perturbed};

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
        }
    }
}
