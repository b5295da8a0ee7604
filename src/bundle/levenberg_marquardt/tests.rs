//! One damped step, against the full normal equations solved densely.

use super::*;
use crate::bundle::config::{BundleConfig, FocalPrior, FreeIntrinsics, Gauge};
use crate::camera::CameraModel;
use crate::math::{RobustLoss, skew};
use crate::scene::Reconstruction;
use crate::synthetic::{Layout, SceneOptions, generate, perturbed};
use nalgebra::{DMatrix, DVector};

fn config(model: &Reconstruction, gauge: Gauge) -> BundleConfig {
    let free = model.cameras.keys().map(|&id| (id, FreeIntrinsics::ALL)).collect();
    let priors = model.cameras.keys().map(|&id| (id, FocalPrior { focal_px: 1000.0, sigma_log: 0.05 })).collect();
    BundleConfig {
        gauge,
        intrinsics: free,
        focal_priors: priors,
        constant_points: model.points().take(1).map(|(id, _)| id).collect(),
        ..BundleConfig::global(model, FreeIntrinsics::default())
    }
}

/// The step of the full damped system, unknowns of the reduced system first, and the gradient; everything from
/// `Camera::project_with_jacobian`, nothing shared with the elimination.
fn full_step(problem: &Problem, state: &State, loss: RobustLoss, damping: f64) -> DVector<f64> {
    let n = problem.num_unknowns + 3 * state.points.len();
    let mut jacobian = DMatrix::zeros(2 * problem.sightings.len(), n);
    let mut errors = DVector::zeros(2 * problem.sightings.len());
    for point in 0..state.points.len() {
        let x_in_world = Vector3::from(state.points[point]);
        for at in problem.point_start[point] as usize..problem.point_start[point + 1] as usize {
            let seen = &problem.sightings[at];
            let pose = &problem.poses[seen.pose as usize];
            let cam_from_world = &state.poses[seen.pose as usize];
            let camera = &state.cameras[pose.camera as usize];
            let here = camera.project_with_jacobian(&cam_from_world.apply(&x_in_world)).unwrap();
            let error = here.pixel.0 - nalgebra::Vector2::from(seen.pixel);
            let weight = loss.evaluate(error.norm_squared()).1;
            let mut row = jacobian.rows_mut(2 * at, 2);
            if let Some(slot) = pose.slot {
                let first = problem.slots[slot as usize].first;
                let by_omega = -here.by_point * skew(&(cam_from_world.rotation * x_in_world));
                row.fixed_view_mut::<2, 3>(0, first).copy_from(&by_omega);
                row.fixed_view_mut::<2, 3>(0, first + 3).copy_from(&here.by_point);
            }
            let block = &problem.cameras[pose.camera as usize];
            if let Some(slot) = block.slot {
                for (k, &(parameter, _)) in block.free.iter().enumerate() {
                    let column = here.by_params.column(parameter);
                    row.column_mut(problem.slots[slot as usize].first + k).copy_from(&column);
                }
            }
            if problem.point_is_variable[point] {
                let by_point = here.by_point * cam_from_world.rotation_matrix();
                row.fixed_view_mut::<2, 3>(0, problem.num_unknowns + 3 * point).copy_from(&by_point);
            }
            row *= weight.sqrt();
            errors.fixed_rows_mut::<2>(2 * at).copy_from(&(weight.sqrt() * error));
        }
    }
    let mut gradient = jacobian.tr_mul(&errors);
    let mut hessian = jacobian.tr_mul(&jacobian);
    for prior in &problem.priors {
        let (error, slope) = prior.residual(state);
        hessian[(prior.unknown, prior.unknown)] += slope * slope;
        gradient[prior.unknown] += slope * error;
    }
    for k in 0..n {
        hessian[(k, k)] += damping * hessian[(k, k)].clamp(MIN_DAMPED_DIAGONAL, MAX_DAMPED_DIAGONAL);
    }
    for &held in &problem.held {
        hessian.row_mut(held).fill(0.0);
        hessian.column_mut(held).fill(0.0);
        hessian[(held, held)] = 1.0;
        gradient[held] = 0.0;
    }
    -hessian.lu().solve(&gradient).unwrap()
}

#[test]
fn eliminating_the_points_gives_the_full_step() {
    for camera_model in CameraModel::ALL {
        let all = [(true, 0), (true, 1000), (false, 1000), (false, 0)];
        let count = if camera_model == CameraModel::OpenCv { all.len() } else { 1 };
        for &(shared_camera, max_dense_unknowns) in &all[..count] {
            let scene = SceneOptions {
                camera_model,
                shared_camera,
                layout: Layout::Street,
                num_images: 30,
                num_points: 70,
                ..Default::default()
            };
            let model = perturbed(&generate(&scene).truth, 0.5, 0.01, 0.02, false, 3);
            let loss = RobustLoss::Cauchy { scale: 20.0 };
            let options = BundleOptions { loss, max_dense_unknowns, ..Default::default() };
            let (problem, state) = Problem::build(&model, &config(&model, Gauge::TwoImages), &options);
            let mut minimizer = Minimizer::new(&problem, &options).unwrap();
            assert_eq!(minimizer.pattern.sparse.is_some(), max_dense_unknowns == 0, "{shared_camera}");
            let damping = 1e-3;
            minimizer.linearise(&state, damping);
            assert!(minimizer.solve_reduced(damping));
            let mut trial = state.clone();
            minimizer.advance(&state, &mut trial, damping);
            let full = full_step(&problem, &state, loss, damping);
            let reduced = full.rows(0, problem.num_unknowns);
            let ours = DVector::from_column_slice(&minimizer.step);
            assert!((ours - reduced).norm() < 1e-8 * reduced.norm(), "{camera_model:?} {shared_camera}");
            for (point, (before, after)) in state.points.iter().zip(&trial.points).enumerate() {
                let step = Vector3::from(*after) - Vector3::from(*before);
                let expected = full.fixed_rows::<3>(problem.num_unknowns + 3 * point);
                assert!((step - expected).norm() < 1e-8, "{camera_model:?} {shared_camera} point {point}");
            }
        }
    }
}

#[test]
fn the_gradient_is_that_of_the_cost() {
    let scene = SceneOptions { camera_model: CameraModel::OpenCv, num_images: 4, num_points: 60, ..Default::default() };
    let model = perturbed(&generate(&scene).truth, 0.5, 0.01, 0.02, false, 3);
    let options = BundleOptions { loss: RobustLoss::SoftL1 { scale: 5.0 }, ..Default::default() };
    let (problem, state) = Problem::build(&model, &config(&model, Gauge::TwoImages), &options);
    let mut minimizer = Minimizer::new(&problem, &options).unwrap();
    minimizer.linearise(&state, 1e300);
    let gradient = minimizer.parts[0].gradient.clone();
    let mut trial = state.clone();
    for unknown in (0..problem.num_unknowns).filter(|unknown| !problem.held.contains(unknown)) {
        let mut cost_at = |step: f64| {
            minimizer.step.fill(0.0);
            minimizer.step[unknown] = step;
            minimizer.advance(&state, &mut trial, 1e300).cost
        };
        let step = 1e-5;
        let difference = (cost_at(step) - cost_at(-step)) / (2.0 * step);
        let allowed = 1e-5 * gradient[unknown].abs() + 1e-2;
        assert!((gradient[unknown] - difference).abs() < allowed, "{unknown}: {} {difference}", gradient[unknown]);
    }
}
