//! Essential matrices from five pairs of a calibrated camera pair. Up to ten solutions.
//!
//! The five epipolar equations leave `E = x X + y Y + z Z + W`. Every essential matrix satisfies the ten cubics
//!
//!   det E = 0,   2 E E^T E - tr(E E^T) E = 0,
//!
//! which are eliminated to a 3x3 matrix of polynomials in `z` acting on `(x, y, 1)`; its determinant has degree ten.
//! Nister, "An Efficient Solution to the Five-Point Relative Pose Problem", PAMI 2004 (sections 3.1-3.2). Departures: the
//! null space is orthonormal, the elimination pivots, and the roots come from [`crate::math::polynomial`].

use nalgebra::{Matrix3, Vector2};

use super::Solutions;
use super::null_space::{epipolar_equation, null_space};
use crate::math::polynomial::{determinant, evaluate, real_roots};

/// The most essential matrices five pairs allow.
pub const MAX_SOLUTIONS: usize = 10;

/// A linear form in `(x, y, z, 1)`.
type Linear = [f64; 4];
/// A quadratic form; monomials as in `QUADRATIC`.
type Quadratic = [f64; 10];
/// A cubic form; monomials as in `CUBIC`.
type Cubic = [f64; 20];

/// Exponents of x, y, z of the quadratic monomials.
const QUADRATIC: [[usize; 3]; 10] =
    [[2, 0, 0], [1, 1, 0], [1, 0, 1], [1, 0, 0], [0, 2, 0], [0, 1, 1], [0, 1, 0], [0, 0, 2], [0, 0, 1], [0, 0, 0]];
/// Exponents of the cubic monomials, in Nister's order: the ten that are eliminated come first.
const CUBIC: [[usize; 3]; 20] = [
    [3, 0, 0],
    [0, 3, 0],
    [2, 1, 0],
    [1, 2, 0],
    [2, 0, 1],
    [2, 0, 0],
    [0, 2, 1],
    [0, 2, 0],
    [1, 1, 1],
    [1, 1, 0],
    [1, 0, 2],
    [1, 0, 1],
    [1, 0, 0],
    [0, 1, 2],
    [0, 1, 1],
    [0, 1, 0],
    [0, 0, 3],
    [0, 0, 2],
    [0, 0, 1],
    [0, 0, 0],
];
/// Exponents of the linear monomials.
const LINEAR: [[usize; 3]; 4] = [[1, 0, 0], [0, 1, 0], [0, 0, 1], [0, 0, 0]];

const fn position<const N: usize>(monomials: &[[usize; 3]; N], wanted: [usize; 3]) -> usize {
    let mut at = 0;
    while at < N {
        let m = monomials[at];
        if m[0] == wanted[0] && m[1] == wanted[1] && m[2] == wanted[2] {
            return at;
        }
        at += 1;
    }
    panic!("no such monomial")
}

/// Where the product of two monomials stands.
const fn product_table<const N: usize, const K: usize>(
    left: &[[usize; 3]; N],
    out: &[[usize; 3]; K],
) -> [[usize; 4]; N] {
    let mut table = [[0; 4]; N];
    let mut i = 0;
    while i < N {
        let mut j = 0;
        while j < 4 {
            let (l, r) = (left[i], LINEAR[j]);
            table[i][j] = position(out, [l[0] + r[0], l[1] + r[1], l[2] + r[2]]);
            j += 1;
        }
        i += 1;
    }
    table
}

const LINEAR_BY_LINEAR: [[usize; 4]; 4] = product_table(&LINEAR, &QUADRATIC);
const QUADRATIC_BY_LINEAR: [[usize; 4]; 10] = product_table(&QUADRATIC, &CUBIC);

#[inline]
fn add_product(out: &mut Quadratic, a: &Linear, b: &Linear) {
    for i in 0..4 {
        for j in 0..4 {
            out[LINEAR_BY_LINEAR[i][j]] += a[i] * b[j];
        }
    }
}

#[inline]
fn add_cubic_product(out: &mut Cubic, a: &Quadratic, b: &Linear) {
    for i in 0..10 {
        for j in 0..4 {
            out[QUADRATIC_BY_LINEAR[i][j]] += a[i] * b[j];
        }
    }
}

/// The essential matrices (unit Frobenius norm) of five pairs on the planes z = 1, `x_b^T E x_a = 0`.
pub fn five_point(a: &[Vector2<f64>; 5], b: &[Vector2<f64>; 5]) -> Solutions<Matrix3<f64>, MAX_SOLUTIONS> {
    let mut solutions = Solutions::default();
    let mut equations = std::array::from_fn(|i| epipolar_equation(&a[i], &b[i]));
    let Some(basis) = null_space::<5, 4>(&mut equations) else { return solutions };
    // Entry (r, c) of E as a linear form.
    let e: [[Linear; 3]; 3] =
        std::array::from_fn(|r| std::array::from_fn(|c| std::array::from_fn(|k| basis[k][3 * r + c])));
    let mut rows = constraints(&e);
    if !eliminate(&mut rows) {
        return solutions;
    }
    // Rows (x^2 z, x^2), (y^2 z, y^2), (xyz, xy): the first less z times the second has only x, y and 1 left.
    let subtract = |upper: &Cubic, lower: &Cubic| {
        let (u, l) = (&upper[10..], &lower[10..]);
        (
            [u[2], u[1] - l[2], u[0] - l[1], -l[0]],
            [u[5], u[4] - l[5], u[3] - l[4], -l[3]],
            [u[9], u[8] - l[9], u[7] - l[8], u[6] - l[7], -l[6]],
        )
    };
    let b_rows = [subtract(&rows[4], &rows[5]), subtract(&rows[6], &rows[7]), subtract(&rows[8], &rows[9])];
    let polynomial: [f64; 11] = determinant(std::array::from_fn(|i| (&b_rows[i].0, &b_rows[i].1, &b_rows[i].2)));
    for &z in real_roots(&polynomial).as_slice() {
        // (x, y, 1) is orthogonal to the rows of B(z): take the best conditioned of their cross products.
        let at = Matrix3::from_fn(|r, c| match c {
            0 => evaluate(&b_rows[r].0, z),
            1 => evaluate(&b_rows[r].1, z),
            _ => evaluate(&b_rows[r].2, z),
        });
        let (r0, r1, r2) = (at.row(0).transpose(), at.row(1).transpose(), at.row(2).transpose());
        let crosses = [r0.cross(&r1), r1.cross(&r2), r2.cross(&r0)];
        let best = crosses.iter().fold(crosses[0], |best, c| if c.z.abs() > best.z.abs() { *c } else { best });
        let (x, y) = (best.x / best.z, best.y / best.z);
        let essential = Matrix3::from_fn(|r, c| {
            let k = 3 * r + c;
            x * basis[0][k] + y * basis[1][k] + z * basis[2][k] + basis[3][k]
        });
        let norm = essential.norm();
        if norm.is_finite() && norm > 0.0 {
            solutions.push(essential / norm);
        }
    }
    solutions
}

/// The ten cubics: nine of the trace constraint, then the determinant.
fn constraints(e: &[[Linear; 3]; 3]) -> [Cubic; 10] {
    // S = E E^T - tr(E E^T) / 2 I, and the trace constraint is S E = 0.
    let mut s = [[[0.0; 10]; 3]; 3];
    for i in 0..3 {
        for j in i..3 {
            for (left, right) in e[i].iter().zip(&e[j]) {
                add_product(&mut s[i][j], left, right);
            }
        }
    }
    for m in 0..10 {
        let half_trace = 0.5 * (s[0][0][m] + s[1][1][m] + s[2][2][m]);
        for (i, row) in s.iter_mut().enumerate() {
            row[i][m] -= half_trace;
        }
    }
    let mut rows = [[0.0; 20]; 10];
    for i in 0..3 {
        for j in 0..3 {
            for (k, row) in e.iter().enumerate() {
                let quadratic = if i <= k { &s[i][k] } else { &s[k][i] };
                add_cubic_product(&mut rows[3 * i + j], quadratic, &row[j]);
            }
        }
    }
    for j in 0..3 {
        // Cofactor expansion along the last row.
        let (p, q) = ((j + 1) % 3, (j + 2) % 3);
        let mut minor = [0.0; 10];
        add_product(&mut minor, &e[0][p], &e[1][q]);
        let negated = e[0][q].map(|v| -v);
        add_product(&mut minor, &negated, &e[1][p]);
        add_cubic_product(&mut rows[9], &minor, &e[2][j]);
    }
    rows
}

/// A pivot below this share of the largest entry leaves the ten cubics dependent: a degenerate sample.
const MIN_PIVOT_SHARE: f64 = 1e-12;

/// Gauss-Jordan elimination of the first ten columns with row pivoting; rows 0-3 are left triangular, as nothing reads
/// them. False for a degenerate system.
fn eliminate(rows: &mut [Cubic; 10]) -> bool {
    let largest = rows.iter().flatten().fold(0.0f64, |largest, v| largest.max(v.abs()));
    for column in 0..10 {
        let pivot = (column..10).fold(
            column,
            |best, r| {
                if rows[r][column].abs() > rows[best][column].abs() { r } else { best }
            },
        );
        let value = rows[pivot][column];
        if value.is_nan() || value.abs() <= MIN_PIVOT_SHARE * largest {
            return false;
        }
        rows.swap(column, pivot);
        let (above, rest) = rows.split_at_mut(column);
        let Some((pivot_row, below)) = rest.split_first_mut() else { return false };
        let inverse = 1.0 / value;
        pivot_row[column..].iter_mut().for_each(|v| *v *= inverse);
        for row in below.iter_mut().chain(above.iter_mut().skip(4)) {
            let factor = row[column];
            for (v, p) in row[column..].iter_mut().zip(&pivot_row[column..]) {
                *v -= factor * p;
            }
        }
    }
    true
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::essential_from_pose;
    use crate::math::Rng;
    use crate::solvers::test_scenes::{matrix_distance, random_pairs, random_relative_pose};

    #[test]
    fn planted_essential_matrices_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        let (mut failures, mut candidates) = (0, 0);
        for _ in 0..1000 {
            let b_from_a = random_relative_pose(&mut rng);
            let (a, b) = random_pairs::<5>(&mut rng, &b_from_a);
            let truth = essential_from_pose(&b_from_a).unwrap();
            let found = five_point(&a, &b);
            candidates += found.len();
            failures += usize::from(!found.iter().any(|e| matrix_distance(e, &truth) < 1e-5));
        }
        assert!(failures < 10, "{failures} of 1000 failed");
        assert!(candidates < 6000, "{candidates} candidates for 1000 problems");
    }

    #[test]
    fn repeated_pairs_give_nothing() {
        let mut rng = Rng::from_parts(&[2]);
        let b_from_a = random_relative_pose(&mut rng);
        let (mut a, mut b) = random_pairs::<5>(&mut rng, &b_from_a);
        (a[4], b[4]) = (a[0], b[0]);
        assert!(five_point(&a, &b).is_empty());
    }
}
