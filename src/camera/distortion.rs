//! The Brown-Conrady distortion with two radial and two tangential coefficients `(k1, k2, p1, p2)`, as OpenCV orders them.
//!
//! With `r2 = x^2 + y^2` and `g = 1 + k1 r2 + k2 r2^2`:
//!
//!   x' = x g + 2 p1 x y + p2 (r2 + 2 x^2)
//!   y' = y g + p1 (r2 + 2 y^2) + 2 p2 x y

use nalgebra::{Matrix2, Matrix2x4, Vector2};

/// A distorted position with its derivatives.
pub(super) struct Distorted {
    pub position: Vector2<f64>,
    pub by_position: Matrix2<f64>,
    pub by_coefficients: Matrix2x4<f64>,
}

/// The distorted position of an undistorted one.
#[inline]
pub(super) fn distort(&[k1, k2, p1, p2]: &[f64; 4], at: &Vector2<f64>) -> Vector2<f64> {
    let (x, y) = (at.x, at.y);
    let r2 = x * x + y * y;
    let g = 1.0 + r2 * (k1 + k2 * r2);
    Vector2::new(x * g + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x), y * g + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y)
}

/// The derivative of [`distort`] by the position; `dg/dx = 2 x (k1 + 2 k2 r2)` and likewise for y.
#[inline]
fn distort_by_position(&[k1, k2, p1, p2]: &[f64; 4], at: &Vector2<f64>) -> Matrix2<f64> {
    let (x, y) = (at.x, at.y);
    let r2 = x * x + y * y;
    let g = 1.0 + r2 * (k1 + k2 * r2);
    let slope = 2.0 * (k1 + 2.0 * k2 * r2);
    let cross = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y;
    Matrix2::new(
        g + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x,
        cross,
        cross,
        g + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x,
    )
}

/// [`distort`] with derivatives.
pub(super) fn distort_with_jacobian(coefficients: &[f64; 4], at: &Vector2<f64>) -> Distorted {
    let (x, y) = (at.x, at.y);
    let r2 = x * x + y * y;
    Distorted {
        position: distort(coefficients, at),
        by_position: distort_by_position(coefficients, at),
        by_coefficients: Matrix2x4::new(
            x * r2,
            x * r2 * r2,
            2.0 * x * y,
            r2 + 2.0 * x * x,
            y * r2,
            y * r2 * r2,
            r2 + 2.0 * y * y,
            2.0 * x * y,
        ),
    }
}

/// Newton steps of [`undistort`]; five suffice for the distortion of real lenses.
const MAX_STEPS: usize = 20;
/// A squared step on the plane z = 1 after which none is needed: as the error falls to about its square with each step, one of
/// 1e-7 of a focal length leaves far less than any pixel is known to.
const LAST_STEP_SQ: f64 = 1e-14;

/// The undistorted position whose distortion is `distorted`, by Newton's method from `distorted` itself.
pub(super) fn undistort(coefficients: &[f64; 4], distorted: &Vector2<f64>) -> Vector2<f64> {
    if coefficients.iter().all(|&c| c == 0.0) {
        return *distorted;
    }
    let mut at = *distorted;
    for _ in 0..MAX_STEPS {
        let Some(inverse) = distort_by_position(coefficients, &at).try_inverse() else { break };
        let step = inverse * (distort(coefficients, &at) - distorted);
        if !step.iter().all(|s| s.is_finite()) {
            break;
        }
        at -= step;
        if step.norm_squared() < LAST_STEP_SQ {
            break;
        }
    }
    at
}
