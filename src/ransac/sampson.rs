//! Gauss-Newton on the Sampson error of an epipolar matrix: the local optimisation of the essential and the fundamental
//! matrix.
//!
//! For a pair with `e = x_b^T M x_a`, `l = M x_a`, `m = M^T x_b` and `s^2 = l_1^2 + l_2^2 + m_1^2 + m_2^2` the residual is
//! `r = e / s`. Its derivative by an entry of `M` (row `i`, column `j`) is
//!
//!   dr/dM_ij = x_b,i x_a,j / s - (e / s^3) ([i < 3] l_i x_a,j + [j < 3] m_j x_b,i),
//!
//! and `dr/dp_k = sum_ij dr/dM_ij dM_ij/dp_k` for the parameters of the matrix. The 9x9 moments `G = sum w g g^T` and
//! `h = sum w r g` of `g = dr/dM` are gathered first, so that a pair costs the same whatever the parameters are; then
//! `(D^T G D) step = -D^T h` with the 9xP matrix `D = dM/dp`.

use nalgebra::{Matrix3, SMatrix, SVector, UnitQuaternion, Vector3};

use super::PointPair;
use crate::geometry::Rigid3;
use crate::geometry::epipolar::{cross_matrix, decompose_essential};

/// A parametrised epipolar matrix with `P` degrees of freedom.
pub(super) trait EpipolarParameters<const P: usize>: Copy {
    /// The matrix.
    fn matrix(&self) -> Matrix3<f64>;
    /// Its derivatives by the parameters of [`EpipolarParameters::step`], at zero.
    fn derivatives(&self) -> [Matrix3<f64>; P];
    /// After a step.
    fn step(&self, delta: &SVector<f64, P>) -> Self;
}

/// `E = [t]_x R`: turns of `R` (left) and moves of the unit vector `t` along two tangents.
#[derive(Clone, Copy)]
pub(super) struct EssentialParameters {
    pose: Rigid3,
}

impl EssentialParameters {
    /// Of an essential matrix: any of its four poses serves, as all have the same matrix up to sign.
    pub fn new(essential: &Matrix3<f64>) -> Option<Self> {
        Some(Self { pose: decompose_essential(essential)?[0] })
    }

    fn tangents(&self) -> [Vector3<f64>; 2] {
        let t = &self.pose.translation;
        let mut axis = Vector3::zeros();
        axis[t.iamin()] = 1.0;
        let first = t.cross(&axis).normalize();
        [first, t.cross(&first)]
    }
}

impl EpipolarParameters<5> for EssentialParameters {
    fn matrix(&self) -> Matrix3<f64> {
        cross_matrix(&self.pose.translation) * self.pose.rotation_matrix()
    }

    fn derivatives(&self) -> [Matrix3<f64>; 5] {
        let rotation = self.pose.rotation_matrix();
        let translation = cross_matrix(&self.pose.translation);
        let [u, v] = self.tangents();
        let turned = |axis: Vector3<f64>| translation * cross_matrix(&axis) * rotation;
        let moved = |tangent: &Vector3<f64>| cross_matrix(tangent) * rotation;
        [turned(Vector3::x()), turned(Vector3::y()), turned(Vector3::z()), moved(&u), moved(&v)]
    }

    fn step(&self, delta: &SVector<f64, 5>) -> Self {
        let [u, v] = self.tangents();
        let mut pose = self.pose.step(&Vector3::new(delta[0], delta[1], delta[2]), &(u * delta[3] + v * delta[4]));
        pose.translation.normalize_mut();
        Self { pose }
    }
}

/// `F = U diag(1, s, 0) V^T`: turns of `U` and `V` (right), and `s` (Bartoli and Sturm, "Nonlinear Estimation of the
/// Fundamental Matrix with Minimal Parameters", PAMI 2004).
#[derive(Clone, Copy)]
pub(super) struct FundamentalParameters {
    u: UnitQuaternion<f64>,
    s: f64,
    v: UnitQuaternion<f64>,
}

impl FundamentalParameters {
    /// Of a fundamental matrix, up to scale and sign.
    pub fn new(fundamental: &Matrix3<f64>) -> Option<Self> {
        if !fundamental.iter().all(|v| v.is_finite()) {
            return None;
        }
        let svd = fundamental.svd(true, true);
        let (mut u, mut v) = (svd.u?, svd.v_t?.transpose());
        // The third columns meet the singular value 0, so their signs are free.
        for rotation in [&mut u, &mut v] {
            if rotation.determinant() < 0.0 {
                rotation.column_mut(2).neg_mut();
            }
        }
        let s = svd.singular_values[1] / svd.singular_values[0];
        let unit = |m: &Matrix3<f64>| {
            let mut q = UnitQuaternion::from_rotation_matrix(&nalgebra::Rotation3::from_matrix_unchecked(*m));
            q.renormalize();
            q
        };
        s.is_finite().then(|| Self { u: unit(&u), s, v: unit(&v) })
    }
}

impl EpipolarParameters<7> for FundamentalParameters {
    fn matrix(&self) -> Matrix3<f64> {
        let (u, v) = (self.u.to_rotation_matrix().into_inner(), self.v.to_rotation_matrix().into_inner());
        u * Matrix3::from_diagonal(&Vector3::new(1.0, self.s, 0.0)) * v.transpose()
    }

    fn derivatives(&self) -> [Matrix3<f64>; 7] {
        let (u, v) = (self.u.to_rotation_matrix().into_inner(), self.v.to_rotation_matrix().into_inner());
        let middle = Matrix3::from_diagonal(&Vector3::new(1.0, self.s, 0.0));
        let axes = [Vector3::x(), Vector3::y(), Vector3::z()];
        let mut out = [Matrix3::zeros(); 7];
        for (k, axis) in axes.iter().enumerate() {
            out[k] = u * cross_matrix(axis) * middle * v.transpose();
            out[3 + k] = u * middle * (v * cross_matrix(axis)).transpose();
        }
        out[6] = u.column(1) * v.column(1).transpose();
        out
    }

    fn step(&self, delta: &SVector<f64, 7>) -> Self {
        let turn = |at: usize| UnitQuaternion::from_scaled_axis(Vector3::new(delta[at], delta[at + 1], delta[at + 2]));
        let (mut u, mut v) = (self.u * turn(0), self.v * turn(3));
        u.renormalize_fast();
        v.renormalize_fast();
        Self { u, s: self.s + delta[6], v }
    }
}

/// The residual `r = e / s` of a pair and its derivative by the matrix, row by row.
#[inline]
fn residual_with_gradient(m: &Matrix3<f64>, pair: &PointPair) -> (f64, SVector<f64, 9>) {
    let (xa, xb) = (pair.a.push(1.0), pair.b.push(1.0));
    let (line_b, line_a) = (m * xa, m.tr_mul(&xb));
    let e = xb.dot(&line_b);
    let s_sq = line_b.xy().norm_squared() + line_a.xy().norm_squared();
    let inverse_s = 1.0 / s_sq.sqrt();
    let r = e * inverse_s;
    let pull = r * inverse_s * inverse_s;
    let mut gradient = SVector::<f64, 9>::zeros();
    for i in 0..3 {
        let row = xb[i] * inverse_s - if i < 2 { pull * line_b[i] } else { 0.0 };
        for j in 0..3 {
            gradient[3 * i + j] = row * xa[j] - if j < 2 { pull * line_a[j] * xb[i] } else { 0.0 };
        }
    }
    (r, gradient)
}

/// Gauss-Newton steps of one refinement; the robust loop repeats refinements while they pay.
const STEPS: usize = 2;
/// Damping of the normal equations relative to their diagonal: keeps directions the data leave open (such as the
/// translation of a pure rotation) from stepping wildly.
const DAMPING: f64 = 1e-6;
/// The Cauchy weight `1 / (1 + r^2 / c^2)` has `c` at this share of the (squared) inlier threshold, about the noise itself.
const CAUCHY_SHARE_SQ: f64 = 0.25;

/// A better matrix from the pairs `inliers`; none without a usable step.
pub(super) fn refine_sampson<M: EpipolarParameters<P>, const P: usize>(
    start: M,
    pairs: &[PointPair],
    inliers: &[usize],
    threshold_sq: f64,
) -> Option<Matrix3<f64>> {
    let mut at = start;
    if inliers.len() < P {
        return None;
    }
    for _ in 0..STEPS {
        let matrix = at.matrix();
        let mut moments = SMatrix::<f64, 9, 9>::zeros();
        let mut pull = SVector::<f64, 9>::zeros();
        for &datum in inliers {
            let (r, gradient) = residual_with_gradient(&matrix, &pairs[datum]);
            let weight = 1.0 / (1.0 + r * r / (CAUCHY_SHARE_SQ * threshold_sq));
            if !weight.is_finite() {
                continue;
            }
            for j in 0..9 {
                let scaled = weight * gradient[j];
                pull[j] += scaled * r;
                for i in 0..=j {
                    moments[(i, j)] += scaled * gradient[i];
                }
            }
        }
        moments.fill_lower_triangle_with_upper_triangle();
        let derivatives = at.derivatives();
        let by_parameters = SMatrix::<f64, 9, P>::from_fn(|entry, k| derivatives[k][(entry / 3, entry % 3)]);
        let mut hessian: SMatrix<f64, P, P> = by_parameters.transpose() * moments * by_parameters;
        for k in 0..P {
            hessian[(k, k)] += DAMPING * hessian[(k, k)] + f64::MIN_POSITIVE;
        }
        let step = hessian.cholesky()?.solve(&(by_parameters.transpose() * -pull));
        if !step.iter().all(|v: &f64| v.is_finite()) {
            return None;
        }
        at = at.step(&step);
    }
    let matrix = at.matrix();
    Some(matrix / matrix.norm())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::{essential_from_pose, sampson_error_sq};
    use crate::math::Rng;
    use crate::solvers::test_scenes::{matrix_distance, random_pairs, random_relative_pose};
    use nalgebra::Vector2;

    fn check_derivatives<M: EpipolarParameters<P>, const P: usize>(at: M, pair: &PointPair) {
        let derivatives = at.derivatives();
        let (_, gradient) = residual_with_gradient(&at.matrix(), pair);
        let h = 1e-6;
        for k in 0..P {
            let mut delta = SVector::<f64, P>::zeros();
            delta[k] = h;
            let (ahead, behind) = (at.step(&delta).matrix(), at.step(&-delta).matrix());
            let difference = (ahead - behind) / (2.0 * h);
            assert!((difference - derivatives[k]).norm() < 1e-8, "derivative of the matrix by parameter {k}");
            let slope = (residual_with_gradient(&ahead, pair).0 - residual_with_gradient(&behind, pair).0) / (2.0 * h);
            let analytic: f64 = (0..9).map(|i| gradient[i] * derivatives[k][(i / 3, i % 3)]).sum();
            assert!((slope - analytic).abs() < 1e-7, "derivative of the residual by parameter {k}");
        }
    }

    #[test]
    fn jacobians_agree_with_differences() {
        let mut rng = Rng::from_parts(&[1]);
        let pair = PointPair { a: Vector2::new(0.3, -0.2), b: Vector2::new(-0.1, 0.4) };
        for _ in 0..20 {
            let essential = essential_from_pose(&random_relative_pose(&mut rng)).unwrap();
            check_derivatives(EssentialParameters::new(&essential).unwrap(), &pair);
            let k = Matrix3::new(1.3, 0.0, 0.1, 0.0, 1.2, -0.1, 0.0, 0.0, 1.0);
            check_derivatives(FundamentalParameters::new(&(k.transpose() * essential * k)).unwrap(), &pair);
        }
    }

    #[test]
    fn parameters_keep_the_matrix_and_refinement_finds_the_truth() {
        let mut rng = Rng::from_parts(&[2]);
        for _ in 0..100 {
            let b_from_a = random_relative_pose(&mut rng);
            let truth = essential_from_pose(&b_from_a).unwrap();
            let (a, b) = random_pairs::<30>(&mut rng, &b_from_a);
            let pairs: Vec<_> = a.into_iter().zip(b).map(|(a, b)| PointPair { a, b }).collect();
            let all: Vec<_> = (0..pairs.len()).collect();
            let parameters = EssentialParameters::new(&truth).unwrap();
            assert!(matrix_distance(&parameters.matrix(), &truth) < 1e-9);
            let off = parameters.step(&SVector::<f64, 5>::from_fn(|_, _| rng.range(-0.005, 0.005)));
            let found = refine_sampson(off, &pairs, &all, 1e-2).unwrap();
            let cost = |m: &Matrix3<f64>| pairs.iter().map(|p| sampson_error_sq(m, &p.a, &p.b)).sum::<f64>();
            assert!(cost(&found) < 1e-3 * cost(&off.matrix()), "{} {}", cost(&found), cost(&off.matrix()));
            let seven = FundamentalParameters::new(&truth).unwrap();
            assert!(matrix_distance(&seven.matrix(), &truth) < 1e-9);
        }
    }
}
