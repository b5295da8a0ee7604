//! Two-view algebra: essential and fundamental matrices, Sampson error, relative pose with cheirality.
//!
//! With `b_from_a = (R, t)` and homogeneous positions `x_a`, `x_b` of one point: `x_b^T E x_a = 0`, `E = [t]_x R` on the
//! planes z = 1, and `p_b^T F p_a = 0`, `F = K_b^-T E K_a^-1` in (undistorted) pixels. Hartley and Zisserman, "Multiple
//! View Geometry", 2nd ed., chapters 9 and 11.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::Rigid3;
use crate::camera::Normalized;

/// The matrix of the cross product: `[v]_x w = v x w`.
#[inline]
pub fn cross_matrix(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

/// `E = [t]_x R` with `t` made unit length; none without a translation.
pub fn essential_from_pose(b_from_a: &Rigid3) -> Option<Matrix3<f64>> {
    let direction = b_from_a.translation.try_normalize(f64::MIN_POSITIVE)?;
    Some(cross_matrix(&direction) * b_from_a.rotation_matrix())
}

/// `F` between undistorted pixels, of unit Frobenius norm; none without a translation or with a singular K.
pub fn fundamental_from_pose(
    b_from_a: &Rigid3,
    calibration_a: &Matrix3<f64>,
    calibration_b: &Matrix3<f64>,
) -> Option<Matrix3<f64>> {
    fundamental_from_essential(&essential_from_pose(b_from_a)?, calibration_a, calibration_b)
}

/// `F = K_b^-T E K_a^-1`, of unit Frobenius norm; none with a singular K.
pub fn fundamental_from_essential(
    essential: &Matrix3<f64>,
    calibration_a: &Matrix3<f64>,
    calibration_b: &Matrix3<f64>,
) -> Option<Matrix3<f64>> {
    let fundamental = calibration_b.try_inverse()?.transpose() * essential * calibration_a.try_inverse()?;
    let norm = fundamental.norm();
    (norm > 0.0 && norm.is_finite()).then(|| fundamental / norm)
}

/// The essential matrix (singular values 1, 1, 0) nearest to `K_b^T F K_a`.
pub fn essential_from_fundamental(
    fundamental: &Matrix3<f64>,
    calibration_a: &Matrix3<f64>,
    calibration_b: &Matrix3<f64>,
) -> Option<Matrix3<f64>> {
    nearest_essential(&(calibration_b.transpose() * fundamental * calibration_a))
}

/// The essential matrix with singular values 1, 1, 0 nearest in direction to a matrix.
pub fn nearest_essential(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    if !matrix.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = matrix.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, 0.0)) * v_t)
}

/// The four poses `b_from_a` (unit translation) an essential matrix allows: two rotations, either sign of the translation.
///
/// With `E = U diag(1, 1, 0) V^T`, `W` a quarter turn about z and both determinants made positive:
/// `R = U W V^T` or `U W^T V^T`, `t = +-u_3` (Hartley and Zisserman, result 9.19).
pub fn decompose_essential(essential: &Matrix3<f64>) -> Option<[Rigid3; 4]> {
    if !essential.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = essential.svd(true, true);
    let (mut u, mut v_t) = (svd.u?, svd.v_t?);
    if u.determinant() < 0.0 {
        u.neg_mut();
    }
    if v_t.determinant() < 0.0 {
        v_t.neg_mut();
    }
    let w = Matrix3::new(0.0, -1.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0);
    let t = u.column(2).into_owned();
    let pose = |rotation: &Matrix3<f64>, translation| {
        let mut pose = Rigid3::from_matrix(rotation, translation);
        pose.rotation.renormalize();
        pose
    };
    let (r1, r2) = (u * w * v_t, u * w.transpose() * v_t);
    Some([pose(&r1, t), pose(&r1, -t), pose(&r2, t), pose(&r2, -t)])
}

/// A squared sine between rays below which they are parallel for f64, and depths along them have no sign.
const MIN_SINE_SQ: f64 = 1e-16;

/// The depths along the rays `x_a` and `x_b` at which they come closest: `d_b x_b = d_a R x_a + t`. None for parallel rays.
///
/// Crossing with `x_b` and with `R x_a`: `d_a = -(x_b x t).(x_b x R x_a) / |x_b x R x_a|^2`,
/// `d_b = -(R x_a x t).(x_b x R x_a) / |x_b x R x_a|^2`.
#[inline]
pub fn depths(b_from_a: &Rigid3, x_a: &Vector3<f64>, x_b: &Vector3<f64>) -> Option<(f64, f64)> {
    let turned = b_from_a.rotation * x_a;
    let cross = x_b.cross(&turned);
    let sine_sq = cross.norm_squared();
    if sine_sq <= MIN_SINE_SQ * turned.norm_squared() * x_b.norm_squared() {
        return None;
    }
    let t = &b_from_a.translation;
    Some((-x_b.cross(t).dot(&cross) / sine_sq, -turned.cross(t).dot(&cross) / sine_sq))
}

/// Among candidate poses, the one with the most pairs in front of both cameras, and that number.
pub fn choose_by_cheirality(candidates: &[Rigid3], pairs: &[(Normalized, Normalized)]) -> Option<(Rigid3, usize)> {
    let mut best: Option<(Rigid3, usize)> = None;
    for pose in candidates {
        let in_front = pairs
            .iter()
            .filter(|(a, b)| {
                depths(pose, &a.homogeneous(), &b.homogeneous()).is_some_and(|(d_a, d_b)| d_a > 0.0 && d_b > 0.0)
            })
            .count();
        if best.as_ref().is_none_or(|(_, most)| in_front > *most) {
            best = Some((*pose, in_front));
        }
    }
    best.filter(|&(_, in_front)| in_front > 0)
}

/// The pose `b_from_a` (unit translation) of an essential matrix that has most pairs in front of both cameras, and how
/// many.
pub fn pose_from_essential(essential: &Matrix3<f64>, pairs: &[(Normalized, Normalized)]) -> Option<(Rigid3, usize)> {
    choose_by_cheirality(&decompose_essential(essential)?, pairs)
}

/// The squared Sampson error of a pair under an essential or fundamental matrix: the first-order squared distance to the
/// nearest pair that satisfies it, in the units of the coordinates (Hartley and Zisserman, equation 11.9).
///
///   (x_b^T M x_a)^2 / ((M x_a)_1^2 + (M x_a)_2^2 + (M^T x_b)_1^2 + (M^T x_b)_2^2)
#[inline]
pub fn sampson_error_sq(matrix: &Matrix3<f64>, x_a: &Vector2<f64>, x_b: &Vector2<f64>) -> f64 {
    let line_b = matrix * x_a.push(1.0);
    let line_a = matrix.tr_mul(&x_b.push(1.0));
    let algebraic = x_b.x * line_b.x + x_b.y * line_b.y + line_b.z;
    algebraic * algebraic / (line_b.xy().norm_squared() + line_a.xy().norm_squared())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::UnitQuaternion;

    fn scene(rng: &mut Rng) -> (Rigid3, Vec<(Normalized, Normalized)>) {
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| rng.range(-0.4, 0.4)));
        let translation = Vector3::from_fn(|_, _| rng.range(-1.0, 1.0)).normalize();
        let b_from_a = Rigid3::new(rotation, translation);
        let mut pairs = Vec::new();
        while pairs.len() < 20 {
            let x = Vector3::new(rng.range(-3.0, 3.0), rng.range(-3.0, 3.0), rng.range(2.0, 8.0));
            let y = b_from_a.apply(&x);
            if y.z > 0.5 {
                pairs.push((Normalized(x.xy() / x.z), Normalized(y.xy() / y.z)));
            }
        }
        (b_from_a, pairs)
    }

    #[test]
    fn the_pose_comes_back_from_its_essential_matrix() {
        let mut rng = Rng::from_parts(&[3]);
        for _ in 0..1000 {
            let (b_from_a, pairs) = scene(&mut rng);
            let essential = essential_from_pose(&b_from_a).unwrap();
            for (a, b) in &pairs {
                assert!(sampson_error_sq(&essential, &a.0, &b.0) < 1e-20);
            }
            let (found, in_front) = pose_from_essential(&(essential * -3.0), &pairs).unwrap();
            assert_eq!(in_front, pairs.len());
            assert!(found.rotation.angle_to(&b_from_a.rotation) < 1e-6);
            assert!((found.translation - b_from_a.translation).norm() < 1e-6);
        }
    }

    #[test]
    fn fundamental_and_essential_convert_both_ways() {
        let mut rng = Rng::from_parts(&[4]);
        let (b_from_a, pairs) = scene(&mut rng);
        let k_a = Matrix3::new(800.0, 0.0, 400.0, 0.0, 810.0, 300.0, 0.0, 0.0, 1.0);
        let k_b = Matrix3::new(500.0, 0.0, 320.0, 0.0, 500.0, 240.0, 0.0, 0.0, 1.0);
        let fundamental = fundamental_from_pose(&b_from_a, &k_a, &k_b).unwrap();
        for (a, b) in &pairs {
            let (p_a, p_b) = (k_a * a.homogeneous(), k_b * b.homogeneous());
            assert!(sampson_error_sq(&fundamental, &p_a.xy(), &p_b.xy()) < 1e-16);
        }
        let essential = essential_from_fundamental(&fundamental, &k_a, &k_b).unwrap();
        let truth = essential_from_pose(&b_from_a).unwrap();
        assert!((essential - truth).norm().min((essential + truth).norm()) < 1e-9);
    }

    #[test]
    fn depths_meet_at_the_point() {
        let b_from_a = Rigid3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.1, 0.2, -0.1)), Vector3::x());
        let x = Vector3::new(0.5, -0.2, 4.0);
        let y = b_from_a.apply(&x);
        let (d_a, d_b) = depths(&b_from_a, &(x / x.z), &(y / y.z)).unwrap();
        assert!((d_a - x.z).abs() < 1e-9 && (d_b - y.z).abs() < 1e-9);
    }
}
