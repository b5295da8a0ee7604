//! Null spaces of a few linear equations in nine unknowns, the entries of a 3x3 matrix.
//!
//! Householder reflections `H_1 ... H_n` bring the transposed equations to triangular form, `A^T = H_1 ... H_n R`; the
//! images of the last unit vectors under them are orthonormal and orthogonal to every equation (Golub and Van Loan,
//! "Matrix Computations", 4th ed., section 5.2).

use nalgebra::{Matrix3, Vector2};

/// Unknowns: the entries of a 3x3 matrix, row by row.
pub(super) const UNKNOWNS: usize = 9;
/// An equation that keeps less than this share of its length after the others are taken out depends on them.
const MIN_INDEPENDENT_SHARE: f64 = 1e-10;

/// An orthonormal basis of the null space of `N` equations, which are overwritten; `M` must be `9 - N`. None when the
/// equations depend on each other.
pub(super) fn null_space<const N: usize, const M: usize>(
    equations: &mut [[f64; UNKNOWNS]; N],
) -> Option<[[f64; UNKNOWNS]; M]> {
    debug_assert_eq!(N + M, UNKNOWNS);
    let mut lengths = [0.0; N];
    for (length, row) in lengths.iter_mut().zip(equations.iter()) {
        *length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
    }
    for k in 0..N {
        // The reflection of the part from k on to the k-th axis: v = x + sign(x_k) |x| e_k, kept in the row itself.
        let norm = equations[k][k..].iter().map(|v| v * v).sum::<f64>().sqrt();
        if norm.is_nan() || norm <= MIN_INDEPENDENT_SHARE * lengths[k] {
            return None;
        }
        let (done, rest) = equations.split_at_mut(k + 1);
        let v = &mut done[k];
        v[k] += norm.copysign(v[k]);
        let scale = (2.0 / v[k..].iter().map(|x| x * x).sum::<f64>()).sqrt();
        v[k..].iter_mut().for_each(|x| *x *= scale);
        for row in rest {
            reflect(v, k, row);
        }
    }
    let mut basis = [[0.0; UNKNOWNS]; M];
    for (m, vector) in basis.iter_mut().enumerate() {
        vector[N + m] = 1.0;
        for k in (0..N).rev() {
            reflect(&equations[k], k, vector);
        }
    }
    Some(basis)
}

/// `x - v (v . x)` on the entries from `from` on, for `|v|^2 = 2`.
#[inline]
fn reflect(v: &[f64; UNKNOWNS], from: usize, x: &mut [f64; UNKNOWNS]) {
    let dot: f64 = v[from..].iter().zip(&x[from..]).map(|(a, b)| a * b).sum();
    for (value, a) in x[from..].iter_mut().zip(&v[from..]) {
        *value -= dot * a;
    }
}

/// A 3x3 matrix of its entries row by row.
#[inline]
pub(super) fn matrix(entries: &[f64; UNKNOWNS]) -> Matrix3<f64> {
    Matrix3::from_row_slice(entries)
}

/// The epipolar equation `x_b^T M x_a = 0` of a pair, in the entries of `M` row by row.
#[inline]
pub(super) fn epipolar_equation(a: &Vector2<f64>, b: &Vector2<f64>) -> [f64; UNKNOWNS] {
    [b.x * a.x, b.x * a.y, b.x, b.y * a.x, b.y * a.y, b.y, a.x, a.y, 1.0]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn the_basis_is_orthonormal_and_solves_the_equations() {
        let mut rng = Rng::from_parts(&[1]);
        let equations: [[f64; 9]; 5] = std::array::from_fn(|_| std::array::from_fn(|_| rng.normal()));
        let basis: [[f64; 9]; 4] = null_space(&mut equations.clone()).unwrap();
        let dot = |a: &[f64; 9], b: &[f64; 9]| a.iter().zip(b).map(|(x, y)| x * y).sum::<f64>();
        for (i, v) in basis.iter().enumerate() {
            assert!(equations.iter().all(|row| dot(row, v).abs() < 1e-13));
            assert!(basis.iter().enumerate().all(|(j, w)| (dot(v, w) - f64::from(u8::from(i == j))).abs() < 1e-13));
        }
        let mut dependent = equations;
        dependent[4] = dependent[1];
        assert!(null_space::<5, 4>(&mut dependent).is_none());
    }
}
