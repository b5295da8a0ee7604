//! P3P: the pose of a calibrated camera from three points and the rays that see them. Up to four solutions.
//!
//! With unit rays `y_i`, points `x_i` and depths `l_i` along the rays, the three distances give
//!
//!   l_i^2 + l_j^2 - 2 (y_i . y_j) l_i l_j = |x_i - x_j|^2 = a_ij,   that is   l^T M_ij l = a_ij.
//!
//! Eliminating the right-hand sides leaves two homogeneous conics, `D1 = a23 M12 - a12 M23` and `D2 = a23 M13 - a13 M23`.
//! The pencil `D1 + g D2` has a singular member where the cubic `det(D1 + g D2)` vanishes; a singular conic is a pair of
//! lines, and each line meets the other conics where a quadratic vanishes. This is the elimination of Persson and
//! Nordberg, "Lambda Twist: An Accurate Fast Robust Perspective Three Point (P3P) Solver", ECCV 2018 (sections 3.2-3.4),
//! whose Gauss-Newton polish of the depths is kept too (3.5). The line pair is split through the adjugate, as Ding, Yang,
//! Larsson, Olsson and Astrom, "Revisiting the P3P Problem", CVPR 2023, do, and the lines are used in parametric form so
//! that no depth has to be divided by.

use nalgebra::{Matrix3, Vector3};

use super::Solutions;
use crate::geometry::Rigid3;
use crate::geometry::epipolar::cross_matrix;
use crate::math::polynomial::real_roots;

/// A squared sine (of the triangle's angle) below which three points lie on a line for f64.
const MIN_TRIANGLE_SINE_SQ: f64 = 1e-12;
/// Rounding of the adjugate of a conic of unit norm; smaller diagonals are zero, and both lines are one.
const ADJUGATE_EPSILON: f64 = 1e-14;
/// Gauss-Newton steps on the depths; two reach rounding from the closed form.
const POLISH_STEPS: usize = 2;

/// The poses `cam_from_world` that send three points (in the world) on to three unit rays (in the camera frame), with
/// positive depths. None for points on a line.
pub fn p3p(rays: &[Vector3<f64>; 3], points: &[Vector3<f64>; 3]) -> Solutions<Rigid3, 4> {
    let mut solutions = Solutions::default();
    let sides = [points[0] - points[1], points[0] - points[2], points[1] - points[2]];
    let sides_sq = sides.map(|side| side.norm_squared());
    let scale_sq: f64 = sides_sq.iter().sum();
    let area = sides[0].cross(&sides[1]).norm_squared();
    if area.is_nan() || area <= MIN_TRIANGLE_SINE_SQ * scale_sq * scale_sq {
        return solutions;
    }
    // Distances 12, 13, 23 in units of their root sum of squares; the forms are symmetric matrices.
    let a = sides_sq.map(|side_sq| side_sq / scale_sq);
    let cosines = [rays[0].dot(&rays[1]), rays[0].dot(&rays[2]), rays[1].dot(&rays[2])];
    let m12 = Matrix3::new(1.0, -cosines[0], 0.0, -cosines[0], 1.0, 0.0, 0.0, 0.0, 0.0);
    let m13 = Matrix3::new(1.0, 0.0, -cosines[1], 0.0, 0.0, 0.0, -cosines[1], 0.0, 1.0);
    let m23 = Matrix3::new(0.0, 0.0, 0.0, 0.0, 1.0, -cosines[2], 0.0, -cosines[2], 1.0);
    let d1 = m12 * a[2] - m23 * a[0];
    let d2 = m13 * a[2] - m23 * a[1];
    let Some((first, second, gamma)) = split_pencil(&d1, &d2) else { return solutions };
    // On a line of D1 + g D2 both conics agree up to a factor, unless g makes one of them the singular conic itself.
    let conic = if gamma.abs() < 1.0 { d2 } else { d1 };
    let total = m12 + m13 + m23;
    let scale = scale_sq.sqrt();
    for line in [first, second] {
        for direction in meet(&line, &conic).iter() {
            let depths = if direction.sum() < 0.0 { -direction } else { *direction };
            let size = depths.dot(&(total * depths));
            if depths.min() <= 0.0 || size.is_nan() || size <= 0.0 {
                continue;
            }
            let depths = polish(&(depths / size.sqrt()), &a, &cosines);
            if depths.min() > 0.0
                && let Some(pose) = align(&(depths * scale), rays, points)
            {
                solutions.push(pose);
            }
        }
    }
    solutions
}

/// The two lines of the singular conic `D1 + g D2` that is most clearly a real pair of lines, and `g`.
///
/// With lines `l` and `m` the conic is `D = l m^T + m l^T` up to scale and `adj(D) = -(l x m)(l x m)^T`, so a column of the
/// adjugate gives `p = +-(l x m)`, and `D + [p]_x` is `2 l m^T` or its transpose: its rows are one line, its columns the
/// other.
fn split_pencil(d1: &Matrix3<f64>, d2: &Matrix3<f64>) -> Option<(Vector3<f64>, Vector3<f64>, f64)> {
    let (adj1, adj2) = (adjugate(d1), adjugate(d2));
    let cubic = [
        d1.row(0).transpose().dot(&adj1.column(0)),
        adj1.component_mul(d2).sum(),
        adj2.component_mul(d1).sum(),
        d2.row(0).transpose().dot(&adj2.column(0)),
    ];
    let mut best: Option<(f64, Matrix3<f64>, Matrix3<f64>, f64)> = None;
    for &gamma in real_roots(&cubic).as_slice() {
        let conic = d1 + d2 * gamma;
        let norm = conic.norm();
        if norm <= 0.0 || !norm.is_finite() {
            continue;
        }
        let conic = conic / norm;
        let adj = adjugate(&conic);
        let lowest = adj.diagonal().min();
        if best.as_ref().is_none_or(|(least, ..)| lowest < *least) {
            best = Some((lowest, conic, adj, gamma));
        }
    }
    let (lowest, conic, adj, gamma) = best?;
    if lowest > ADJUGATE_EPSILON {
        return None;
    }
    let split = if lowest < -ADJUGATE_EPSILON {
        let column = adj.column(adj.diagonal().imin()) / (-lowest).sqrt();
        conic + cross_matrix(&column)
    } else {
        conic
    };
    let (row, column) = split.iamax_full();
    Some((split.row(row).transpose(), split.column(column).into_owned(), gamma))
}

/// The adjugate of a symmetric matrix.
fn adjugate(m: &Matrix3<f64>) -> Matrix3<f64> {
    let (c0, c1, c2) = (m.column(0), m.column(1), m.column(2));
    Matrix3::from_columns(&[c1.cross(&c2), c2.cross(&c0), c0.cross(&c1)])
}

/// The directions `v` with `line . v = 0` and `v^T conic v = 0`.
fn meet(line: &Vector3<f64>, conic: &Matrix3<f64>) -> Solutions<Vector3<f64>, 2> {
    let mut out = Solutions::default();
    let Some(normal) = line.try_normalize(f64::MIN_POSITIVE) else { return out };
    // An orthonormal basis of the plane across the line, from the axis it is least along.
    let mut axis = Vector3::zeros();
    axis[normal.iamin()] = 1.0;
    let u = normal.cross(&axis).normalize();
    let v = normal.cross(&u);
    let (uu, uv, vv) = (u.dot(&(conic * u)), u.dot(&(conic * v)), v.dot(&(conic * v)));
    let discriminant = uv * uv - uu * vv;
    if discriminant < 0.0 {
        return out;
    }
    // uu s^2 + 2 uv s t + vv t^2 = 0, both roots without cancellation.
    let q = uv + discriminant.sqrt().copysign(uv);
    out.push(u * -q + v * uu);
    out.push(u * -vv + v * q);
    out
}

/// Gauss-Newton on the three distance equations.
fn polish(depths: &Vector3<f64>, a: &[f64; 3], cosines: &[f64; 3]) -> Vector3<f64> {
    let mut l = *depths;
    for _ in 0..POLISH_STEPS {
        let [c12, c13, c23] = *cosines;
        let residual = Vector3::new(
            l.x * l.x + l.y * l.y - 2.0 * c12 * l.x * l.y - a[0],
            l.x * l.x + l.z * l.z - 2.0 * c13 * l.x * l.z - a[1],
            l.y * l.y + l.z * l.z - 2.0 * c23 * l.y * l.z - a[2],
        );
        let jacobian = Matrix3::new(
            l.x - c12 * l.y,
            l.y - c12 * l.x,
            0.0,
            l.x - c13 * l.z,
            0.0,
            l.z - c13 * l.x,
            0.0,
            l.y - c23 * l.z,
            l.z - c23 * l.y,
        ) * 2.0;
        let Some(inverse) = jacobian.try_inverse() else { break };
        let next = l - inverse * residual;
        if !next.iter().all(|v| v.is_finite()) {
            break;
        }
        l = next;
    }
    l
}

/// The pose that sends the triangle of the points on to the triangle at these depths along the rays.
fn align(depths: &Vector3<f64>, rays: &[Vector3<f64>; 3], points: &[Vector3<f64>; 3]) -> Option<Rigid3> {
    let seen = [rays[0] * depths[0], rays[1] * depths[1], rays[2] * depths[2]];
    let rotation = frame(&seen)? * frame(points)?.transpose();
    let translation = (seen[0] + seen[1] + seen[2] - rotation * (points[0] + points[1] + points[2])) / 3.0;
    let mut pose = Rigid3::from_matrix(&rotation, translation);
    pose.rotation.renormalize();
    Some(pose)
}

/// The orthonormal frame of a triangle: along its first side, across it in its plane, and its normal, as columns.
fn frame(corners: &[Vector3<f64>; 3]) -> Option<Matrix3<f64>> {
    let along = (corners[1] - corners[0]).try_normalize(f64::MIN_POSITIVE)?;
    let normal = along.cross(&(corners[2] - corners[0])).try_normalize(f64::MIN_POSITIVE)?;
    Some(Matrix3::from_columns(&[along, normal.cross(&along), normal]))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use crate::solvers::test_scenes::{random_points_in_front, random_pose};

    #[test]
    fn planted_poses_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        let (mut failures, mut candidates) = (0, 0);
        for _ in 0..1000 {
            let pose = random_pose(&mut rng);
            let points: [Vector3<f64>; 3] = random_points_in_front(&mut rng, &pose);
            let rays = points.map(|x| pose.apply(&x).normalize());
            let found = p3p(&rays, &points);
            candidates += found.len();
            for candidate in found.iter() {
                for (ray, x) in rays.iter().zip(&points) {
                    assert!((candidate.apply(x).normalize() - ray).norm() < 1e-6, "a candidate misses its rays");
                }
            }
            let hit = found.iter().any(|candidate| {
                candidate.rotation.angle_to(&pose.rotation) < 1e-5
                    && (candidate.translation - pose.translation).norm() < 1e-4
            });
            failures += usize::from(!hit);
        }
        assert!(failures < 10, "{failures} of 1000 failed");
        assert!(candidates < 3000, "{candidates} candidates for 1000 problems");
    }

    #[test]
    fn points_on_a_line_give_nothing() {
        let points = [Vector3::new(0.0, 0.0, 5.0), Vector3::new(1.0, 0.0, 5.0), Vector3::new(2.0, 0.0, 5.0)];
        assert!(p3p(&points.map(|x| x.normalize()), &points).is_empty());
        assert!(p3p(&[Vector3::z(); 3], &[Vector3::z(); 3]).is_empty());
    }
}
