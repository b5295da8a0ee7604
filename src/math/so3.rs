//! Small pieces of the rotation group.

use nalgebra::{Matrix3, Vector3};

/// The matrix `[v]_x` with `[v]_x w = v x w`.
#[inline]
pub fn skew(v: &Vector3<f64>) -> Matrix3<f64> {
    Matrix3::new(0.0, -v.z, v.y, v.z, 0.0, -v.x, -v.y, v.x, 0.0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn skew_is_the_cross_product() {
        let (v, w) = (Vector3::new(0.3, -2.0, 1.5), Vector3::new(1.0, 0.2, -0.7));
        assert!((skew(&v) * w - v.cross(&w)).norm() < 1e-15);
    }
}
