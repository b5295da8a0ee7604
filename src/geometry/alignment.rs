//! Similarity transforms, and the one that best maps one set of points onto another.
//!
//! Least squares: with `x~`, `y~` the points less their means, `S = 1/n sum y~ x~^T = U D V^T` and
//! `E = diag(1, 1, det U det V)`, the similarity `y = s R x + t` of least squared distance has
//!
//!   R = U E V^T,    s = trace(D E) / (1/n sum |x~|^2),    t = mean(y) - s R mean(x).
//!
//! Reference: Umeyama, "Least-squares estimation of transformation parameters between two point patterns", PAMI 1991, equations
//! 40 to 42. The robust version scores similarities of random triples by truncated distances and ends with least squares
//! over those within the limit.

use nalgebra::{Matrix3, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use super::Rigid3;
use crate::math::Rng;

/// A similarity `target_from_source`: `x_in_target = scale * rotation * x_in_source + translation`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Sim3 {
    /// Units of the target frame to one of the source frame.
    pub scale: f64,
    /// Rotation, target from source.
    pub rotation: UnitQuaternion<f64>,
    /// Translation, in the target frame.
    pub translation: Vector3<f64>,
}

impl Sim3 {
    /// The transform that changes nothing.
    pub fn identity() -> Self {
        Self { scale: 1.0, rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// `x_in_target`.
    pub fn apply(&self, x_in_source: &Vector3<f64>) -> Vector3<f64> {
        self.scale * (self.rotation * x_in_source) + self.translation
    }

    /// `source_from_target`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        let scale = 1.0 / self.scale;
        Self { scale, rotation, translation: -(scale * (rotation * self.translation)) }
    }

    /// `c_from_a` of `self = c_from_b` and `b_from_a`.
    pub fn compose(&self, b_from_a: &Self) -> Self {
        Self {
            scale: self.scale * b_from_a.scale,
            rotation: self.rotation * b_from_a.rotation,
            translation: self.apply(&b_from_a.translation),
        }
    }

    /// The pose `cam_from_target` of a camera with the pose `cam_from_source`. Depths in the camera frame scale along.
    pub fn transform_pose(&self, cam_from_source: &Rigid3) -> Rigid3 {
        let center_in_target = self.apply(&cam_from_source.target_origin_in_source());
        Rigid3::from_center(cam_from_source.rotation * self.rotation.inverse(), &center_in_target)
    }
}

/// The least-squares similarity that maps `source[i]` to `target[i]`. None when there are fewer than three points, all
/// points of the source coincide, or a coordinate is not finite. Points on one line leave the turn about it arbitrary.
pub fn align(source: &[Vector3<f64>], target: &[Vector3<f64>]) -> Option<Sim3> {
    let n = source.len().min(target.len());
    if n < 3 {
        return None;
    }
    let mean = |points: &[Vector3<f64>]| points[..n].iter().sum::<Vector3<f64>>() / n as f64;
    let (source_mean, target_mean) = (mean(source), mean(target));
    let (mut covariance, mut spread) = (Matrix3::zeros(), 0.0);
    for (x, y) in source.iter().zip(target) {
        let (x, y) = (x - source_mean, y - target_mean);
        covariance += y * x.transpose() / n as f64;
        spread += x.norm_squared() / n as f64;
    }
    if !(spread > 0.0 && covariance.iter().all(|v| v.is_finite())) {
        return None;
    }
    let svd = covariance.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let handedness = Vector3::new(1.0, 1.0, (u.determinant() * v_t.determinant()).signum());
    let rotation = u * Matrix3::from_diagonal(&handedness) * v_t;
    let scale = svd.singular_values.dot(&handedness) / spread;
    let rotation = Rigid3::from_matrix(&rotation, Vector3::zeros()).rotation;
    (scale > 0.0 && scale.is_finite()).then(|| Sim3 {
        scale,
        rotation,
        translation: target_mean - scale * (rotation * source_mean),
    })
}

/// Triples tried by [`align_robustly`]: with half of the points wrong, all fail with a probability of 1e-29.
const TRIPLES: usize = 500;

/// [`align`] over the points that the best similarity of a random triple brings within `max_distance` (in the target frame)
/// of their place; over all points where that leaves fewer than three.
pub fn align_robustly(
    source: &[Vector3<f64>],
    target: &[Vector3<f64>],
    max_distance: f64,
    rng: &mut Rng,
) -> Option<Sim3> {
    let n = source.len().min(target.len());
    if n < 3 {
        return None;
    }
    let distance = |sim: &Sim3, at: usize| (sim.apply(&source[at]) - target[at]).norm();
    let mut best: Option<(f64, Sim3)> = None;
    for _ in 0..TRIPLES {
        let triple = rng.distinct::<3>(n);
        let Some(sim) = align(&triple.map(|at| source[at]), &triple.map(|at| target[at])) else { continue };
        let score: f64 = (0..n).map(|at| distance(&sim, at).min(max_distance)).sum();
        if best.is_none_or(|(least, _)| score < least) {
            best = Some((score, sim));
        }
    }
    let near: Vec<usize> = match best {
        Some((_, sim)) => (0..n).filter(|&at| distance(&sim, at) < max_distance).collect(),
        None => Vec::new(),
    };
    if near.len() < 3 {
        return align(source, target);
    }
    let chosen = |points: &[Vector3<f64>]| near.iter().map(|&at| points[at]).collect::<Vec<_>>();
    align(&chosen(source), &chosen(target))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Sim3 {
        Sim3 {
            scale: 2.5,
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(0.8, -1.4, 0.3)),
            translation: Vector3::new(4.0, -1.0, 7.0),
        }
    }

    fn cloud(n: usize, seed: u64) -> Vec<Vector3<f64>> {
        let mut rng = Rng::from_parts(&[seed]);
        (0..n).map(|_| Vector3::from_fn(|_, _| 3.0 * rng.normal())).collect()
    }

    fn assert_same(a: &Sim3, b: &Sim3, tolerance: f64) {
        assert!((a.scale - b.scale).abs() < tolerance, "{a:?} {b:?}");
        assert!(a.rotation.angle_to(&b.rotation) < tolerance, "{a:?} {b:?}");
        assert!((a.translation - b.translation).norm() < 10.0 * tolerance, "{a:?} {b:?}");
    }

    #[test]
    fn group_laws_hold() {
        let (a, b) = (sample(), sample().inverse());
        assert_same(&a.compose(&b), &Sim3::identity(), 1e-12);
        let x = Vector3::new(1.0, 2.0, -3.0);
        assert!((a.compose(&a).apply(&x) - a.apply(&a.apply(&x))).norm() < 1e-12);
    }

    #[test]
    fn a_moved_camera_sees_moved_points_alike() {
        let pose =
            Rigid3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.2, 0.3)), Vector3::new(1.0, 0.0, 2.0));
        let x = Vector3::new(0.4, -0.3, 5.0);
        let moved = sample().transform_pose(&pose).apply(&sample().apply(&x));
        assert!((moved - sample().scale * pose.apply(&x)).norm() < 1e-12);
    }

    #[test]
    fn exact_points_give_the_exact_similarity() {
        let source = cloud(8, 1);
        let target: Vec<_> = source.iter().map(|x| sample().apply(x)).collect();
        assert_same(&align(&source, &target).unwrap(), &sample(), 1e-10);
        // In one plane the reflection fits as well, but is none.
        let flat: Vec<_> = source.iter().map(|x| Vector3::new(x.x, x.y, 0.0)).collect();
        let target: Vec<_> = flat.iter().map(|x| sample().apply(x)).collect();
        assert_same(&align(&flat, &target).unwrap(), &sample(), 1e-10);
    }

    #[test]
    fn gross_errors_are_left_out() {
        let source = cloud(30, 2);
        let mut target: Vec<_> = source.iter().map(|x| sample().apply(x)).collect();
        for (at, wrong) in target.iter_mut().enumerate().take(12) {
            *wrong += Vector3::new(5.0 + at as f64, 9.0, -7.0);
        }
        let found = align_robustly(&source, &target, 0.1, &mut Rng::from_parts(&[3])).unwrap();
        assert_same(&found, &sample(), 1e-10);
        assert!((align(&source, &target).unwrap().translation - sample().translation).norm() > 0.5);
    }

    #[test]
    fn impossible_inputs_give_nothing() {
        let points = cloud(5, 4);
        assert!(align(&points[..2], &points[..2]).is_none());
        assert!(align(&[points[0]; 4], &points[..4]).is_none());
        let broken = [Vector3::repeat(f64::NAN); 5];
        assert!(align(&points, &broken).is_none());
        assert!(align_robustly(&points, &broken, 1.0, &mut Rng::from_parts(&[5])).is_none());
    }
}
