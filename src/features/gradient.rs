//! Gradients of a stretch of one row, as weighted magnitude and direction.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::ring::Ring;
use super::simd::{Isa, mul_add, stamp};

/// Keeps the quotient of two vanishing gradients finite; far below any gradient of 8-bit pixels.
const TINY: f32 = 1e-30;

/// Longest stretch of one row that is looked at; descriptors of the largest sigma reach 2 x 60 pixels.
pub(super) const MAX_STRETCH: usize = 512;

/// Gradients of a stretch of one row.
pub(super) struct Patch {
    /// Length of the gradient.
    pub(super) magnitude: Vec<f32>,
    /// Its direction in [0, 2 pi), from +x to +y.
    pub(super) direction: Vec<f32>,
}

impl Patch {
    /// Room for the longest stretch.
    pub(super) fn new() -> Self {
        Self { magnitude: vec![0.0; MAX_STRETCH], direction: vec![0.0; MAX_STRETCH] }
    }

    /// Gradients of pixels `from..to` of row `y` by central differences; none of them may lie on the border.
    pub(super) fn fill(&mut self, isa: Isa, ring: &Ring, y: usize, from: usize, to: usize) {
        gradients(
            isa,
            &ring.row(y - 1)[from..to],
            &ring.row(y + 1)[from..to],
            &ring.row(y)[from - 1..to + 1],
            &mut self.magnitude[..to - from],
            &mut self.direction[..to - from],
        );
    }
}

stamp!(
    /// See [`Patch::fill`].
    gradients => gradients_body(
        above: &[f32], below: &[f32], row: &[f32], magnitude: &mut [f32], direction: &mut [f32],
    )
);

#[inline(always)]
fn gradients_body<const FMA: bool>(
    above: &[f32],
    below: &[f32],
    row: &[f32],
    magnitude: &mut [f32],
    direction: &mut [f32],
) {
    let count = magnitude.len();
    let (above, below, direction) = (&above[..count], &below[..count], &mut direction[..count]);
    let (left, right) = (&row[..count], &row[2..count + 2]);
    for i in 0..count {
        let (gx, gy) = (right[i] - left[i], below[i] - above[i]);
        magnitude[i] = (gx * gx + gy * gy).sqrt();
        direction[i] = direction_of::<FMA>(gx, gy);
    }
}

/// The angle of (x, y) in [0, 2 pi), within 1e-5: an odd polynomial for the arc tangent of the smaller over the larger
/// component (Abramowitz and Stegun, "Handbook of mathematical functions", 4.4.49), unfolded to the octants.
#[inline(always)]
pub(super) fn direction_of<const FMA: bool>(x: f32, y: f32) -> f32 {
    let (ax, ay) = (x.abs(), y.abs());
    let (large, small) = if ax > ay { (ax, ay) } else { (ay, ax) };
    let t = small / (large + TINY);
    let q = t * t;
    let mut p = mul_add::<FMA>(q, 0.002_866_225_8, -0.016_165_737);
    p = mul_add::<FMA>(q, p, 0.042_909_614);
    p = mul_add::<FMA>(q, p, -0.075_289_64);
    p = mul_add::<FMA>(q, p, 0.106_562_64);
    p = mul_add::<FMA>(q, p, -0.142_089);
    p = mul_add::<FMA>(q, p, 0.199_935_51);
    p = mul_add::<FMA>(q, p, -0.333_331_45);
    let mut angle = mul_add::<FMA>(t * q, p, t);
    angle = if ay > ax { FRAC_PI_2 - angle } else { angle };
    angle = if x < 0.0 { PI - angle } else { angle };
    angle = if y < 0.0 { TAU - angle } else { angle };
    if angle >= TAU { 0.0 } else { angle }
}
