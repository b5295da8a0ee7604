//! P4Pf: the pose and focal length of a camera with square pixels and known principal point, from four points.
//!
//! **Four points in space.** With the depths `d_i` along the axis (in units of the focal length) and the 4x4 matrix `X` of
//! the homogeneous points as columns, the camera matrix is linear in the depths: `P = [u d; v d; d] X^-1`. With `g_i` the
//! first three entries of row `i` of `X^-1`, its rows are `m1 = sum d_i u_i g_i`, `m2 = sum d_i v_i g_i`,
//! `m3 = sum d_i g_i`. Rows of a rotation are orthogonal, so with `G_ij = g_i . g_j`
//!
//!   m1.m2 = sum d_i d_j u_i v_j G_ij = 0,   m1.m3 = sum d_i d_j u_i G_ij = 0,   m2.m3 = sum d_i d_j v_i G_ij = 0:
//!
//! three quadrics in the ratios of the depths, which have at most eight common points. (The fourth condition, `|m1| = |m2|`,
//! is the one equation four points have too many; it chooses among the solutions.) The quadrics are intersected by hiding
//! one variable `x`: `y^2`, `z^2` and `yz` are expressed by the rest, and the identities `(y^2) z = (yz) y`,
//! `(yz) z = (z^2) y`, `(yz)(yz) = (y^2)(z^2)` become a 3x3 matrix of polynomials acting on `(y, z, 1)` whose determinant has
//! degree eight (Kukelova, Heller, Fitzgibbon, "Efficient Intersection of Three Quadrics and Applications in Computer
//! Vision", CVPR 2016).
//!
//! **Four points on a plane**, as on facades, make `X` singular. Then the homography from the plane gives two linear
//! equations for `1 / f^2` (Zhang, "A Flexible New Technique for Camera Calibration", PAMI 2000, equations 3 and 4).

use nalgebra::{Matrix3, Matrix4, Vector2, Vector3, Vector4};

use super::Solutions;
use super::homography::homography_four_point;
use crate::geometry::Rigid3;
use crate::math::polynomial::{determinant, evaluate, product, real_roots};

/// A pose with the focal length that goes with it.
#[derive(Clone, Copy, Debug)]
pub struct PoseWithFocal {
    /// The pose.
    pub cam_from_world: Rigid3,
    /// The focal length, in the unit of the image positions.
    pub focal: f64,
}

/// The volume of the tetrahedron relative to its edges below which four points are taken as coplanar...
const FLAT_VOLUME: f64 = 1e-2;
/// ...and above which they are taken as in space; between the two both ways are tried.
const CLEAR_VOLUME: f64 = 1e-4;
/// Newton steps on the depths; two take the closed form, which loses digits to its elimination, to rounding.
const POLISH_STEPS: usize = 2;
/// Widest ratio of the two focal lengths of a solution with square pixels; a plain mistake is far beyond, noise within.
const MAX_ASPECT: f64 = 1.5;

/// The poses and focal lengths under which four points are seen at positions relative to the principal point. Positions
/// should be of order 1 (in units of a guess of the focal length, say); points may have any scale.
pub fn p4pf(seen: &[Vector2<f64>; 4], points: &[Vector3<f64>; 4]) -> Solutions<PoseWithFocal, 8> {
    let mut solutions = Solutions::default();
    let middle = (points[0] + points[1] + points[2] + points[3]) / 4.0;
    let scale = points.iter().map(|x| (x - middle).norm()).sum::<f64>() / 4.0;
    if scale.is_nan() || scale <= f64::MIN_POSITIVE {
        return solutions;
    }
    let local = points.map(|x| (x - middle) / scale);
    let mut emit = |rows: [Vector3<f64>; 3], translation: Vector3<f64>| {
        if let Some(found) = camera_from_rows(&rows, &translation) {
            // x_cam = R (X - middle) / scale + t, times the scale.
            let Rigid3 { rotation, translation } = found.cam_from_world;
            let cam_from_world = Rigid3::new(rotation, translation * scale - rotation * middle);
            solutions.push(PoseWithFocal { cam_from_world, focal: found.focal });
        }
    };
    let edges = [local[1] - local[0], local[2] - local[0], local[3] - local[0]];
    let volume = edges[0].cross(&edges[1]).dot(&edges[2]).abs();
    let relative_volume = volume / (edges[0].norm() * edges[1].norm() * edges[2].norm());
    if relative_volume > CLEAR_VOLUME {
        in_space(seen, &local, &mut emit);
    }
    if relative_volume < FLAT_VOLUME {
        on_plane(seen, &local, &mut emit);
    }
    solutions
}

/// Turns the rows of `diag(f, f, 1) [R | t]` (up to a positive factor, fourth column apart) into a camera; none unless the
/// pixels are nearly square and the frame is right-handed.
fn camera_from_rows(rows: &[Vector3<f64>; 3], translation: &Vector3<f64>) -> Option<PoseWithFocal> {
    let lengths = rows.map(|row| row.norm());
    let aspect = lengths[0] / lengths[1];
    if !(1.0 / MAX_ASPECT..=MAX_ASPECT).contains(&aspect) {
        return None;
    }
    let focal = (lengths[0] * lengths[1]).sqrt() / lengths[2];
    // The rows are orthogonal up to rounding (in space) or noise (on a plane): take the nearest rotation.
    let r1 = rows[0] / lengths[0];
    let r2 = rows[1] / lengths[1];
    let r3 = rows[2] / lengths[2];
    let svd = Matrix3::from_rows(&[r1.transpose(), r2.transpose(), r3.transpose()]).svd(true, true);
    let rotation = svd.u? * svd.v_t?;
    if rotation.determinant() < 0.0 || !focal.is_finite() || focal <= 0.0 {
        return None;
    }
    let at = Vector3::new(translation.x / lengths[0], translation.y / lengths[1], translation.z / lengths[2]);
    let mut cam_from_world = Rigid3::from_matrix(&rotation, at);
    cam_from_world.rotation.renormalize();
    at.iter().all(|v| v.is_finite()).then_some(PoseWithFocal { cam_from_world, focal })
}

type Quadric = Matrix4<f64>;

fn in_space(
    seen: &[Vector2<f64>; 4],
    points: &[Vector3<f64>; 4],
    emit: &mut impl FnMut([Vector3<f64>; 3], Vector3<f64>),
) {
    let Some(inverse) = Matrix4::from_columns(&points.map(|x| x.push(1.0))).try_inverse() else { return };
    let g: [Vector3<f64>; 4] = std::array::from_fn(|i| inverse.fixed_view::<1, 3>(i, 0).transpose());
    let h: [f64; 4] = std::array::from_fn(|i| inverse[(i, 3)]);
    let quadric = |f: &dyn Fn(usize, usize) -> f64| {
        let q = Quadric::from_fn(|i, j| 0.5 * (f(i, j) + f(j, i)) * g[i].dot(&g[j]));
        q / q.norm().max(f64::MIN_POSITIVE)
    };
    let quadrics = [quadric(&|i, j| seen[i].x * seen[j].y), quadric(&|i, _| seen[i].x), quadric(&|i, _| seen[i].y)];
    for depths in intersect(&quadrics).iter() {
        if depths.min() <= 0.0 {
            continue;
        }
        let (mut rows, mut translation) = ([Vector3::zeros(); 3], Vector3::zeros());
        for i in 0..4 {
            for (row, factor) in [seen[i].x, seen[i].y, 1.0].into_iter().enumerate() {
                rows[row] += g[i] * (depths[i] * factor);
                translation[row] += h[i] * depths[i] * factor;
            }
        }
        emit(rows, translation);
    }
}

/// The common points, up to scale and with their last non-hidden coordinate positive, of three quadrics `d^T Q d = 0`.
fn intersect(quadrics: &[Quadric; 3]) -> Solutions<Vector4<f64>, 8> {
    let mut out = Solutions::default();
    // Choose the pair (y, z) whose squares and product the three equations determine best.
    let leading = |y: usize, z: usize| {
        Matrix3::from_fn(|r, c| match c {
            0 => quadrics[r][(y, y)],
            1 => quadrics[r][(z, z)],
            _ => 2.0 * quadrics[r][(y, z)],
        })
    };
    let strength = |y: usize, z: usize| {
        let m = leading(y, z);
        m.determinant().abs() / (m.norm().powi(3)).max(f64::MIN_POSITIVE)
    };
    let orders = [[2, 3, 0, 1], [1, 3, 0, 2], [1, 2, 0, 3], [0, 3, 1, 2], [0, 2, 1, 3], [0, 1, 2, 3]];
    let mut best = (orders[0], -1.0);
    for order in orders {
        let clear = strength(order[0], order[1]);
        if clear > best.1 {
            best = (order, clear);
        }
    }
    let [y, z, x, w] = best.0;
    let Some(inverse) = leading(y, z).try_inverse() else { return out };
    // With w = 1:  (y^2, z^2, yz)_i = p_i1(x) y + p_i2(x) z + p_i3(x).
    let linear = |a: usize, b: usize| -inverse * Vector3::from_fn(|r, _| 2.0 * quadrics[r][(a, b)]);
    let square = |a: usize| -inverse * Vector3::from_fn(|r, _| quadrics[r][(a, a)]);
    let (xy, yw, xz, zw) = (linear(x, y), linear(y, w), linear(x, z), linear(z, w));
    let (xx, xw, ww) = (square(x), linear(x, w), square(w));
    let p1: [[f64; 2]; 3] = std::array::from_fn(|i| [yw[i], xy[i]]);
    let p2: [[f64; 2]; 3] = std::array::from_fn(|i| [zw[i], xz[i]]);
    let p3: [[f64; 3]; 3] = std::array::from_fn(|i| [ww[i], xw[i], xx[i]]);
    let sum = |terms: &[(f64, [f64; 3])]| -> [f64; 3] {
        std::array::from_fn(|k| terms.iter().map(|(sign, t)| sign * t[k]).sum())
    };
    let sum4 = |terms: &[(f64, [f64; 4])]| -> [f64; 4] {
        std::array::from_fn(|k| terms.iter().map(|(sign, t)| sign * t[k]).sum())
    };
    let by = |a: &[f64; 2], b: &[f64; 2]| product::<2, 2, 3>(a, b);
    let by2 = |a: &[f64; 2], b: &[f64; 3]| product::<2, 3, 4>(a, b);
    // (y^2) z - (yz) y = 0
    let first = (
        sum(&[(-1.0, by(&p2[2], &p1[2])), (1.0, by(&p2[0], &p1[1])), (-1.0, p3[2])]),
        sum(&[
            (1.0, by(&p1[0], &p2[2])),
            (-1.0, by(&p2[2], &p2[2])),
            (1.0, by(&p2[0], &p2[1])),
            (-1.0, by(&p1[2], &p2[0])),
            (1.0, p3[0]),
        ]),
        sum4(&[
            (1.0, by2(&p1[0], &p3[2])),
            (-1.0, by2(&p2[2], &p3[2])),
            (1.0, by2(&p2[0], &p3[1])),
            (-1.0, by2(&p1[2], &p3[0])),
        ]),
    );
    // (yz) z - (z^2) y = 0
    let second = (
        sum(&[
            (1.0, by(&p1[2], &p1[2])),
            (-1.0, by(&p2[1], &p1[2])),
            (1.0, by(&p2[2], &p1[1])),
            (-1.0, by(&p1[1], &p1[0])),
            (-1.0, p3[1]),
        ]),
        sum(&[(1.0, by(&p1[2], &p2[2])), (-1.0, by(&p1[1], &p2[0])), (1.0, p3[2])]),
        sum4(&[
            (1.0, by2(&p1[2], &p3[2])),
            (-1.0, by2(&p2[1], &p3[2])),
            (1.0, by2(&p2[2], &p3[1])),
            (-1.0, by2(&p1[1], &p3[0])),
        ]),
    );
    // (yz)(yz) - (y^2)(z^2) = 0, where a, b, c multiply y^2, z^2, yz.
    let a = sum(&[(1.0, by(&p1[2], &p1[2])), (-1.0, by(&p1[0], &p1[1]))]);
    let b = sum(&[(1.0, by(&p2[2], &p2[2])), (-1.0, by(&p2[0], &p2[1]))]);
    let c = sum(&[(2.0, by(&p1[2], &p2[2])), (-1.0, by(&p1[0], &p2[1])), (-1.0, by(&p2[0], &p1[1]))]);
    let third_y = sum4(&[
        (1.0, by2(&p1[0], &a)),
        (1.0, by2(&p1[1], &b)),
        (1.0, by2(&p1[2], &c)),
        (2.0, by2(&p1[2], &p3[2])),
        (-1.0, by2(&p1[0], &p3[1])),
        (-1.0, by2(&p1[1], &p3[0])),
    ]);
    let third_z = sum4(&[
        (1.0, by2(&p2[0], &a)),
        (1.0, by2(&p2[1], &b)),
        (1.0, by2(&p2[2], &c)),
        (2.0, by2(&p2[2], &p3[2])),
        (-1.0, by2(&p2[0], &p3[1])),
        (-1.0, by2(&p2[1], &p3[0])),
    ]);
    let wide = |l: &[f64; 3], r: &[f64; 3]| product::<3, 3, 5>(l, r);
    let terms = [
        (1.0, wide(&a, &p3[0])),
        (1.0, wide(&b, &p3[1])),
        (1.0, wide(&c, &p3[2])),
        (1.0, wide(&p3[2], &p3[2])),
        (-1.0, wide(&p3[0], &p3[1])),
    ];
    let third_1: [f64; 5] = std::array::from_fn(|k| terms.iter().map(|(sign, t)| sign * t[k]).sum());
    let pad = |v: &[f64; 3]| [v[0], v[1], v[2], 0.0];
    let pad4 = |v: &[f64; 4]| [v[0], v[1], v[2], v[3], 0.0];
    let (f, s) = ((pad(&first.0), pad(&first.1), pad4(&first.2)), (pad(&second.0), pad(&second.1), pad4(&second.2)));
    let polynomial: [f64; 9] = determinant([(&f.0, &f.1, &f.2), (&s.0, &s.1, &s.2), (&third_y, &third_z, &third_1)]);
    for &root in real_roots(&polynomial).as_slice() {
        let row = |p: &[f64; 4], q: &[f64; 4], r: &[f64; 5]| {
            Vector3::new(evaluate(p, root), evaluate(q, root), evaluate(r, root))
        };
        let rows = [row(&f.0, &f.1, &f.2), row(&s.0, &s.1, &s.2), row(&third_y, &third_z, &third_1)];
        let unit = rows.map(|r| r / r.norm().max(f64::MIN_POSITIVE));
        let crosses = [unit[0].cross(&unit[1]), unit[1].cross(&unit[2]), unit[2].cross(&unit[0])];
        let solution = crosses.iter().fold(crosses[0], |b, c| if c.norm_squared() > b.norm_squared() { *c } else { b });
        let mut depths = Vector4::zeros();
        depths[x] = root;
        depths[w] = 1.0;
        depths[y] = solution.x / solution.z;
        depths[z] = solution.y / solution.z;
        let depths = polish(quadrics, depths, [x, y, z]);
        if depths.iter().all(|v| v.is_finite()) {
            out.push(depths);
        }
    }
    out
}

/// Newton's method on `d^T Q_k d = 0` for three of the coordinates.
fn polish(quadrics: &[Quadric; 3], mut depths: Vector4<f64>, free: [usize; 3]) -> Vector4<f64> {
    for _ in 0..POLISH_STEPS {
        let images = quadrics.map(|q| q * depths);
        let residual = Vector3::from_fn(|k, _| depths.dot(&images[k]));
        let jacobian = Matrix3::from_fn(|k, c| 2.0 * images[k][free[c]]);
        let Some(inverse) = jacobian.try_inverse() else { break };
        let step = inverse * residual;
        for (c, &coordinate) in free.iter().enumerate() {
            depths[coordinate] -= step[c];
        }
    }
    depths
}

fn on_plane(
    seen: &[Vector2<f64>; 4],
    points: &[Vector3<f64>; 4],
    emit: &mut impl FnMut([Vector3<f64>; 3], Vector3<f64>),
) {
    // A frame of the plane, from the longest cross product of edges, right-handed in e1, e2, normal.
    let mut normal = Vector3::zeros();
    for (i, j, k) in [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)] {
        let cross: Vector3<f64> = (points[j] - points[i]).cross(&(points[k] - points[i]));
        if cross.norm_squared() > normal.norm_squared() {
            normal = cross;
        }
    }
    let (Some(normal), Some(e1)) =
        (normal.try_normalize(f64::MIN_POSITIVE), (points[1] - points[0]).try_normalize(f64::MIN_POSITIVE))
    else {
        return;
    };
    let e2 = normal.cross(&e1);
    // Seen from its back the plane is turned over: use the frame that faces the camera.
    for e2 in [e2, -e2] {
        let flat = points.map(|x| Vector2::new(e1.dot(&(x - points[0])), e2.dot(&(x - points[0]))));
        let Some(homography) = homography_four_point(&flat, seen) else { continue };
        // The sign that puts the points in front: the third row is the depth.
        let depth = homography.row(2).transpose().dot(&flat[0].push(1.0));
        let h = if depth < 0.0 { -homography } else { homography };
        let (h1, h2, h3) = (h.column(0), h.column(1), h.column(2));
        // w = 1/f^2:  (h11 h12 + h21 h22) w + h31 h32 = 0,  (h11^2 + h21^2 - h12^2 - h22^2) w + h31^2 - h32^2 = 0
        let a = Vector2::new(h1.xy().dot(&h2.xy()), h1.xy().norm_squared() - h2.xy().norm_squared());
        let b = Vector2::new(h1.z * h2.z, h1.z * h1.z - h2.z * h2.z);
        let w = -a.dot(&b) / a.norm_squared();
        if w.is_nan() || w <= 0.0 {
            continue;
        }
        let focal = 1.0 / w.sqrt();
        let undo = |v: Vector3<f64>| Vector3::new(v.x / focal, v.y / focal, v.z);
        let (r1, r2, t) = (undo(h1.into_owned()), undo(h2.into_owned()), undo(h3.into_owned()));
        let size = 0.5 * (r1.norm() + r2.norm());
        let (r1, r2, t) = (r1 / size, r2 / size, t / size);
        let cam_from_frame = Matrix3::from_columns(&[r1, r2, r1.cross(&r2)]);
        let frame_from_local = Matrix3::from_columns(&[e1, e2, e1.cross(&e2)]).transpose();
        let rotation = cam_from_frame * frame_from_local;
        let translation = t - rotation * points[0];
        let row = |i: usize, factor: f64| rotation.row(i).transpose() * factor;
        emit(
            [row(0, focal), row(1, focal), row(2, 1.0)],
            Vector3::new(translation.x * focal, translation.y * focal, translation.z),
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use crate::solvers::test_scenes::{random_points_in_front, random_pose};

    fn solves(rng: &mut Rng, flatten: bool, noise: f64, tolerance: f64) -> (bool, usize) {
        let pose = random_pose(rng);
        let mut points: [Vector3<f64>; 4] = random_points_in_front(rng, &pose);
        if flatten {
            points[3] = points[0] + (points[1] - points[0]) * 0.7 + (points[2] - points[0]) * 0.8;
        }
        let focal = rng.range(0.6, 2.0);
        let seen = points.map(|x| {
            let x = pose.apply(&x);
            x.xy() * (focal / x.z) + Vector2::new(rng.normal(), rng.normal()) * noise
        });
        let found = p4pf(&seen, &points);
        let hit = found.iter().any(|candidate| {
            (candidate.focal / focal - 1.0).abs() < tolerance
                && candidate.cam_from_world.rotation.angle_to(&pose.rotation) < tolerance
                && (candidate.cam_from_world.translation - pose.translation).norm() < 10.0 * tolerance
        });
        (hit, found.len())
    }

    #[test]
    fn planted_cameras_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        for flatten in [false, true] {
            let (mut failures, mut candidates) = (0, 0);
            for _ in 0..1000 {
                let (hit, n) = solves(&mut rng, flatten, 0.0, 1e-3);
                failures += usize::from(!hit);
                candidates += n;
            }
            assert!(failures < 10, "{failures} of 1000 failed (coplanar: {flatten})");
            assert!(candidates < 4000, "{candidates} candidates for 1000 problems");
        }
    }

    #[test]
    fn noise_is_tolerated() {
        let mut rng = Rng::from_parts(&[2]);
        let hits = (0..1000).filter(|_| solves(&mut rng, false, 5e-4, 0.1).0).count();
        assert!(hits > 700, "{hits} of 1000");
    }

    #[test]
    fn coinciding_points_give_nothing() {
        assert!(p4pf(&[Vector2::zeros(); 4], &[Vector3::x(); 4]).is_empty());
    }
}
