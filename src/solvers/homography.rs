//! Homographies from four or more pairs.
//!
//! `x_b x H x_a = 0` gives two equations a pair, linear in `H`. Four pairs leave one null vector; more are solved in the
//! least-squares sense after Hartley's normalisation (Hartley and Zisserman, "Multiple View Geometry", 2nd ed.,
//! algorithms 4.1 and 4.2).

use nalgebra::{Matrix3, SMatrix, SVector, Vector2};

use super::normalization::Normalization;
use super::null_space::{UNKNOWNS, matrix, null_space};

/// Sines of the angles of a sample's triangles below which three positions lie on a line.
const MIN_TRIANGLE_SINE: f64 = 1e-6;

/// The two equations of a pair, in the entries of `H` row by row.
#[inline]
fn equations(a: &Vector2<f64>, b: &Vector2<f64>) -> [[f64; UNKNOWNS]; 2] {
    [
        [a.x, a.y, 1.0, 0.0, 0.0, 0.0, -b.x * a.x, -b.x * a.y, -b.x],
        [0.0, 0.0, 0.0, a.x, a.y, 1.0, -b.y * a.x, -b.y * a.y, -b.y],
    ]
}

/// Twice the signed area of a triangle and whether it is well away from a line.
fn turn(p: &Vector2<f64>, q: &Vector2<f64>, r: &Vector2<f64>) -> (f64, bool) {
    let (u, v) = (q - p, r - p);
    let area = u.x * v.y - u.y * v.x;
    (area, area.abs() > MIN_TRIANGLE_SINE * u.norm() * v.norm())
}

/// The homography (unit Frobenius norm) of four pairs, `x_b ~ H x_a`. None when three positions of an image lie on a line,
/// or when the pairs would turn a triangle over, which no plane seen from its front by both cameras does.
pub fn homography_four_point(a: &[Vector2<f64>; 4], b: &[Vector2<f64>; 4]) -> Option<Matrix3<f64>> {
    for (i, j, k) in [(0, 1, 2), (0, 1, 3), (0, 2, 3), (1, 2, 3)] {
        let (area_a, clear_a) = turn(&a[i], &a[j], &a[k]);
        let (area_b, clear_b) = turn(&b[i], &b[j], &b[k]);
        if !clear_a || !clear_b || area_a * area_b < 0.0 {
            return None;
        }
    }
    let mut rows = [[0.0; UNKNOWNS]; 8];
    for i in 0..4 {
        [rows[2 * i], rows[2 * i + 1]] = equations(&a[i], &b[i]);
    }
    let [entries] = null_space::<8, 1>(&mut rows)?;
    Some(matrix(&entries))
}

/// The homography (unit Frobenius norm) of at least four pairs `(x_a, x_b)`, `x_b ~ H x_a`, with the least algebraic error.
pub fn homography_dlt(pairs: impl Iterator<Item = (Vector2<f64>, Vector2<f64>)> + Clone) -> Option<Matrix3<f64>> {
    if pairs.clone().take(4).count() < 4 {
        return None;
    }
    let in_a = Normalization::of(pairs.clone().map(|pair| pair.0))?;
    let in_b = Normalization::of(pairs.clone().map(|pair| pair.1))?;
    let mut moments = SMatrix::<f64, 9, 9>::zeros();
    for (a, b) in pairs {
        for row in equations(&in_a.apply(&a), &in_b.apply(&b)) {
            let row = SVector::<f64, 9>::from(row);
            moments.ger(1.0, &row, &row, 1.0);
        }
    }
    if !moments.iter().all(|v| v.is_finite()) {
        return None;
    }
    let eigen = moments.symmetric_eigen();
    let normalized = Matrix3::from_row_slice(eigen.eigenvectors.column(eigen.eigenvalues.imin()).as_slice());
    let homography = in_b.inverse_matrix() * normalized * in_a.matrix();
    let norm = homography.norm();
    (norm > 0.0 && norm.is_finite()).then(|| homography / norm)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use crate::solvers::test_scenes::matrix_distance;

    fn random_homography(rng: &mut Rng) -> Matrix3<f64> {
        let h = Matrix3::identity() + Matrix3::from_fn(|r, _| if r < 2 { 0.3 } else { 0.1 } * rng.range(-1.0, 1.0));
        h / h.norm()
    }

    fn pair(rng: &mut Rng, h: &Matrix3<f64>) -> (Vector2<f64>, Vector2<f64>) {
        let a = Vector2::new(rng.range(-1.0, 1.0), rng.range(-1.0, 1.0));
        let b = h * a.push(1.0);
        (a, b.xy() / b.z)
    }

    #[test]
    fn planted_homographies_come_back() {
        let mut rng = Rng::from_parts(&[1]);
        let mut failures = 0;
        for _ in 0..1000 {
            let h = random_homography(&mut rng);
            let pairs: Vec<_> = (0..20).map(|_| pair(&mut rng, &h)).collect();
            assert!(matrix_distance(&homography_dlt(pairs.iter().copied()).unwrap(), &h) < 1e-8);
            let (a, b) = (std::array::from_fn(|i| pairs[i].0), std::array::from_fn(|i| pairs[i].1));
            let close = homography_four_point(&a, &b).is_some_and(|found| matrix_distance(&found, &h) < 1e-6);
            failures += usize::from(!close);
        }
        assert!(failures < 10, "{failures} of 1000 failed");
    }

    #[test]
    fn lines_and_flips_give_nothing() {
        let square = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)].map(|(x, y)| Vector2::new(x, y));
        let flipped = square.map(|p| Vector2::new(-p.x, p.y));
        assert!(homography_four_point(&square, &square).is_some());
        assert!(homography_four_point(&square, &flipped).is_none());
        let mut on_a_line = square;
        on_a_line[2] = Vector2::new(2.0, 0.0);
        assert!(homography_four_point(&on_a_line, &square).is_none());
    }
}
