//! Points from two or more views, and how well the views fix them.

use nalgebra::{Matrix2x3, Matrix3, Matrix4, Vector2, Vector3, Vector4};

use super::Rigid3;
use crate::camera::Normalized;

/// A view of a point: the camera's pose and where it sees the point.
pub type View = (Rigid3, Normalized);

/// A homogeneous point whose last coordinate is below this share of its length lies at infinity for f64.
const MIN_HOMOGENEOUS_SHARE: f64 = 1e-9;

/// The point, in the world, nearest to the rays of two or more views in the linear sense; it may lie behind some of them.
///
/// With `P = [R | t]` and the unit ray `b` in the camera frame, the part of `P X` across the ray is `(I - b b^T) P X`;
/// the homogeneous `X` of unit length with the least sum of squares of it is the last eigenvector of
/// `sum P^T (I - b b^T) P` (Hartley and Zisserman, "Multiple View Geometry", 2nd ed., section 12.2, with unit rays in
/// place of the rows of `x` so that all views weigh alike). The world is first moved and scaled to the camera centres,
/// which keeps the 4x4 matrix well conditioned wherever the scene lies. None for fewer than two views, coinciding
/// centres, or a point at infinity.
pub fn triangulate_dlt(views: &[View]) -> Option<Vector3<f64>> {
    if views.len() < 2 {
        return None;
    }
    let inverse_count = 1.0 / views.len() as f64;
    let middle: Vector3<f64> =
        views.iter().map(|(pose, _)| pose.target_origin_in_source()).sum::<Vector3<f64>>() * inverse_count;
    let spread_sq: f64 = views.iter().map(|(pose, _)| pose.apply(&middle).norm_squared()).sum::<f64>() * inverse_count;
    let spread = spread_sq.sqrt();
    if spread.is_nan() || spread <= f64::MIN_POSITIVE {
        return None;
    }
    let mut normal = Matrix4::zeros();
    for (cam_from_world, seen) in views {
        let ray = seen.ray();
        let rotation = cam_from_world.rotation_matrix();
        let translation = cam_from_world.apply(&middle) / spread;
        // (I - b b^T) is its own square, so P^T (I - b b^T) P is built from A = R^T (I - b b^T).
        let across = Matrix3::identity() - ray * ray.transpose();
        let left = rotation.transpose() * across;
        let mut block = Matrix4::zeros();
        block.fixed_view_mut::<3, 3>(0, 0).copy_from(&(left * rotation));
        let corner = left * translation;
        block.fixed_view_mut::<3, 1>(0, 3).copy_from(&corner);
        block.fixed_view_mut::<1, 3>(3, 0).copy_from(&corner.transpose());
        block[(3, 3)] = translation.dot(&(across * translation));
        normal += block;
    }
    if !normal.iter().all(|v| v.is_finite()) {
        return None;
    }
    let eigen = normal.symmetric_eigen();
    let homogeneous: Vector4<f64> = eigen.eigenvectors.column(eigen.eigenvalues.imin()).into_owned();
    if homogeneous.w.abs() < MIN_HOMOGENEOUS_SHARE {
        return None;
    }
    Some(middle + homogeneous.xyz() * (spread / homogeneous.w))
}

/// Gauss-Newton steps of [`refine_point`]; it converges in two or three.
const MAX_REFINEMENTS: usize = 10;
/// A relative step that ends the refinement: what is left after it is the square of it.
const TINY_RELATIVE_STEP: f64 = 1e-7;

/// Moves a point to the least sum of squared reprojection errors on the planes z = 1 of its views, by Gauss-Newton
/// steps that are kept only while the error falls. A point not in front of all views is returned as it is.
pub fn refine_point(views: &[View], xyz: &Vector3<f64>) -> Vector3<f64> {
    let views: Vec<(Matrix3<f64>, Vector3<f64>, Vector2<f64>)> =
        views.iter().map(|(pose, seen)| (pose.rotation_matrix(), pose.translation, seen.0)).collect();
    let Some(mut here) = Linearised::at(&views, xyz) else { return *xyz };
    let mut at = *xyz;
    for _ in 0..MAX_REFINEMENTS {
        let Some(step) = here.hessian.cholesky().map(|factor| factor.solve(&here.gradient)) else { break };
        let next = at - step;
        let Some(there) = Linearised::at(&views, &next) else { break };
        if there.cost >= here.cost {
            break;
        }
        let small = step.norm() <= TINY_RELATIVE_STEP * at.norm();
        (at, here) = (next, there);
        if small {
            break;
        }
    }
    at
}

/// The normal equations of a point's reprojection errors on the planes z = 1.
struct Linearised {
    cost: f64,
    hessian: Matrix3<f64>,
    gradient: Vector3<f64>,
}

impl Linearised {
    /// With `r = (x / z, y / z) - seen` and `dr/dX = 1/z [1 0 -x/z; 0 1 -y/z] R`; none when a view has the point behind it.
    fn at(views: &[(Matrix3<f64>, Vector3<f64>, Vector2<f64>)], xyz: &Vector3<f64>) -> Option<Self> {
        let mut sums = Self { cost: 0.0, hessian: Matrix3::zeros(), gradient: Vector3::zeros() };
        for (rotation, translation, seen) in views {
            let x_in_cam = rotation * xyz + translation;
            if x_in_cam.z.is_nan() || x_in_cam.z <= 0.0 {
                return None;
            }
            let inverse_z = 1.0 / x_in_cam.z;
            let projected = x_in_cam.xy() * inverse_z;
            let by_cam = Matrix2x3::new(1.0, 0.0, -projected.x, 0.0, 1.0, -projected.y) * inverse_z;
            let jacobian = by_cam * rotation;
            let error = projected - seen;
            sums.cost += error.norm_squared();
            sums.hessian += jacobian.transpose() * jacobian;
            sums.gradient += jacobian.transpose() * error;
        }
        sums.cost.is_finite().then_some(sums)
    }
}

/// [`triangulate_dlt`], then [`refine_point`]; none unless the point is in front of all views.
pub fn triangulate(views: &[View]) -> Option<Vector3<f64>> {
    let xyz = refine_point(views, &triangulate_dlt(views)?);
    is_in_front_of_all(views, &xyz).then_some(xyz)
}

/// Whether a point in the world has positive depth in a camera (cheirality).
#[inline]
pub fn is_in_front(cam_from_world: &Rigid3, xyz: &Vector3<f64>) -> bool {
    cam_from_world.apply(xyz).z > 0.0
}

/// Whether a point has positive depth in all views.
pub fn is_in_front_of_all(views: &[View], xyz: &Vector3<f64>) -> bool {
    views.iter().all(|(pose, _)| is_in_front(pose, xyz))
}

/// The angle at a point between the rays to two camera centres, in radians, in [0, pi/2]: rays that are nearly opposite
/// fix the point as badly as nearly equal ones.
pub fn triangulation_angle_rad(center_a: &Vector3<f64>, center_b: &Vector3<f64>, xyz: &Vector3<f64>) -> f64 {
    let to_a = center_a - xyz;
    let to_b = center_b - xyz;
    to_a.cross(&to_b).norm().atan2(to_a.dot(&to_b).abs())
}

/// The largest [`triangulation_angle_rad`] over all pairs of views.
pub fn max_triangulation_angle_rad(views: &[View], xyz: &Vector3<f64>) -> f64 {
    let mut largest = 0.0f64;
    for (i, (pose_a, _)) in views.iter().enumerate() {
        let center_a = pose_a.target_origin_in_source();
        for (pose_b, _) in &views[..i] {
            largest = largest.max(triangulation_angle_rad(&center_a, &pose_b.target_origin_in_source(), xyz));
        }
    }
    largest
}

/// The angle between the ray a view saw and the ray to a point, in radians.
pub fn angular_error_rad(cam_from_world: &Rigid3, seen: &Normalized, xyz: &Vector3<f64>) -> f64 {
    let x_in_cam = cam_from_world.apply(xyz);
    let ray = seen.homogeneous();
    ray.cross(&x_in_cam).norm().atan2(ray.dot(&x_in_cam))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use nalgebra::UnitQuaternion;

    fn random_views(rng: &mut Rng, n: usize, xyz: &Vector3<f64>, offset: &Vector3<f64>, noise: f64) -> Vec<View> {
        (0..n)
            .map(|_| {
                let rotation = UnitQuaternion::from_scaled_axis(Vector3::from_fn(|_, _| rng.range(-0.2, 0.2)));
                let center = offset + Vector3::from_fn(|_, _| rng.range(-1.0, 1.0));
                let pose = Rigid3::from_center(rotation, &center);
                let x = pose.apply(xyz);
                let seen = x.xy() / x.z + Vector2::new(rng.normal(), rng.normal()) * noise;
                (pose, Normalized(seen))
            })
            .collect()
    }

    #[test]
    fn exact_views_give_the_exact_point_far_from_the_origin() {
        let mut rng = Rng::from_parts(&[1]);
        for n in [2, 3, 10] {
            for _ in 0..300 {
                let offset = Vector3::new(1e4, -2e4, 3e3);
                let xyz = offset + Vector3::new(rng.range(-2.0, 2.0), rng.range(-2.0, 2.0), rng.range(4.0, 20.0));
                let views = random_views(&mut rng, n, &xyz, &offset, 0.0);
                let wide = max_triangulation_angle_rad(&views, &xyz) > 0.01;
                let error = (triangulate_dlt(&views).unwrap() - xyz).norm();
                assert!(!wide || error < 1e-4, "{n} views: {error}");
                let error = (triangulate(&views).unwrap() - xyz).norm();
                assert!(!wide || error < 1e-5, "{n} views refined: {error}");
            }
        }
    }

    fn project(pose: &Rigid3, at: &Vector3<f64>) -> Vector2<f64> {
        let x_in_cam = pose.apply(at);
        x_in_cam.xy() / x_in_cam.z
    }

    #[test]
    fn refinement_lowers_the_noisy_error() {
        let mut rng = Rng::from_parts(&[2]);
        let (mut linear, mut refined, mut n) = (0.0, 0.0, 0.0);
        for _ in 0..300 {
            let xyz = Vector3::new(rng.range(-2.0, 2.0), rng.range(-2.0, 2.0), rng.range(4.0, 8.0));
            let views = random_views(&mut rng, 5, &xyz, &Vector3::zeros(), 1e-3);
            let dlt = triangulate_dlt(&views).unwrap();
            let best = refine_point(&views, &dlt);
            let cost = |at: &Vector3<f64>| -> f64 {
                views.iter().map(|(pose, seen)| (project(pose, at) - seen.0).norm_squared()).sum()
            };
            let (before, after) = (cost(&dlt), cost(&best));
            assert!(after <= before);
            linear += (dlt - xyz).norm_squared();
            refined += (best - xyz).norm_squared();
            n += 1.0;
        }
        assert!(refined <= linear * 1.02 && (refined / n).sqrt() < 0.05, "{linear} {refined}");
    }

    #[test]
    fn degenerate_views_give_nothing() {
        let seen = Normalized::new(0.1, 0.2);
        let pose = Rigid3::identity();
        assert!(triangulate_dlt(&[(pose, seen)]).is_none());
        assert!(triangulate(&[(pose, seen), (pose, seen)]).is_none());
        // Rays that meet behind both cameras.
        let beside = Rigid3::from_center(UnitQuaternion::identity(), &Vector3::new(1.0, 0.0, 0.0));
        assert!(triangulate(&[(pose, Normalized::new(-0.1, 0.0)), (beside, Normalized::new(0.1, 0.0))]).is_none());
    }

    #[test]
    fn angles_are_right() {
        let (a, b) = (Vector3::new(-1.0, 0.0, 0.0), Vector3::new(1.0, 0.0, 0.0));
        let at = Vector3::new(0.0, 0.0, 1.0);
        assert!((triangulation_angle_rad(&a, &b, &at) - std::f64::consts::FRAC_PI_2).abs() < 1e-12);
        let seen = Normalized::new(1.0, 0.0);
        let angle = angular_error_rad(&Rigid3::identity(), &seen, &at);
        assert!((angle - std::f64::consts::FRAC_PI_4).abs() < 1e-12);
    }
}
