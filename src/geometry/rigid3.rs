//! Rigid transforms of space.

use nalgebra::{Matrix3, Matrix3x4, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

/// A rigid transform `target_from_source`: `x_in_target = rotation * x_in_source + translation`.
///
/// Variables of this type are named so that neighbours cancel: `c_from_a = c_from_b.compose(&b_from_a)`.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Rigid3 {
    /// Rotation, target from source.
    pub rotation: UnitQuaternion<f64>,
    /// Translation, in the target frame.
    pub translation: Vector3<f64>,
}

impl Rigid3 {
    /// The transform that changes nothing.
    pub fn identity() -> Self {
        Self { rotation: UnitQuaternion::identity(), translation: Vector3::zeros() }
    }

    /// From a rotation and a translation.
    pub fn new(rotation: UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation, translation }
    }

    /// From a rotation matrix (made orthonormal if it is not quite) and a translation.
    pub fn from_matrix(rotation: &Matrix3<f64>, translation: Vector3<f64>) -> Self {
        let rotation = UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(*rotation));
        Self { rotation, translation }
    }

    /// A camera pose `cam_from_world` from the rotation and the centre of the camera in the world.
    pub fn from_center(rotation: UnitQuaternion<f64>, center_in_world: &Vector3<f64>) -> Self {
        Self { rotation, translation: -(rotation * center_in_world) }
    }

    /// `source_from_target`.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.inverse();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// `c_from_a` of `self = c_from_b` and `b_from_a`.
    pub fn compose(&self, b_from_a: &Self) -> Self {
        Self {
            rotation: self.rotation * b_from_a.rotation,
            translation: self.rotation * b_from_a.translation + self.translation,
        }
    }

    /// `x_in_target`.
    #[inline]
    pub fn apply(&self, x_in_source: &Vector3<f64>) -> Vector3<f64> {
        self.rotation * x_in_source + self.translation
    }

    /// Where the origin of the target frame lies in the source frame: the camera centre in the world for a
    /// `cam_from_world`.
    pub fn target_origin_in_source(&self) -> Vector3<f64> {
        -(self.rotation.inverse() * self.translation)
    }

    /// The rotation as a matrix.
    pub fn rotation_matrix(&self) -> Matrix3<f64> {
        self.rotation.to_rotation_matrix().into_inner()
    }

    /// The 3x4 matrix `[R | t]`.
    pub fn matrix(&self) -> Matrix3x4<f64> {
        let mut matrix = Matrix3x4::zeros();
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation_matrix());
        matrix.set_column(3, &self.translation);
        matrix
    }

    /// The pose after the left update `(omega, v)`: `rotation' = exp(omega) rotation`, `translation' = translation + v`.
    ///
    /// Rotation and translation are stepped separately (not through SE(3)), so that the Jacobian of
    /// `x_in_cam = R x + t` with respect to `(omega, v)` at zero is `[-[R x]_x | I]`.
    pub fn step(&self, omega: &Vector3<f64>, v: &Vector3<f64>) -> Self {
        let mut rotation = UnitQuaternion::from_scaled_axis(*omega) * self.rotation;
        rotation.renormalize_fast();
        Self { rotation, translation: self.translation + v }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn sample() -> Rigid3 {
        Rigid3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.7, 0.2)), Vector3::new(1.0, -2.0, 0.5))
    }

    #[test]
    fn inverse_and_composition_cancel() {
        let b_from_a = sample();
        let x_in_a = Vector3::new(0.4, 5.0, -1.0);
        assert!((b_from_a.inverse().apply(&b_from_a.apply(&x_in_a)) - x_in_a).norm() < 1e-12);
        let a_from_a = b_from_a.inverse().compose(&b_from_a);
        assert!(a_from_a.translation.norm() < 1e-12 && a_from_a.rotation.angle() < 1e-12);
    }

    #[test]
    fn the_centre_maps_to_the_origin() {
        let cam_from_world = sample();
        assert!(cam_from_world.apply(&cam_from_world.target_origin_in_source()).norm() < 1e-12);
    }
}
