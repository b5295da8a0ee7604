//! Fundamental matrices from seven pairs. One or three solutions.
//!
//! Seven epipolar equations leave `F = l F_1 + (1 - l) F_2`, and `det F = 0` is a cubic in `l` (Hartley and Zisserman,
//! "Multiple View Geometry", 2nd ed., section 11.1.2). Here `F = F_1 + l F_2`, whose roots at infinity cost nothing.

use nalgebra::{Matrix3, Vector2};

use super::Solutions;
use super::null_space::{epipolar_equation, matrix, null_space};
use crate::math::polynomial::real_roots;

/// The fundamental matrices (unit Frobenius norm) of seven pairs, `x_b^T F x_a = 0`. Coordinates should be of order 1.
pub fn seven_point(a: &[Vector2<f64>; 7], b: &[Vector2<f64>; 7]) -> Solutions<Matrix3<f64>, 3> {
    let mut solutions = Solutions::default();
    let mut equations = std::array::from_fn(|i| epipolar_equation(&a[i], &b[i]));
    let Some(basis) = null_space::<7, 2>(&mut equations) else { return solutions };
    let (first, second) = (matrix(&basis[0]), matrix(&basis[1]));
    // det(A + l B) = det A + l tr(adj(A) B) + l^2 tr(A adj(B)) + l^3 det B; cofactors are the adjugate transposed.
    let (cofactors_1, cofactors_2) = (cofactors(&first), cofactors(&second));
    let cubic = [
        first.component_mul(&cofactors_1).row(0).sum(),
        cofactors_1.component_mul(&second).sum(),
        cofactors_2.component_mul(&first).sum(),
        second.component_mul(&cofactors_2).row(0).sum(),
    ];
    for &l in real_roots(&cubic).as_slice() {
        let fundamental = first + second * l;
        let norm = fundamental.norm();
        if norm.is_finite() && norm > 0.0 {
            solutions.push(fundamental / norm);
        }
    }
    solutions
}

/// The matrix of cofactors.
fn cofactors(m: &Matrix3<f64>) -> Matrix3<f64> {
    let row = |i: usize| m.row(i).transpose();
    let (r0, r1, r2) = (row(0), row(1), row(2));
    Matrix3::from_rows(&[r1.cross(&r2).transpose(), r2.cross(&r0).transpose(), r0.cross(&r1).transpose()])
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::essential_from_pose;
    use crate::math::Rng;
    use crate::solvers::test_scenes::{matrix_distance, random_pairs, random_relative_pose};

    #[test]
    fn planted_matrices_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        let mut failures = 0;
        for _ in 0..1000 {
            let b_from_a = random_relative_pose(&mut rng);
            let (a, b) = random_pairs::<7>(&mut rng, &b_from_a);
            let truth = essential_from_pose(&b_from_a).unwrap();
            failures += usize::from(!seven_point(&a, &b).iter().any(|f| matrix_distance(f, &truth) < 1e-5));
        }
        assert!(failures < 10, "{failures} of 1000 failed");
    }

    #[test]
    fn repeated_pairs_give_nothing() {
        let mut rng = Rng::from_parts(&[2]);
        let b_from_a = random_relative_pose(&mut rng);
        let (mut a, mut b) = random_pairs::<7>(&mut rng, &b_from_a);
        (a[6], b[6]) = (a[0], b[0]);
        assert!(seven_point(&a, &b).is_empty());
    }
}
