//! Hartley's normalisation of image positions ("In Defense of the Eight-Point Algorithm", PAMI 1997): the mean goes to the
//! origin and the root mean square distance from it to sqrt 2, which keeps the linear solvers well conditioned.

use nalgebra::{Matrix3, Vector2};

/// `x -> scale (x - mean)`.
pub(super) struct Normalization {
    mean: Vector2<f64>,
    scale: f64,
}

impl Normalization {
    /// None when there is no position or all are one.
    pub fn of(positions: impl Iterator<Item = Vector2<f64>> + Clone) -> Option<Self> {
        let (mut sum, mut n) = (Vector2::zeros(), 0.0);
        for x in positions.clone() {
            sum += x;
            n += 1.0;
        }
        let mean = sum / n;
        let spread_sq = positions.map(|x| (x - mean).norm_squared()).sum::<f64>() / n;
        let scale = (2.0 / spread_sq).sqrt();
        (scale.is_finite() && scale > 0.0).then_some(Self { mean, scale })
    }

    #[inline]
    pub fn apply(&self, x: &Vector2<f64>) -> Vector2<f64> {
        (x - self.mean) * self.scale
    }

    /// As a matrix on homogeneous positions.
    pub fn matrix(&self) -> Matrix3<f64> {
        let (s, m) = (self.scale, self.mean);
        Matrix3::new(s, 0.0, -s * m.x, 0.0, s, -s * m.y, 0.0, 0.0, 1.0)
    }

    /// Its inverse as a matrix.
    pub fn inverse_matrix(&self) -> Matrix3<f64> {
        let (s, m) = (1.0 / self.scale, self.mean);
        Matrix3::new(s, 0.0, m.x, 0.0, s, m.y, 0.0, 0.0, 1.0)
    }
}
