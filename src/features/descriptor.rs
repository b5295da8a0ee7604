//! The descriptor: 4 x 4 histograms of 8 gradient directions, in the keypoint's frame (Lowe 2004, section 6), as RootSIFT.
//!
//! With d the offset of a pixel from the keypoint and theta its orientation, the frame's coordinates in bins are
//!
//! ```text
//! u = ( cos theta dx + sin theta dy) / (3 sigma),   v = (-sin theta dx + cos theta dy) / (3 sigma),   |u|, |v| < 2.5,
//! ```
//!
//! each pixel weighs |gradient| exp(-(u^2 + v^2) / 8) and is shared linearly among the two nearest bins in u, v and
//! direction. The 128 values are clipped at 0.2 of their Euclidean norm, divided by their sum, and the square root is taken.

use std::f32::consts::{SQRT_2, TAU};

use super::gradient::Patch;
use super::orientation::clip;
use super::ring::Ring;
use super::simd::{Isa, mul_add, stamp};
use crate::scene::{DESCRIPTOR_LEN, Descriptor};

/// Spatial bins a side.
const SIDE: usize = 4;
/// Bins a side with a rim that takes what falls outside.
const RIMMED: usize = SIDE + 2;
/// Direction bins.
const DIRECTIONS: usize = 8;
/// Width of a spatial bin in sigmas.
const BIN_SIGMAS: f32 = 3.0;
/// Pixels count up to this many bins from the centre along either axis.
const REACH: f32 = 0.5 * (SIDE as f32 + 1.0);
/// The Gaussian weight is exp(-(u^2 + v^2) / this): its sigma is half the descriptor's width.
const FALLOFF: f32 = 0.5 * (SIDE * SIDE) as f32;
/// Largest value, relative to the Euclidean norm.
const CLIP: f32 = 0.2;
/// Quantisation of the square roots.
const QUANTISATION: f32 = 512.0;

/// How far a descriptor at a keypoint of this sigma reaches, in the same pixels.
pub(super) fn radius_px(sigma: f32) -> f32 {
    SQRT_2 * REACH * BIN_SIGMAS * sigma + 1.0
}

pub(super) type Cells = [[f32; DIRECTIONS]; RIMMED * RIMMED];

/// Computes descriptors.
pub(super) struct Describer {
    cells: Cells,
}

/// Where a stretch of a row lies in the keypoint's frame.
pub(super) struct Stretch {
    u: f32,
    v: f32,
    du: f32,
    dv: f32,
    theta: f32,
}

impl Describer {
    /// A describer; it only keeps buffers.
    pub(super) fn new() -> Self {
        Self { cells: [[0.0; DIRECTIONS]; RIMMED * RIMMED] }
    }

    /// The descriptor at `(x, y)` (first pixel at 0) of a level.
    #[allow(clippy::too_many_arguments)]
    pub(super) fn describe(
        &mut self,
        isa: Isa,
        ring: &Ring,
        (width, height): (usize, usize),
        (x, y): (f32, f32),
        sigma: f32,
        theta: f32,
        patch: &mut Patch,
    ) -> Descriptor {
        self.cells = [[0.0; DIRECTIONS]; RIMMED * RIMMED];
        let (sin, cos) = theta.sin_cos();
        let bin = BIN_SIGMAS * sigma;
        let (du, dv) = (cos / bin, -sin / bin);
        let radius = REACH * bin * (sin.abs() + cos.abs());
        let (top, bottom) = clip(y, radius, height);
        for row in top..bottom {
            let dy = row as f32 - y;
            let (u, v) = (sin * dy / bin, cos * dy / bin);
            let (low_u, high_u) = inside(u, du);
            let (low_v, high_v) = inside(v, dv);
            let (low, high) = (low_u.max(low_v).max(-radius), high_u.min(high_v).min(radius));
            if low >= high {
                continue;
            }
            let (left, right) = clip(x + 0.5 * (low + high), 0.5 * (high - low), width);
            if left >= right {
                continue;
            }
            patch.fill(isa, ring, row, left, right);
            let dx = left as f32 - x;
            let stretch = Stretch { u: u + du * dx, v: v + dv * dx, du, dv, theta };
            let count = right - left;
            accumulate(isa, &stretch, &patch.magnitude[..count], &patch.direction[..count], &mut self.cells);
        }
        quantise(&self.cells)
    }
}

/// The range of dx with |at + slope dx| < REACH.
fn inside(at: f32, slope: f32) -> (f32, f32) {
    let (a, b) = ((-REACH - at) / slope, (REACH - at) / slope);
    if slope == 0.0 {
        if at.abs() < REACH { (f32::NEG_INFINITY, f32::INFINITY) } else { (0.0, 0.0) }
    } else {
        (a.min(b), a.max(b))
    }
}

stamp!(
    /// Adds a stretch of gradients to the cells.
    accumulate => accumulate_body(stretch: &Stretch, magnitude: &[f32], direction: &[f32], cells: &mut Cells)
);

#[inline(always)]
fn accumulate_body<const FMA: bool>(stretch: &Stretch, magnitude: &[f32], direction: &[f32], cells: &mut Cells) {
    /// The first value within the rim: coordinate -REACH falls there.
    const ORIGIN: f32 = REACH;
    for (i, (&magnitude, &direction)) in magnitude.iter().zip(direction).enumerate() {
        let u = mul_add::<FMA>(stretch.du, i as f32, stretch.u);
        let v = mul_add::<FMA>(stretch.dv, i as f32, stretch.v);
        let weight = magnitude * (-(u * u + v * v) / FALLOFF).exp();
        let (column, row) = ((u + ORIGIN).max(0.0), (v + ORIGIN).max(0.0));
        let (c, r) = ((column as usize).min(SIDE), (row as usize).min(SIDE));
        let (pc, pr) = (column - c as f32, row - r as f32);
        // Shares of the eight directions: 1 - distance in bins, around the circle.
        let turn = (direction - stretch.theta) * (DIRECTIONS as f32 / TAU);
        let turn = if turn < 0.0 { turn + DIRECTIONS as f32 } else { turn };
        let mut shares = [0.0_f32; DIRECTIONS];
        for (k, share) in shares.iter_mut().enumerate() {
            let away = (turn - k as f32).abs();
            let away = if away > 0.5 * DIRECTIONS as f32 { DIRECTIONS as f32 - away } else { away };
            *share = if away < 1.0 { weight * (1.0 - away) } else { 0.0 };
        }
        let first = r * RIMMED + c;
        let corners = [
            (first, (1.0 - pr) * (1.0 - pc)),
            (first + 1, (1.0 - pr) * pc),
            (first + RIMMED, pr * (1.0 - pc)),
            (first + RIMMED + 1, pr * pc),
        ];
        for (cell, part) in corners {
            let cell = &mut cells[cell];
            for k in 0..DIRECTIONS {
                cell[k] = mul_add::<FMA>(part, shares[k], cell[k]);
            }
        }
    }
}

/// Clips, normalises, takes roots and rounds. Without any gradient all values are 0.
fn quantise(cells: &Cells) -> Descriptor {
    let mut values = [0.0_f32; DESCRIPTOR_LEN];
    for (i, out) in values.chunks_exact_mut(DIRECTIONS).enumerate() {
        out.copy_from_slice(&cells[(i / SIDE + 1) * RIMMED + i % SIDE + 1]);
    }
    let norm = values.iter().map(|v| v * v).sum::<f32>().sqrt();
    let sum: f32 = values.iter().map(|v| v.min(CLIP * norm)).sum();
    if sum <= f32::MIN_POSITIVE {
        return [0; DESCRIPTOR_LEN];
    }
    values.map(|v| (QUANTISATION * (v.min(CLIP * norm) / sum).sqrt()).round().min(255.0) as u8)
}
