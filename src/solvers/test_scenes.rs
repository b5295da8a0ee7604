//! Random problems with known answers, for the tests of the solvers and of the estimators on top of them.

use nalgebra::{Matrix3, UnitQuaternion, Vector2, Vector3};

use crate::geometry::Rigid3;
use crate::math::Rng;

fn random_rotation(rng: &mut Rng) -> UnitQuaternion<f64> {
    UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(rng.normal(), rng.normal(), rng.normal(), rng.normal()))
}

/// Any rotation, with a translation of a few units.
pub(crate) fn random_pose(rng: &mut Rng) -> Rigid3 {
    Rigid3::new(random_rotation(rng), Vector3::from_fn(|_, _| rng.range(-3.0, 3.0)))
}

/// World points within about 30 degrees of the axis of a camera, 2 to 8 units away.
pub(crate) fn random_points_in_front<const N: usize>(rng: &mut Rng, cam_from_world: &Rigid3) -> [Vector3<f64>; N] {
    let world_from_cam = cam_from_world.inverse();
    std::array::from_fn(|_| {
        let depth = rng.range(2.0, 8.0);
        world_from_cam.apply(&(Vector3::new(rng.range(-0.6, 0.6), rng.range(-0.6, 0.6), 1.0) * depth))
    })
}

/// A relative pose as of two photographs of one thing: up to about 30 degrees of turn, unit translation.
pub(crate) fn random_relative_pose(rng: &mut Rng) -> Rigid3 {
    let rotation = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| rng.range(-0.3, 0.3)));
    loop {
        let t = Vector3::from_fn(|_, _| rng.range(-1.0, 1.0));
        if t.norm() > 0.1 {
            return Rigid3::new(rotation, t.normalize());
        }
    }
}

/// Exact pairs on the planes z = 1 of points in front of both cameras.
pub(crate) fn random_pairs<const N: usize>(rng: &mut Rng, b_from_a: &Rigid3) -> ([Vector2<f64>; N], [Vector2<f64>; N]) {
    let (mut a, mut b) = ([Vector2::zeros(); N], [Vector2::zeros(); N]);
    for i in 0..N {
        (a[i], b[i]) = loop {
            let [x] = random_points_in_front::<1>(rng, &Rigid3::identity());
            let y = b_from_a.apply(&x);
            if y.z > 0.5 && (y.xy() / y.z).norm() < 1.2 {
                break (x.xy() / x.z, y.xy() / y.z);
            }
        };
    }
    (a, b)
}

/// Distance of two matrices up to scale and sign.
pub(crate) fn matrix_distance(a: &Matrix3<f64>, b: &Matrix3<f64>) -> f64 {
    let (a, b) = (a / a.norm(), b / b.norm());
    (a - b).norm().min((a + b).norm())
}
