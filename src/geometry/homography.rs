//! Motion from the homography of a plane, and rotation from bearings.
//!
//! On the planes z = 1 a plane with unit normal `n` at distance `d` from camera a gives `H = R + t n^T / d` up to scale.

use nalgebra::{Matrix3, Vector3};

use super::Rigid3;

/// A motion that explains a homography.
#[derive(Clone, Copy, Debug)]
pub struct PlaneMotion {
    /// `b_from_a`, its translation in units of the distance of the plane from camera a.
    pub b_from_a: Rigid3,
    /// Unit normal of the plane in frame a; a visible point `x_a` of the plane has `normal . x_a > 0`.
    pub normal: Vector3<f64>,
}

/// Singular values closer together than this are equal for f64: the camera only turned.
const MIN_SPREAD: f64 = 1e-9;

/// The four motions of a homography on the planes z = 1 (two of them negated), or none when it is a mere rotation.
/// `h` must have the sign that keeps depths: `x_b^T H x_a > 0` for what both cameras see.
///
/// With `H` scaled to a middle singular value of 1 and `H^T H = V diag(s1^2, 1, s3^2) V^T`, two unit vectors keep their
/// length and angle to `v2` under `H`, `u = (sqrt(1 - s3^2) v1 +- sqrt(s1^2 - 1) v3) / sqrt(s1^2 - s3^2)`, which gives
/// `R = [H v2, H u, H v2 x H u] [v2, u, v2 x u]^T`, `n = v2 x u`, `t = (H - R) n` (Ma, Soatto, Kosecka, Sastry, "An
/// Invitation to 3-D Vision", 2004, section 5.3.3).
pub fn decompose_homography(h: &Matrix3<f64>) -> Option<[PlaneMotion; 4]> {
    if !h.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = h.svd(false, true);
    let middle = svd.singular_values[1];
    let mut v = svd.v_t?.transpose();
    if v.determinant() < 0.0 {
        v.neg_mut();
    }
    let (s1, s3) = (svd.singular_values[0] / middle, svd.singular_values[2] / middle);
    let spread = s1 * s1 - s3 * s3;
    if spread.is_nan() || spread < MIN_SPREAD {
        return None;
    }
    let h = h / middle;
    let (v1, v2, v3) = (v.column(0), v.column(1), v.column(2));
    let (along, across) = ((1.0 - s3 * s3).max(0.0).sqrt(), (s1 * s1 - 1.0).max(0.0).sqrt());
    let motion = |sign: f64, flip: f64| {
        let u = (v1 * along + v3 * (sign * across)) / spread.sqrt();
        let normal = v2.cross(&u);
        let (hv, hu) = (h * v2, h * u);
        let rotation = Matrix3::from_columns(&[hv, hu, hv.cross(&hu)])
            * Matrix3::from_columns(&[v2.into(), u, normal]).transpose();
        let translation = (h - rotation) * normal;
        let mut b_from_a = Rigid3::from_matrix(&rotation, translation * flip);
        b_from_a.rotation.renormalize();
        PlaneMotion { b_from_a, normal: normal * flip }
    };
    Some([motion(1.0, 1.0), motion(1.0, -1.0), motion(-1.0, 1.0), motion(-1.0, -1.0)])
}

/// The rotation that best sends unit rays of a to those of b: the nearest rotation to `sum x_b x_a^T` (Arun, Huang,
/// Blostein, "Least-Squares Fitting of Two 3-D Point Sets", PAMI 1987).
pub fn rotation_between<'a>(rays: impl Iterator<Item = (&'a Vector3<f64>, &'a Vector3<f64>)>) -> Option<Matrix3<f64>> {
    let moments = rays.fold(Matrix3::zeros(), |sum, (a, b)| sum + b * a.transpose());
    if !moments.iter().all(|v| v.is_finite()) {
        return None;
    }
    let svd = moments.svd(true, true);
    let (u, v_t) = (svd.u?, svd.v_t?);
    let handedness = (u * v_t).determinant().signum();
    Some(u * Matrix3::from_diagonal(&Vector3::new(1.0, 1.0, handedness)) * v_t)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::UnitQuaternion;

    #[test]
    fn the_true_motion_is_among_the_four() {
        let mut rng = Rng::from_parts(&[1]);
        for _ in 0..500 {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| rng.range(-0.4, 0.4)));
            let translation = Vector3::from_fn(|_, _| rng.range(-0.5, 0.5));
            let normal = Vector3::new(rng.range(-0.6, 0.6), rng.range(-0.6, 0.6), 1.0).normalize();
            let h = rotation.to_rotation_matrix().into_inner() + translation * normal.transpose();
            if h.determinant() < 0.05 {
                continue;
            }
            let found = decompose_homography(&(h * 0.3)).unwrap();
            assert!(found.iter().any(|motion| {
                motion.b_from_a.rotation.angle_to(&rotation) < 1e-6
                    && (motion.b_from_a.translation - translation).norm() < 1e-6
                    && (motion.normal - normal).norm() < 1e-5
            }));
        }
    }

    #[test]
    fn a_rotation_has_no_plane_and_is_recovered_from_rays() {
        let mut rng = Rng::from_parts(&[2]);
        let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.2, 0.1)).to_rotation_matrix().into_inner();
        assert!(decompose_homography(&rotation).is_none());
        let rays: Vec<(Vector3<f64>, Vector3<f64>)> = (0..10)
            .map(|_| {
                let a = Vector3::new(rng.normal(), rng.normal(), 2.0).normalize();
                (a, rotation * a)
            })
            .collect();
        let found = rotation_between(rays.iter().map(|(a, b)| (a, b))).unwrap();
        assert!((found - rotation).norm() < 1e-9);
    }
}
