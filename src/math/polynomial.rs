//! Real roots of polynomials of small degree.
//!
//! Coefficients stand in ascending order: `p(x) = c[0] + c[1] x + ... + c[n] x^n`.
//!
//! By Rolle's theorem the real roots of `p'` split the line into pieces on which `p` is monotone, so each piece holds at
//! most one root and a change of sign brackets it. [`real_roots`] climbs from the linear derivative up to `p` and
//! sharpens every bracketed root by Newton steps that fall back to bisection. To stay well scaled it looks only at
//! [-1, 1], once for `p` and once for the reversed polynomial, whose roots are the reciprocals. Roots of even
//! multiplicity, where `p` does not change sign, are not reported.

/// At most `N` real numbers.
#[derive(Clone, Copy, Debug)]
pub struct Roots<const N: usize> {
    values: [f64; N],
    len: usize,
}

impl<const N: usize> Roots<N> {
    fn new() -> Self {
        Self { values: [0.0; N], len: 0 }
    }

    fn push(&mut self, value: f64) {
        if self.len < N {
            self.values[self.len] = value;
            self.len += 1;
        }
    }

    /// The roots.
    pub fn as_slice(&self) -> &[f64] {
        &self.values[..self.len]
    }
}

/// `p(x)`, by Horner's scheme.
#[inline]
pub fn evaluate(coefficients: &[f64], x: f64) -> f64 {
    coefficients.iter().rev().fold(0.0, |sum, &c| sum * x + c)
}

/// `p(x)` and `p'(x)`.
#[inline]
fn evaluate_with_slope(coefficients: &[f64], x: f64) -> (f64, f64) {
    let (mut value, mut slope) = (0.0, 0.0);
    for &c in coefficients.iter().rev() {
        slope = slope * x + value;
        value = value * x + c;
    }
    (value, slope)
}

/// The product of two polynomials; `K` must be `N + M - 1`.
#[inline]
pub fn product<const N: usize, const M: usize, const K: usize>(a: &[f64; N], b: &[f64; M]) -> [f64; K] {
    debug_assert_eq!(K, N + M - 1);
    let mut out = [0.0; K];
    for (i, &x) in a.iter().enumerate() {
        for (j, &y) in b.iter().enumerate() {
            out[i + j] += x * y;
        }
    }
    out
}

/// The determinant of a 3x3 matrix of polynomials whose last column is one degree higher (`M = N + 1`) and whose last
/// row may be so too: what hidden-variable solvers end in. `K` must hold the degree of the product.
pub fn determinant<const N: usize, const M: usize, const K: usize>(
    rows: [(&[f64; N], &[f64; N], &[f64; M]); 3],
) -> [f64; K] {
    let mut out = [0.0; K];
    for (i, j, k) in [(0, 1, 2), (1, 2, 0), (2, 0, 1)] {
        let mut minor = [0.0; 16];
        for p in 0..N {
            for q in 0..N {
                minor[p + q] += rows[j].0[p] * rows[k].1[q] - rows[j].1[p] * rows[k].0[q];
            }
        }
        for (p, &last) in rows[i].2.iter().enumerate() {
            for (q, &m) in minor[..2 * N - 1].iter().enumerate() {
                if p + q < K {
                    out[p + q] += last * m;
                }
            }
        }
    }
    out
}

/// Newton and bisection steps on a bracket; enough to bisect [-1, 1] down to the last bit.
const MAX_STEPS: usize = 64;
/// A Newton step shorter than this is the last one on the polynomial itself: the next would be about its square, which is
/// below rounding.
const LAST_STEP: f64 = 1e-9;
/// The same on its derivatives, whose roots only have to separate those of the next.
const LAST_STEP_OF_DERIVATIVE: f64 = 1e-4;

/// The root in `[low, high]`, at whose ends `p` has opposite signs; `rising` says that it is negative at `low`.
#[inline]
fn bracketed_root(coefficients: &[f64], mut low: f64, mut high: f64, rising: bool, last_step: f64) -> f64 {
    let mut x = 0.5 * (low + high);
    for _ in 0..MAX_STEPS {
        let (value, slope) = evaluate_with_slope(coefficients, x);
        let newton = value / slope;
        if newton.abs() < last_step {
            return (x - newton).clamp(low, high);
        }
        if (value < 0.0) == rising {
            low = x;
        } else {
            high = x;
        }
        let next = x - newton;
        x = if next > low && next < high { next } else { 0.5 * (low + high) };
    }
    x
}

/// The most coefficients a polynomial may have.
const MAX_COEFFICIENTS: usize = 16;
/// Binomial coefficients: `BINOMIALS[n][k]` is n over k.
const BINOMIALS: [[f64; MAX_COEFFICIENTS]; MAX_COEFFICIENTS] = {
    let mut table = [[0.0; MAX_COEFFICIENTS]; MAX_COEFFICIENTS];
    let mut n = 0;
    while n < MAX_COEFFICIENTS {
        table[n][0] = 1.0;
        let mut k = 1;
        while k <= n {
            table[n][k] = table[n - 1][k - 1] + table[n - 1][k];
            k += 1;
        }
        n += 1;
    }
    table
};

/// The roots of odd multiplicity in [-1, 1], ascending.
fn roots_in_unit_interval<const N: usize>(coefficients: &[f64; N]) -> Roots<N> {
    let mut roots = Roots::<N>::new();
    for degree in 1..N {
        // The derivative of order N - 1 - degree, divided by the factorial of the order.
        let order = N - 1 - degree;
        let mut derivative = [0.0; N];
        for (k, slot) in derivative[..=degree].iter_mut().enumerate() {
            *slot = coefficients[k + order] * BINOMIALS[k + order][order];
        }
        let derivative = &derivative[..=degree];
        let mut next = Roots::<N>::new();
        let mut left = -1.0;
        let mut at_left = evaluate(derivative, left);
        for i in 0..=roots.len {
            let right = if i < roots.len { roots.values[i] } else { 1.0 };
            let at_right = evaluate(derivative, right);
            if (at_left < 0.0) != (at_right < 0.0) {
                let last_step = if order == 0 { LAST_STEP } else { LAST_STEP_OF_DERIVATIVE };
                next.push(bracketed_root(derivative, left, right, at_left < 0.0, last_step));
            }
            (left, at_left) = (right, at_right);
        }
        roots = next;
    }
    roots
}

/// The real roots of odd multiplicity of a polynomial of degree at most `N - 1`, in no particular order.
pub fn real_roots<const N: usize>(coefficients: &[f64; N]) -> Roots<N> {
    const { assert!(N <= MAX_COEFFICIENTS) };
    let largest = coefficients.iter().fold(0.0f64, |largest, c| largest.max(c.abs()));
    if largest == 0.0 || !largest.is_finite() {
        return Roots::new();
    }
    let scaled = coefficients.map(|c| c / largest);
    let mut roots = roots_in_unit_interval(&scaled);
    let mut reversed = scaled;
    reversed.reverse();
    for &reciprocal in roots_in_unit_interval(&reversed).as_slice() {
        // Beyond 1 / MIN_POSITIVE the root is at infinity: the degree is lower than N - 1.
        if reciprocal.abs() < 1.0 && (1.0 / reciprocal).is_finite() {
            roots.push(1.0 / reciprocal);
        }
    }
    roots
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    fn from_roots<const N: usize>(roots: &[f64]) -> [f64; N] {
        let mut c = [0.0; N];
        c[0] = 1.0;
        for (n, r) in roots.iter().enumerate() {
            for k in (0..=n + 1).rev() {
                c[k] = if k > 0 { c[k - 1] } else { 0.0 } - r * c[k];
            }
        }
        c
    }

    #[test]
    fn planted_roots_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        for _ in 0..500 {
            let mut planted: Vec<f64> = (0..6).map(|_| rng.range(-4.0, 4.0)).collect();
            planted.sort_by(f64::total_cmp);
            if planted.windows(2).any(|w| w[1] - w[0] < 0.05) {
                continue;
            }
            let mut found = real_roots(&from_roots::<7>(&planted)).as_slice().to_vec();
            found.sort_by(f64::total_cmp);
            assert_eq!(found.len(), 6);
            for (a, b) in planted.iter().zip(&found) {
                assert!((a - b).abs() < 1e-6, "{planted:?} {found:?}");
            }
        }
    }

    #[test]
    fn missing_leading_terms_and_complex_roots_are_no_trouble() {
        assert_eq!(real_roots(&[1.0, 0.0, 1.0]).as_slice().len(), 0);
        let linear = real_roots(&[-6.0, 2.0, 0.0, 0.0]);
        assert_eq!(linear.as_slice().len(), 1);
        assert!((linear.as_slice()[0] - 3.0).abs() < 1e-12);
        assert_eq!(real_roots(&[0.0; 4]).as_slice().len(), 0);
    }

    #[test]
    fn determinant_agrees_with_evaluation() {
        let mut rng = Rng::from_parts(&[2]);
        let mut draw = || rng.normal();
        let a: [[[f64; 4]; 2]; 3] = std::array::from_fn(|_| std::array::from_fn(|_| std::array::from_fn(|_| draw())));
        let b: [[f64; 5]; 3] = std::array::from_fn(|_| std::array::from_fn(|_| draw()));
        let det: [f64; 11] =
            determinant([(&a[0][0], &a[0][1], &b[0]), (&a[1][0], &a[1][1], &b[1]), (&a[2][0], &a[2][1], &b[2])]);
        let x = 0.7;
        let m = nalgebra::Matrix3::from_fn(|r, c| if c < 2 { evaluate(&a[r][c], x) } else { evaluate(&b[r], x) });
        assert!((m.determinant() - evaluate(&det, x)).abs() < 1e-10);
    }
}
