//! Gradients of a stretch of one row, as weighted magnitude and direction.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::ring::Ring;
use super::simd::mul_add;

/// Keeps the quotient of two vanishing gradients finite; far below any gradient of 8-bit pixels.
const TINY: f32 = 1e-30;

/// Pixels computed together; stretches are computed in whole multiples. Eight compute fewer pixels beyond the ends, but
/// whole extractions took a tenth longer with AVX2.
pub(super) const LANES: usize = 16;
/// Room for the longest stretch of one row that is looked at: across the orientation window of the largest sigma.
const MAX_STRETCH: usize = 1024;

/// Gradients of a stretch of one row, and the buffers for their weights.
pub(super) struct Patch {
    /// Weight of each column of the window, set by [`Patch::set_window`].
    window: Vec<f32>,
    window_from: usize,
    /// Length of the gradient times its weight.
    pub(super) weight: Vec<f32>,
    /// Direction in [0, 2 pi), from +x to +y.
    pub(super) direction: Vec<f32>,
}

impl Patch {
    /// Room for the longest stretch.
    pub(super) fn new() -> Self {
        let zeros = || vec![0.0; MAX_STRETCH];
        Self { window: zeros(), window_from: 0, weight: zeros(), direction: zeros() }
    }

    /// Sets the columns' part of the Gaussian window exp(falloff (dx^2 + dy^2)) around `x`, for the columns `from..to`.
    #[inline(always)]
    pub(super) fn set_window(&mut self, x: f32, falloff: f32, from: usize, to: usize) {
        self.window_from = from;
        for (column, weight) in (from..to).zip(&mut self.window) {
            *weight = (falloff * (column as f32 - x).powi(2)).exp();
        }
    }

    /// Gradients by central differences of the pixels `from..to` of row `y`, weighted by the window's columns and
    /// `row_weight`; returns how many. No pixel may lie on the border or outside the window.
    #[inline(always)]
    pub(super) fn fill<const FMA: bool>(
        &mut self,
        ring: &Ring,
        y: usize,
        from: usize,
        to: usize,
        row_weight: f32,
    ) -> usize {
        let count = to - from;
        let padded = count.next_multiple_of(LANES);
        let first = from - self.window_from;
        gradients::<FMA>(
            ring.stretch(y - 1, from, padded),
            ring.stretch(y + 1, from, padded),
            ring.stretch(y, from - 1, padded + 2),
            &self.window[first..first + padded],
            row_weight,
            &mut self.weight[..padded],
            &mut self.direction[..padded],
        );
        count
    }
}

/// See [`Patch::fill`].
#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn gradients<const FMA: bool>(
    above: &[f32],
    below: &[f32],
    row: &[f32],
    window: &[f32],
    row_weight: f32,
    weight: &mut [f32],
    direction: &mut [f32],
) {
    let blocks = weight.chunks_exact_mut(LANES).zip(direction.chunks_exact_mut(LANES));
    for (block, (weight, direction)) in blocks.enumerate() {
        let span = block * LANES..(block + 1) * LANES;
        let (above, below, window) = (&above[span.clone()], &below[span.clone()], &window[span.clone()]);
        let (left, right) = (&row[span.clone()], &row[span.start + 2..span.end + 2]);
        for i in 0..LANES {
            let (x, y) = (right[i] - left[i], below[i] - above[i]);
            weight[i] = (x * x + y * y).sqrt() * window[i] * row_weight;
            direction[i] = direction_of::<FMA>(x, y);
        }
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
