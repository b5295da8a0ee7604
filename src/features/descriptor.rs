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

use super::gradient::{LANES, fill_window};
use super::gradient_map::{self, Gradient, GradientMap, STEP};
use super::orientation::clip;
use super::simd::{Isa, mul_add, stamp, whole_number};
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
/// The last place in bins, counted from the rim's first bin, that shares with an existing bin.
const MAX_PLACE: f32 = SIDE as f32 + 0.999;
/// The last cell with neighbours to the right and below.
const MAX_CELL: usize = SIDE * RIMMED + SIDE;
/// Largest value, relative to the Euclidean norm.
const CLIP: f32 = 0.2;
/// Quantisation of the square roots.
const QUANTISATION: f32 = 512.0;

/// Gradients of the longest row of a patch: across the widest descriptor of the largest sigma.
const MAX_STRETCH: usize = 512;

/// How far a descriptor at a keypoint of this sigma reaches, in the same pixels.
pub(super) fn radius_px(sigma: f32) -> f32 {
    SQRT_2 * REACH * BIN_SIGMAS * sigma + 1.0
}

/// Histograms of all cells, by row and column.
type Cells = [f32; RIMMED * RIMMED * DIRECTIONS];
/// Copies of the cells that pixels are added to in turn.
///
/// A pixel adds to 2 x 2 cells, in memory two pairs of neighbours, 16 numbers each. The next pixel mostly adds to the same
/// ones, and would have to wait until the sum just stored can be loaded again (about 15 cycles on a Zen 5, where the
/// arithmetic takes 6): with four copies it waits for the fourth pixel before it instead, and arithmetic is the limit.
const COPIES: usize = 4;

/// Computes descriptors.
pub(super) struct Describer {
    copies: [Cells; COPIES],
    /// The columns' part of the Gaussian weight.
    window: [f32; MAX_STRETCH],
}

/// Where a stretch of a row lies in the keypoint's frame.
pub(super) struct Stretch {
    u: f32,
    v: f32,
    /// From one gradient to the next.
    du: f32,
    dv: f32,
    /// The keypoint's orientation in parts of a turn.
    orientation: u32,
    /// The row's part of the Gaussian weight.
    weight: f32,
}

impl Describer {
    /// A describer; it only keeps buffers.
    pub(super) fn new() -> Self {
        Self { copies: [[0.0; _]; COPIES], window: [0.0; MAX_STRETCH] }
    }

    /// The descriptor at `(x, y)` (first pixel at 0) of a level of this width and height.
    pub(super) fn describe(
        &mut self,
        isa: Isa,
        gradients: &GradientMap,
        (width, height): (usize, usize),
        (x, y): (f32, f32),
        sigma: f32,
        theta: f32,
    ) -> Descriptor {
        self.copies.as_flattened_mut().fill(0.0);
        add_patch(isa, gradients, (width, height), (x, y), sigma, theta, self);
        quantise(isa, &self.copies)
    }
}

stamp!(
    /// Adds the gradients around a keypoint to the cells.
    add_patch => add_patch_body(
        gradients: &GradientMap, size: (usize, usize), at: (f32, f32), sigma: f32, theta: f32, describer: &mut Describer,
    )
);

#[inline(always)]
fn add_patch_body<const FMA: bool>(
    gradients: &GradientMap,
    (width, height): (usize, usize),
    (x, y): (f32, f32),
    sigma: f32,
    theta: f32,
    describer: &mut Describer,
) {
    let Describer { copies, window } = describer;
    let (sin, cos) = theta.sin_cos();
    let bin = BIN_SIGMAS * sigma;
    let (du, dv) = (cos / bin, -sin / bin);
    let (across_u, across_v) = (1.0 / du, 1.0 / dv);
    let radius = REACH * bin * (sin.abs() + cos.abs());
    let orientation = (theta * (gradient_map::TURN as f32 / TAU)).round() as u32;
    let (top, bottom) = clip_to_steps(y, radius, height);
    let (from, to) = clip_to_steps(x, radius, width);
    let falloff = -1.0 / (FALLOFF * bin * bin);
    fill_window(window, (from..to).map(|column| (STEP * column) as f32 - x), falloff);
    for row in top..bottom {
        let dy = (STEP * row) as f32 - y;
        let (u, v) = (sin * dy / bin, cos * dy / bin);
        let (low_u, high_u) = inside(u, across_u);
        let (low_v, high_v) = inside(v, across_v);
        let (low, high) = (low_u.max(low_v).max(-radius), high_u.min(high_v).min(radius));
        if low >= high {
            continue;
        }
        let (left, right) = clip_to_steps(x + 0.5 * (low + high), 0.5 * (high - low), width);
        let (left, right) = (left.max(from), right.min(to));
        if left >= right {
            continue;
        }
        let (dx, step) = ((STEP * left) as f32 - x, STEP as f32);
        let stretch = Stretch {
            u: mul_add::<FMA>(du, dx, u),
            v: mul_add::<FMA>(dv, dx, v),
            du: step * du,
            dv: step * dv,
            orientation,
            weight: (falloff * dy * dy).exp(),
        };
        let count = right - left;
        let padded = count.next_multiple_of(LANES);
        let window = &window[left - from..][..padded];
        accumulate::<FMA>(&stretch, count, gradients.stretch(row, left, padded), window, copies);
    }
}

/// [`clip`] for the rows or columns of a gradient map.
#[inline(always)]
fn clip_to_steps(center: f32, radius: f32, length: usize) -> (usize, usize) {
    let (from, to) = clip(center, radius, length);
    (from.div_ceil(STEP), to.div_ceil(STEP))
}

/// The range of dx with |at + dx / across| < REACH; `across` is infinite along the axis.
#[inline(always)]
fn inside(at: f32, across: f32) -> (f32, f32) {
    if across.is_infinite() {
        return if at.abs() < REACH { (f32::NEG_INFINITY, f32::INFINITY) } else { (0.0, 0.0) };
    }
    let (a, b) = ((-REACH - at) * across, (REACH - at) * across);
    (a.min(b), a.max(b))
}

/// Adds the first `count` gradients of a stretch to the cells; `gradients` and `window` are whole blocks.
#[inline(always)]
fn accumulate<const FMA: bool>(
    stretch: &Stretch,
    count: usize,
    gradients: &[Gradient],
    window: &[f32],
    copies: &mut [Cells; COPIES],
) {
    const TURN: f32 = DIRECTIONS as f32;
    let mut first_u = stretch.u + REACH;
    let mut first_v = stretch.v + REACH;
    let blocks = gradients.as_chunks::<LANES>().0.iter().zip(window.as_chunks::<LANES>().0);
    for (block, (gradients, window)) in blocks.enumerate() {
        // What each pixel adds to where, for a block of pixels at once ...
        let (mut part_u, mut part_v) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        let (mut weight, mut turn) = ([0.0_f32; LANES], [0.0_f32; LANES]);
        let mut cell = [0_u32; LANES];
        for i in 0..LANES {
            // Rounding may take a pixel of the rim a hair outside.
            let u = mul_add::<FMA>(stretch.du, i as f32, first_u).clamp(0.0, MAX_PLACE);
            let v = mul_add::<FMA>(stretch.dv, i as f32, first_v).clamp(0.0, MAX_PLACE);
            let (column, row) = (u.trunc(), v.trunc());
            part_u[i] = u - column;
            part_v[i] = v - row;
            cell[i] = whole_number(mul_add::<FMA>(row, RIMMED as f32, column));
        }
        for i in 0..LANES {
            weight[i] = gradient_map::length(gradients[i]) * (window[i] * stretch.weight);
            let direction = gradients[i].wrapping_sub(stretch.orientation) & (gradient_map::TURN - 1);
            turn[i] = direction as i32 as f32 * (TURN / gradient_map::TURN as f32);
        }
        first_u += LANES as f32 * stretch.du;
        first_v += LANES as f32 * stretch.dv;
        // ... and the adding, for the eight directions of two neighbouring cells at once.
        for i in 0..LANES.min(count - block * LANES) {
            let mut upper = [0.0_f32; 2 * DIRECTIONS];
            let mut lower = [0.0_f32; 2 * DIRECTIONS];
            let (weight, turn, part_u, part_v) = (weight[i], turn[i], part_u[i], part_v[i]);
            for k in 0..2 * DIRECTIONS {
                let away = (turn - (k % DIRECTIONS) as f32).abs();
                let away = away.min(TURN - away);
                let share = weight * (1.0 - away).max(0.0);
                let (slope, start) = if k < DIRECTIONS { (-1.0, 1.0) } else { (1.0, 0.0) };
                let in_column = share * mul_add::<FMA>(slope, part_u, start);
                lower[k] = in_column * part_v;
                upper[k] = in_column - lower[k];
            }
            let first = DIRECTIONS * (cell[i] as usize).min(MAX_CELL);
            for (start, parts) in [(first, upper), (first + DIRECTIONS * RIMMED, lower)] {
                let cells = &mut copies[i % COPIES][start..start + 2 * DIRECTIONS];
                for (cell, part) in cells.iter_mut().zip(parts) {
                    *cell += part;
                }
            }
        }
    }
}

stamp!(
    /// Sums the copies without the rim, clips, normalises, takes roots and rounds. Without any gradient all values are 0.
    quantise => quantise_body(copies: &[Cells; COPIES]) -> Descriptor
);

#[inline(always)]
fn quantise_body<const FMA: bool>(copies: &[Cells; COPIES]) -> Descriptor {
    let mut values = [0.0_f32; DESCRIPTOR_LEN];
    for (row, out) in values.chunks_exact_mut(SIDE * DIRECTIONS).enumerate() {
        let start = ((row + 1) * RIMMED + 1) * DIRECTIONS;
        for cells in copies {
            for (out, cell) in out.iter_mut().zip(&cells[start..start + SIDE * DIRECTIONS]) {
                *out += cell;
            }
        }
    }
    let norm = sum_of(&values.map(|v| v * v)).sqrt();
    let clipped = values.map(|v| v.min(CLIP * norm));
    let sum = sum_of(&clipped);
    if sum <= f32::MIN_POSITIVE {
        return [0; DESCRIPTOR_LEN];
    }
    clipped.map(|v| whole_number((QUANTISATION * (v / sum).sqrt()).min(255.0)) as u8)
}

/// The sum in sixteen partial sums, so that it vectorises.
#[inline(always)]
fn sum_of(values: &[f32; DESCRIPTOR_LEN]) -> f32 {
    let mut partial = [0.0_f32; 16];
    for chunk in values.as_chunks::<16>().0 {
        for (sum, value) in partial.iter_mut().zip(chunk) {
            *sum += value;
        }
    }
    partial.iter().sum()
}
