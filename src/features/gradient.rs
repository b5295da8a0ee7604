//! Gradients of a stretch of one row, as weighted magnitude and direction.

use std::f32::consts::{FRAC_PI_2, PI, TAU};

use super::ring::Ring;
use super::simd::{Isa, mul_add, stamp};

/// Keeps the quotient of two vanishing gradients finite; far below any gradient of 8-bit pixels.
const TINY: f32 = 1e-30;

/// Pixels computed together; stretches are computed in whole multiples.
pub(super) const LANES: usize = 16;
/// Room for the longest stretch of one row that is looked at: across the widest descriptor of the largest sigma.
const MAX_STRETCH: usize = 1024;

/// Which columns are looked at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Every {
    /// All.
    Pixel,
    /// Every second.
    Second,
}

impl Every {
    /// Columns from one to the next.
    pub(super) fn columns(self) -> usize {
        match self {
            Self::Pixel => 1,
            Self::Second => 2,
        }
    }
}

/// Gradients of a stretch of one row, and the buffers for their weights.
pub(super) struct Patch {
    /// Weight of each column of the window, set by [`Patch::set_window`].
    window: Vec<f32>,
    window_from: usize,
    every: Every,
    /// Length of the gradient times its weight.
    pub(super) weight: Vec<f32>,
    /// Direction in [0, 2 pi), from +x to +y.
    pub(super) direction: Vec<f32>,
}

impl Patch {
    /// Room for the longest stretch.
    pub(super) fn new() -> Self {
        let zeros = || vec![0.0; MAX_STRETCH];
        Self { window: zeros(), window_from: 0, every: Every::Pixel, weight: zeros(), direction: zeros() }
    }

    /// Sets the columns' part of the Gaussian window exp(falloff (dx^2 + dy^2)) around `x`, for the columns `from`,
    /// `from + every`, ... before `to`.
    pub(super) fn set_window(&mut self, x: f32, falloff: f32, from: usize, to: usize, every: Every) {
        self.window_from = from;
        for (column, weight) in (from..to).step_by(every.columns()).zip(&mut self.window) {
            *weight = (falloff * (column as f32 - x).powi(2)).exp();
        }
        self.every = every;
    }

    /// Gradients by central differences of the window's pixels among `from..to` of row `y`, weighted by the window's columns
    /// and `row_weight`; returns how many. `from` must be a column of the window, and no pixel may lie on the border or
    /// outside the window.
    pub(super) fn fill(&mut self, isa: Isa, ring: &Ring, y: usize, from: usize, to: usize, row_weight: f32) -> usize {
        let step = self.every.columns();
        let count = (to - from).div_ceil(step);
        let padded = count.next_multiple_of(LANES);
        let (first, length) = ((from - self.window_from) / step, step * padded);
        let kernel = match self.every {
            Every::Pixel => gradients,
            Every::Second => gradients_of_every_second,
        };
        kernel(
            isa,
            ring.stretch(y - 1, from, length),
            ring.stretch(y + 1, from, length),
            ring.stretch(y, from - 1, length + 2),
            &self.window[first..first + padded],
            row_weight,
            &mut self.weight[..padded],
            &mut self.direction[..padded],
        );
        count
    }
}

stamp!(
    /// See [`Patch::fill`].
    gradients => gradients_body(
        above: &[f32], below: &[f32], row: &[f32], window: &[f32], row_weight: f32,
        weight: &mut [f32], direction: &mut [f32],
    )
);

stamp!(
    /// See [`Patch::fill`].
    gradients_of_every_second => gradients_of_every_second_body(
        above: &[f32], below: &[f32], row: &[f32], window: &[f32], row_weight: f32,
        weight: &mut [f32], direction: &mut [f32],
    )
);

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn gradients_body<const FMA: bool>(
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
            let gradient = (right[i] - left[i], below[i] - above[i]);
            (weight[i], direction[i]) = polar::<FMA>(gradient, window[i], row_weight);
        }
    }
}

#[inline(always)]
#[allow(clippy::too_many_arguments)]
fn gradients_of_every_second_body<const FMA: bool>(
    above: &[f32],
    below: &[f32],
    row: &[f32],
    window: &[f32],
    row_weight: f32,
    weight: &mut [f32],
    direction: &mut [f32],
) {
    // One flat loop over pairs of pixels: only so does the compiler load whole registers and take them apart in one step.
    let count = weight.len();
    let (above, below) = (&above.as_chunks::<2>().0[..count], &below.as_chunks::<2>().0[..count]);
    let row = &row.as_chunks::<2>().0[..count + 1];
    let (window, direction) = (&window[..count], &mut direction[..count]);
    for i in 0..count {
        let gradient = (row[i + 1][0] - row[i][0], below[i][0] - above[i][0]);
        (weight[i], direction[i]) = polar::<FMA>(gradient, window[i], row_weight);
    }
}

/// Weighted length and direction of a gradient.
#[inline(always)]
fn polar<const FMA: bool>((x, y): (f32, f32), column_weight: f32, row_weight: f32) -> (f32, f32) {
    ((x * x + y * y).sqrt() * column_weight * row_weight, direction_of::<FMA>(x, y))
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
