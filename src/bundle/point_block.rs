//! The 3x3 block of a point in the normal equations, its damping and its Cholesky factor.

/// A pivot smaller than this share of the diagonal is rounding: the point is not determined, and stays.
const MIN_PIVOT_SHARE: f64 = 1e-13;
/// Bounds of the diagonal that damping scales, so that unknowns without sightings are damped and huge ones not frozen.
pub(super) const MIN_DAMPED_DIAGONAL: f64 = 1e-6;
/// See [`MIN_DAMPED_DIAGONAL`].
pub(super) const MAX_DAMPED_DIAGONAL: f64 = 1e32;

/// `V` (upper half by rows: 00, 01, 02, 11, 12, 22) and `gp` of a point.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct PointBlock {
    pub matrix: [f64; 6],
    pub gradient: [f64; 3],
}

/// `L^-1` of `V = L L'`, by rows: 00, 10, 11, 20, 21, 22.
#[derive(Clone, Copy, Debug)]
pub(super) struct InverseFactor([f64; 6]);

impl PointBlock {
    /// Adds `R'A R` and `R'q`; `A` is stored as `matrix` is.
    #[inline(always)]
    pub fn add(&mut self, rotation: &[[f64; 3]; 3], a: &[f64; 6], q: &[f64; 3]) {
        let [r0, r1, r2] = rotation;
        let product =
            |row: [f64; 3]| -> [f64; 3] { std::array::from_fn(|k| row[0] * r0[k] + row[1] * r1[k] + row[2] * r2[k]) };
        let ar = [product([a[0], a[1], a[2]]), product([a[1], a[3], a[4]]), product([a[2], a[4], a[5]])];
        let entry = |i: usize, j: usize| r0[i] * ar[0][j] + r1[i] * ar[1][j] + r2[i] * ar[2][j];
        self.matrix[0] += entry(0, 0);
        self.matrix[1] += entry(0, 1);
        self.matrix[2] += entry(0, 2);
        self.matrix[3] += entry(1, 1);
        self.matrix[4] += entry(1, 2);
        self.matrix[5] += entry(2, 2);
        self.add_gradient(rotation, q);
    }

    /// Adds `R'q`.
    #[inline(always)]
    pub fn add_gradient(&mut self, rotation: &[[f64; 3]; 3], q: &[f64; 3]) {
        let [r0, r1, r2] = rotation;
        for (k, g) in self.gradient.iter_mut().enumerate() {
            *g += r0[k] * q[0] + r1[k] * q[1] + r2[k] * q[2];
        }
    }

    /// What damping adds to the diagonal.
    #[inline(always)]
    pub fn damping_diagonal(&self, damping: f64) -> [f64; 3] {
        [0, 3, 5].map(|at| damping * self.matrix[at].clamp(MIN_DAMPED_DIAGONAL, MAX_DAMPED_DIAGONAL))
    }

    /// The block with its diagonal damped.
    #[inline(always)]
    pub fn damped(&self, damping: f64) -> Self {
        let mut block = *self;
        for (at, added) in [0, 3, 5].into_iter().zip(self.damping_diagonal(damping)) {
            block.matrix[at] += added;
        }
        block
    }

    /// The inverse Cholesky factor; none when the block is singular to working precision.
    #[inline(always)]
    pub fn inverse_factor(&self) -> Option<InverseFactor> {
        let [v00, v01, v02, v11, v12, v22] = self.matrix;
        let is_positive = |pivot: f64, diagonal: f64| pivot > MIN_PIVOT_SHARE * diagonal && pivot.is_finite();
        if !is_positive(v00, v00) {
            return None;
        }
        let i00 = 1.0 / v00.sqrt();
        let (l10, l20) = (v01 * i00, v02 * i00);
        let pivot = v11 - l10 * l10;
        if !is_positive(pivot, v11) {
            return None;
        }
        let i11 = 1.0 / pivot.sqrt();
        let l21 = (v12 - l20 * l10) * i11;
        let pivot = v22 - l20 * l20 - l21 * l21;
        if !is_positive(pivot, v22) {
            return None;
        }
        let i22 = 1.0 / pivot.sqrt();
        let i10 = -l10 * i00 * i11;
        let i21 = -l21 * i11 * i22;
        let i20 = -(l20 * i00 + l21 * i10) * i22;
        Some(InverseFactor([i00, i10, i11, i20, i21, i22]))
    }
}

impl InverseFactor {
    /// `L^-1 v`.
    #[inline(always)]
    pub fn apply(&self, v: &[f64; 3]) -> [f64; 3] {
        let [i00, i10, i11, i20, i21, i22] = self.0;
        [i00 * v[0], i10 * v[0] + i11 * v[1], i20 * v[0] + i21 * v[1] + i22 * v[2]]
    }

    /// `V^-1 v`.
    #[inline(always)]
    pub fn solve(&self, v: &[f64; 3]) -> [f64; 3] {
        let [i00, i10, i11, i20, i21, i22] = self.0;
        let z = self.apply(v);
        [i00 * z[0] + i10 * z[1] + i20 * z[2], i11 * z[1] + i21 * z[2], i22 * z[2]]
    }

    /// `L^-1 R'`, by rows.
    #[inline(always)]
    pub fn times_transposed(&self, rotation: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
        let columns: [[f64; 3]; 3] = std::array::from_fn(|column| self.apply(&rotation[column]));
        std::array::from_fn(|row| std::array::from_fn(|column| columns[column][row]))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::{Matrix3, Vector3};

    #[test]
    fn factors_and_solves() {
        let matrix = Matrix3::new(4.0, 1.0, -0.5, 1.0, 3.0, 0.7, -0.5, 0.7, 2.0);
        let block = PointBlock { matrix: [4.0, 1.0, -0.5, 3.0, 0.7, 2.0], gradient: [0.0; 3] };
        let v = [1.0, -2.0, 0.5];
        let solved = Vector3::from(block.inverse_factor().unwrap().solve(&v));
        assert!((matrix * solved - Vector3::from(v)).norm() < 1e-12);
    }

    #[test]
    fn a_singular_block_has_no_factor() {
        let block = PointBlock { matrix: [1.0, 1.0, 0.0, 1.0, 0.0, 1.0], gradient: [0.0; 3] };
        assert!(block.inverse_factor().is_none());
        assert!(PointBlock::default().inverse_factor().is_none());
        assert!(PointBlock { matrix: [f64::NAN; 6], gradient: [0.0; 3] }.inverse_factor().is_none());
    }
}
