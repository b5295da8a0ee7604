//! The fundamental matrix of eight or more pairs, in the least-squares sense.
//!
//! Normalised eight-point algorithm: the unit vector with the least algebraic error is the last eigenvector of the 9x9
//! moment matrix of the epipolar equations, and the nearest matrix of rank two replaces it (Hartley, "In Defense of the
//! Eight-Point Algorithm", PAMI 1997).

use nalgebra::{Matrix3, SMatrix, SVector, Vector2};

use super::normalization::Normalization;
use super::null_space::epipolar_equation;

/// The fundamental matrix (rank two, unit Frobenius norm) of at least eight pairs `(x_a, x_b)`, `x_b^T F x_a = 0`.
pub fn eight_point(pairs: &[(Vector2<f64>, Vector2<f64>)]) -> Option<Matrix3<f64>> {
    if pairs.len() < 8 {
        return None;
    }
    let in_a = Normalization::of(pairs.iter().map(|pair| pair.0))?;
    let in_b = Normalization::of(pairs.iter().map(|pair| pair.1))?;
    let mut moments = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in pairs {
        let row = SVector::<f64, 9>::from(epipolar_equation(&in_a.apply(a), &in_b.apply(b)));
        moments.ger(1.0, &row, &row, 1.0);
    }
    if !moments.iter().all(|v| v.is_finite()) {
        return None;
    }
    let eigen = moments.symmetric_eigen();
    let normalized = Matrix3::from_row_slice(eigen.eigenvectors.column(eigen.eigenvalues.imin()).as_slice());
    let fundamental = in_b.matrix().transpose() * rank_two(&normalized)? * in_a.matrix();
    let norm = fundamental.norm();
    (norm > 0.0 && norm.is_finite()).then(|| fundamental / norm)
}

/// The nearest matrix of rank two.
fn rank_two(matrix: &Matrix3<f64>) -> Option<Matrix3<f64>> {
    let svd = matrix.svd(true, true);
    let mut values = svd.singular_values;
    values[2] = 0.0;
    Some(svd.u? * Matrix3::from_diagonal(&values) * svd.v_t?)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::{essential_from_pose, sampson_error_sq};
    use crate::math::Rng;
    use crate::solvers::test_scenes::{matrix_distance, random_pairs, random_relative_pose};

    #[test]
    fn planted_matrices_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        let mut failures = 0;
        for _ in 0..1000 {
            let b_from_a = random_relative_pose(&mut rng);
            let (a, b) = random_pairs::<12>(&mut rng, &b_from_a);
            let pairs: Vec<_> = a.into_iter().zip(b).collect();
            let truth = essential_from_pose(&b_from_a).unwrap();
            let found = eight_point(&pairs).unwrap();
            failures += usize::from(matrix_distance(&found, &truth) > 1e-5);
        }
        assert!(failures < 10, "{failures} of 1000 failed");
    }

    #[test]
    fn noise_moves_it_little() {
        let mut rng = Rng::from_parts(&[2]);
        let b_from_a = random_relative_pose(&mut rng);
        let noise = 1e-3;
        let (a, b) = random_pairs::<100>(&mut rng, &b_from_a);
        let mut shake = |x: Vector2<f64>| (x + Vector2::new(rng.normal(), rng.normal()) * noise) * 1000.0;
        let pairs: Vec<_> = a.into_iter().zip(b).map(|(a, b)| (shake(a), shake(b))).collect();
        let found = eight_point(&pairs).unwrap();
        assert!((found.determinant()).abs() < 1e-12);
        let mean = pairs.iter().map(|(a, b)| sampson_error_sq(&found, a, b)).sum::<f64>() / 100.0;
        assert!(mean.sqrt() < 1.5, "{}", mean.sqrt());
        assert!(eight_point(&pairs[..7]).is_none());
    }
}
