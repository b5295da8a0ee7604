//! How far a model lies from the truth, after the best similarity.
//!
//! The rotation of the similarity is the chordal mean of the images' rotation differences (Hartley, Trumpf, Dai, Li,
//! "Rotation averaging", IJCV 2013), so that it exists for collinear cameras too; scale and translation then are the
//! least-squares ones of the camera centres (Umeyama, "Least-squares estimation of transformation parameters", 1991).

use nalgebra::{Matrix3, Vector3};

use crate::geometry::Rigid3;
use crate::scene::Reconstruction;

/// Pose errors of the images two models share.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ModelDifference {
    /// Images that both models have.
    pub num_images: usize,
    /// Mean distance of the camera centres, relative to the mean distance of two true centres.
    pub mean_center_error: f64,
    /// The largest such distance.
    pub max_center_error: f64,
    /// Mean angle between the rotations, in degrees.
    pub mean_rotation_error_deg: f64,
    /// The largest such angle.
    pub max_rotation_error_deg: f64,
}

/// Compares a model with the truth; none when they share fewer than two images, or all centres of one coincide.
pub fn compare(model: &Reconstruction, truth: &Reconstruction) -> Option<ModelDifference> {
    let pairs: Vec<(Rigid3, Rigid3)> = model
        .images()
        .iter()
        .filter_map(|(id, image)| Some((image.cam_from_world, truth.image(*id)?.cam_from_world)))
        .collect();
    if pairs.len() < 2 {
        return None;
    }
    let count = pairs.len() as f64;
    let sum: Matrix3<f64> =
        pairs.iter().map(|(model, truth)| truth.rotation_matrix().transpose() * model.rotation_matrix()).sum();
    let truth_from_model = nearest_rotation(&sum)?;
    let centers: Vec<(Vector3<f64>, Vector3<f64>)> = pairs
        .iter()
        .map(|(m, t)| (truth_from_model * m.target_origin_in_source(), t.target_origin_in_source()))
        .collect();
    let model_mean = centers.iter().map(|(m, _)| m).sum::<Vector3<f64>>() / count;
    let truth_mean = centers.iter().map(|(_, t)| t).sum::<Vector3<f64>>() / count;
    let product: f64 = centers.iter().map(|(m, t)| (m - model_mean).dot(&(t - truth_mean))).sum();
    let square: f64 = centers.iter().map(|(m, _)| (m - model_mean).norm_squared()).sum();
    let scale = product / square;
    let unit = mean_distance(&centers.iter().map(|(_, t)| *t).collect::<Vec<_>>());
    if !(scale.is_finite() && unit > 0.0) {
        return None;
    }
    let center_errors = centers.iter().map(|(m, t)| (scale * (m - model_mean) - (t - truth_mean)).norm() / unit);
    let rotation_errors = pairs.iter().map(|(m, t)| {
        let difference = m.rotation_matrix() * truth_from_model.transpose() * t.rotation_matrix().transpose();
        nalgebra::Rotation3::from_matrix_unchecked(difference).angle().to_degrees()
    });
    let (mean_center_error, max_center_error) = mean_and_max(center_errors);
    let (mean_rotation_error_deg, max_rotation_error_deg) = mean_and_max(rotation_errors);
    Some(ModelDifference {
        num_images: pairs.len(),
        mean_center_error,
        max_center_error,
        mean_rotation_error_deg,
        max_rotation_error_deg,
    })
}

fn nearest_rotation(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = matrix.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let handedness = (u * v_t).determinant().signum();
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, handedness)) * v_t)
}

fn mean_distance(centers: &[Vector3<f64>]) -> f64 {
    let (mut sum, mut count) = (0.0, 0usize);
    for (at, a) in centers.iter().enumerate() {
        for b in &centers[at + 1..] {
            sum += (a - b).norm();
            count += 1;
        }
    }
    sum / count as f64
}

fn mean_and_max(values: impl Iterator<Item = f64>) -> (f64, f64) {
    let (sum, max, count) = values.fold((0.0, 0.0f64, 0usize), |(s, m, n), value| (s + value, m.max(value), n + 1));
    (sum / count as f64, max)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{Layout, SceneOptions, generate, perturbed};
    use nalgebra::UnitQuaternion;

    #[test]
    fn a_similarity_is_no_difference() {
        let truth = generate(&SceneOptions { layout: Layout::Street, ..SceneOptions::default() }).truth;
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.4, -1.0, 0.3));
        let mut model = truth.clone();
        for (&id, image) in truth.images() {
            let center = 3.0 * (turn * image.center_in_world()) + Vector3::new(1.0, 2.0, 3.0);
            model.set_pose(id, Rigid3::from_center(image.cam_from_world.rotation * turn.inverse(), &center));
        }
        let difference = compare(&model, &truth).unwrap();
        assert!(difference.max_center_error < 1e-10 && difference.max_rotation_error_deg < 1e-5, "{difference:?}");
    }

    #[test]
    fn perturbations_are_measured() {
        let truth = generate(&SceneOptions { num_images: 40, ..SceneOptions::default() }).truth;
        let difference = compare(&perturbed(&truth, 2.0, 0.05, 0.0, false, 1), &truth).unwrap();
        assert!((difference.mean_rotation_error_deg - 2.0).abs() < 0.2, "{difference:?}");
        assert!(difference.mean_center_error > 0.02 && difference.max_center_error < 0.1, "{difference:?}");
    }
}
