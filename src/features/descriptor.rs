//! The descriptor: 4 x 4 histograms of 8 gradient directions, in the keypoint's frame (Lowe 2004, section 6), as RootSIFT.
//!
//! With d the offset from the keypoint and theta its orientation, the frame's coordinates in bins are
//!
//! ```text
//! u = ( cos theta dx + sin theta dy) / (3 sigma),   v = (-sin theta dx + cos theta dy) / (3 sigma),   |u|, |v| < 2.5,
//! ```
//!
//! each sample weighs |gradient| exp(-(u^2 + v^2) / 8) and is shared linearly among the two nearest bins in u, v and
//! direction. The 128 values are clipped at 0.2 of their Euclidean norm, divided by their sum, and the square root is taken.
//!
//! Samples are taken as Lowe takes them, on a grid that is turned with the keypoint, each of the nearest gradient that is
//! stored. So what depends on u and v is the same for every keypoint, a table, and the bins are sums with fixed weights,
//! of whole rows of samples: for each direction, what it takes of every sample; of these, rows of bins as sums of rows of
//! samples; of these, bins as sums of columns. All of it fills whole registers, and nothing is added at an address that
//! depends on the data, except that the gradients are fetched one by one.
//!
//! To go through the pixels of the level instead, and to add each to the eight bins around it, took three times as long:
//! every pixel has its own weights then, and waits for the sums of the pixels before it.

use std::f32::consts::{SQRT_2, TAU};

use super::gradient_map::{self, Gradient, GradientMap, Rows, STEP};
use super::simd::{Isa, mul_add, stamp, whole_number};
use crate::scene::{DESCRIPTOR_LEN, Descriptor};

/// Spatial bins a side.
const SIDE: usize = 4;
/// Direction bins.
const DIRECTIONS: usize = 8;
/// Width of a spatial bin in sigmas.
const BIN_SIGMAS: f32 = 3.0;
/// Samples are taken up to this many bins from the centre along either axis.
const REACH: f32 = 0.5 * (SIDE as f32 + 1.0);
/// The Gaussian weight is exp(-(u^2 + v^2) / this): its sigma is half the descriptor's width.
const FALLOFF: f32 = 0.5 * (SIDE * SIDE) as f32;
/// Largest value, relative to the Euclidean norm.
const CLIP: f32 = 0.2;
/// Quantisation of the square roots.
const QUANTISATION: f32 = 512.0;

/// Samples from the middle of one bin to that of the next. Four of them, three quarters of a sigma apart, bring 164,166
/// correct matches over ten warps of six photographs, all gradients that are stored 164,477; sixteen a side 163,396.
const SPACING: usize = 4;
/// Samples a side, also beyond the middles of the outer bins.
const SAMPLES: usize = (SIDE + 1) * SPACING;
/// All samples, row by row.
const PATCH: usize = SAMPLES * SAMPLES;

/// A bin of direction, of 2^32 to a turn.
const DIRECTION_BIN: u32 = 1 << 29;

/// How far from a keypoint of this sigma gradients are taken, in the same pixels.
pub(super) fn radius_px(sigma: f32) -> f32 {
    SQRT_2 * REACH * BIN_SIGMAS * sigma + STEP as f32
}

/// Parts of the sums of a row of bins: [`SPACING`] for each.
const ROW: usize = SIDE * SPACING;

/// Computes descriptors.
pub(super) struct Describer {
    /// Place of every sample, in bins from the centre along u.
    u: [f32; PATCH],
    /// The same along v.
    v: [f32; PATCH],
    shares: Shares,
    samples: Samples,
}

/// The parts that the bins along an axis take of samples, times the Gaussian weight. With `SPACING` samples from bin to bin,
/// those at k `SPACING` + i, for all i, lie between the bins k - 1 and k.
pub(super) struct Shares {
    /// What bin k takes of sample k `SPACING` + i, at the same place.
    rising: [f32; ROW],
    /// What bin k takes of sample (k + 1) `SPACING` + i.
    falling: [f32; ROW],
}

/// Samples of one keypoint.
pub(super) struct Samples {
    /// What they weigh: their length, or nothing.
    weight: [f32; PATCH],
    /// Their direction against the keypoint's orientation, of 2^32 to a turn.
    turn: [u32; PATCH],
}

impl Describer {
    /// A describer; it only keeps tables and a buffer.
    pub(super) fn new() -> Self {
        let place = |i: usize| (i as f32 - 0.5 * (SAMPLES - 1) as f32) / SPACING as f32;
        let share = |bin: usize, sample: usize| {
            let (place, middle) = (place(sample), bin as f32 - 0.5 * (SIDE - 1) as f32);
            (1.0 - (place - middle).abs()) * (-place * place / FALLOFF).exp()
        };
        let shares = |ahead: usize| std::array::from_fn(|at| share(at / SPACING, at + ahead));
        Self {
            u: std::array::from_fn(|sample| place(sample % SAMPLES)),
            v: std::array::from_fn(|sample| place(sample / SAMPLES)),
            shares: Shares { rising: shares(0), falling: shares(SPACING) },
            samples: Samples { weight: [0.0; PATCH], turn: [0; PATCH] },
        }
    }

    /// The descriptor at `(x, y)` (first pixel at 0) of a level of this width and height.
    pub(super) fn describe(
        &mut self,
        isa: Isa,
        gradients: &GradientMap,
        size: (usize, usize),
        at: (f32, f32),
        sigma: f32,
        theta: f32,
    ) -> Descriptor {
        let frame = Frame::new(at, sigma, theta);
        let rows = gradients.around(at.1, radius_px(sigma));
        take_samples(isa, &rows, &frame, size, self);
        let histograms = histograms(isa, &self.shares, &self.samples);
        quantise(isa, &histograms)
    }
}

/// The keypoint's frame in a gradient map, whose unit is [`STEP`] pixels.
pub(super) struct Frame {
    x: f32,
    y: f32,
    /// From one bin to the next along u; along v it is this turned by a quarter.
    du: (f32, f32),
    /// The keypoint's orientation, of 2^32 to a turn.
    orientation: u32,
}

impl Frame {
    fn new((x, y): (f32, f32), sigma: f32, theta: f32) -> Self {
        let step = 1.0 / STEP as f32;
        let bin = BIN_SIGMAS * sigma * step;
        let (sin, cos) = theta.sin_cos();
        let orientation = (theta * (gradient_map::TURN as f32 / TAU)).round() as u32;
        Self { x: x * step, y: y * step, du: (bin * cos, bin * sin), orientation: gradient_map::direction(orientation) }
    }
}

/// The first and the last place off the border in a gradient map of a level so many pixels long.
fn inner(length: usize) -> (f32, f32) {
    (1.0, ((length - 2) / STEP) as f32)
}

stamp!(
    /// Takes the samples around a keypoint, each of the gradient nearest to its place. On the border of the level and beyond
    /// there are none.
    take_samples => take_samples_body(
        rows: &Rows<'_>, frame: &Frame, size: (usize, usize), describer: &mut Describer,
    )
);

#[inline(always)]
fn take_samples_body<const FMA: bool>(
    rows: &Rows<'_>,
    frame: &Frame,
    (width, height): (usize, usize),
    describer: &mut Describer,
) {
    let Describer { u, v, samples: Samples { weight, turn }, .. } = describer;
    let ((left, right), (top, bottom)) = (inner(width), inner(height));
    let (cos, sin) = frame.du;
    for i in 0..PATCH {
        let x = mul_add::<FMA>(cos, u[i], mul_add::<FMA>(-sin, v[i], frame.x));
        let y = mul_add::<FMA>(sin, u[i], mul_add::<FMA>(cos, v[i], frame.y));
        let (in_x, in_y) = (x.max(left).min(right), y.max(top).min(bottom));
        let is_near = (x - in_x).abs().max((y - in_y).abs()) <= 0.5;
        weight[i] = if is_near { 1.0 } else { 0.0 };
        turn[i] = rows.index(whole_number(in_y), whole_number(in_x));
    }
    for place in turn.iter_mut() {
        *place = rows.at(*place);
    }
    for i in 0..PATCH {
        let gradient: Gradient = turn[i];
        weight[i] *= gradient_map::length(gradient);
        turn[i] = gradient_map::direction(gradient).wrapping_sub(frame.orientation);
    }
}

/// Histograms of all bins, by row and column.
type Histograms = [f32; DESCRIPTOR_LEN];

stamp!(
    /// The histograms of samples.
    histograms => histograms_body(shares: &Shares, samples: &Samples) -> Histograms
);

#[inline(always)]
fn histograms_body<const FMA: bool>(shares: &Shares, samples: &Samples) -> Histograms {
    let Shares { rising, falling } = shares;
    let mut partial = [0.0_f32; SPACING * DESCRIPTOR_LEN];
    let mut parts = [0.0_f32; PATCH];
    for direction in 0..DIRECTIONS {
        for (part, (weight, turn)) in parts.iter_mut().zip(samples.weight.iter().zip(&samples.turn)) {
            // How far the bin is away wraps around with the turn.
            let away = (turn.wrapping_sub(direction as u32 * DIRECTION_BIN) as i32).unsigned_abs();
            let share = DIRECTION_BIN - away.min(DIRECTION_BIN);
            *part = weight * (share as i32 as f32 * (1.0 / DIRECTION_BIN as f32));
        }
        for bin in 0..SIDE {
            let mut sums = [0.0_f32; SAMPLES];
            for at in bin * SPACING..(bin + 1) * SPACING {
                let (before, after) =
                    (&parts[at * SAMPLES..][..SAMPLES], &parts[(at + SPACING) * SAMPLES..][..SAMPLES]);
                for i in 0..SAMPLES {
                    sums[i] = mul_add::<FMA>(rising[at], before[i], sums[i]);
                    sums[i] = mul_add::<FMA>(falling[at], after[i], sums[i]);
                }
            }
            let partial = &mut partial[(bin * DIRECTIONS + direction) * ROW..][..ROW];
            for i in 0..ROW {
                partial[i] = mul_add::<FMA>(rising[i], sums[i], falling[i] * sums[i + SPACING]);
            }
        }
    }
    let mut by_direction = [0.0_f32; DESCRIPTOR_LEN];
    for (sum, [a, b, c, d]) in by_direction.iter_mut().zip(partial.as_chunks::<SPACING>().0) {
        *sum = (a + b) + (c + d);
    }
    std::array::from_fn(|i| {
        let (row, column, direction) = (i / (SIDE * DIRECTIONS), i / DIRECTIONS % SIDE, i % DIRECTIONS);
        by_direction[(row * DIRECTIONS + direction) * SIDE + column]
    })
}

stamp!(
    /// Clips, normalises, takes roots and rounds. Without any gradient all values are 0.
    quantise => quantise_body(values: &Histograms) -> Descriptor
);

#[inline(always)]
fn quantise_body<const FMA: bool>(values: &Histograms) -> Descriptor {
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::features::ring::Ring;
    use crate::math::Rng;

    #[test]
    fn histograms_are_those_of_the_definition() {
        let (mut describer, mut rng) = (Describer::new(), Rng::from_parts(&[12]));
        describer.samples.weight.fill_with(|| rng.uniform() as f32);
        describer.samples.turn.fill_with(|| (rng.uniform() * 4_294_967_296.0) as u32);
        let mut wanted = [0.0_f64; DESCRIPTOR_LEN];
        for i in 0..PATCH {
            let (u, v) = (f64::from(describer.u[i]), f64::from(describer.v[i]));
            let turn = f64::from(describer.samples.turn[i]) / f64::from(DIRECTION_BIN);
            for (at, wanted) in wanted.iter_mut().enumerate() {
                let (row, column, direction) = (at / 32, at / 8 % 4, at % 8);
                let near = |away: f64| (1.0 - away.abs()).max(0.0);
                let away = (turn - direction as f64).rem_euclid(8.0);
                let share = near(v + 1.5 - row as f64) * near(u + 1.5 - column as f64) * near(away.min(8.0 - away));
                *wanted += f64::from(describer.samples.weight[i]) * share * (-(u * u + v * v) / 8.0).exp();
            }
        }
        for isa in Isa::available() {
            let found = histograms(isa, &describer.shares, &describer.samples);
            for (found, wanted) in found.iter().zip(wanted) {
                assert!((f64::from(*found) - wanted).abs() < 1e-4 * wanted, "{isa:?}: {found} for {wanted}");
            }
        }
    }

    #[test]
    fn samples_are_the_nearest_gradients_and_none_beyond_the_border() {
        let (width, height) = (61_usize, 53_usize);
        let mut rng = Rng::from_parts(&[13]);
        for isa in Isa::available() {
            let (mut level, mut map) = (Ring::new(width, height), GradientMap::new(width, height));
            for _ in 0..height {
                level.push().fill_with(|| rng.uniform() as f32);
            }
            map.follow(isa, &level);
            let (mut inside, mut outside) = (0, 0);
            for (at, theta) in [((30.3, 26.2), 0.7), ((9.1, 8.4), 4.0), ((55.0, 47.7), 2.5)] {
                let (sigma, mut describer) = (1.9, Describer::new());
                let frame = Frame::new(at, sigma, theta);
                let rows = map.around(at.1, radius_px(sigma));
                take_samples(isa, &rows, &frame, (width, height), &mut describer);
                let (sin, cos) = f64::from(theta).sin_cos();
                for i in 0..PATCH {
                    let bin = f64::from(BIN_SIGMAS * sigma);
                    let (u, v) = (bin * f64::from(describer.u[i]), bin * f64::from(describer.v[i]));
                    let place = [f64::from(at.0) + cos * u - sin * v, f64::from(at.1) + sin * u + cos * v];
                    let place = place.map(|at| at / STEP as f64);
                    if place.iter().any(|at| (at - at.floor() - 0.5).abs() < 1e-3) {
                        continue;
                    }
                    let [column, row] = place.map(f64::round);
                    let is_off_border = |at: f64, length: usize| at >= 1.0 && at * STEP as f64 <= (length - 2) as f64;
                    if !is_off_border(column, width) || !is_off_border(row, height) {
                        assert_eq!(describer.samples.weight[i], 0.0);
                        outside += 1;
                        continue;
                    }
                    let gradient = rows.at(rows.index(row as u32, column as u32));
                    assert_eq!(describer.samples.weight[i], gradient_map::length(gradient));
                    let direction = gradient_map::direction(gradient).wrapping_sub(frame.orientation);
                    assert_eq!(describer.samples.turn[i], direction);
                    inside += 1;
                }
            }
            assert!(inside > 700 && outside > 100, "{inside} inside, {outside} outside");
        }
    }
}
