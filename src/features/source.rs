//! Where the first level of an octave comes from.
//!
//! Octave 0: the image blurred from the camera's sigma c to sigma0. Later octaves: every second pixel of the level of
//! twice sigma0 of the octave before. Octave -1: the image at twice the resolution, with `sigma0` in its own pixels, that
//! is `sigma0 / 2` in original ones. With s^2 = (sigma0 / 2)^2 - c^2, its value at the original position p is
//!
//! ```text
//! sum_i I(i) g(p - i) / sum_i g(p - i),   g the Gaussian of sigma s,   p = u / 2 - 1/4 for the doubled column u,
//! ```
//!
//! interpolation and blur at once. Every p lies a quarter pixel from an i, so there are two kernels, mirror images of each
//! other, and all pixels are equally sharp (linear interpolation blurs by changing amounts).

use super::blur::{BATCH, Kernel, Scratch, blur_rows, extend_border};
use super::octave::Plane;
use super::options::SiftOptions;
use super::ring::{BLOCK, Ring, padded};
use super::simd::{Isa, mul_add, stamp};
use crate::scene::GrayImage;

/// The interpolation kernels of octave -1 are cut off at this many sigmas.
const CUTOFF_SIGMAS: f32 = 4.0;
/// Sigma of an interpolation that is meant to blur nothing; a Gaussian must keep some width to interpolate.
const MIN_INTERPOLATION_SIGMA_PX: f32 = 0.35;

/// Gives the rows of the first level of an octave.
pub(super) struct Source<'a> {
    size: (usize, usize),
    kind: Kind<'a>,
}

enum Kind<'a> {
    Original { image: &'a GrayImage, kernel: Kernel, rows: Ring },
    Doubled { image: &'a GrayImage, taps: Vec<f32>, rows: Ring, columns: Vec<f32>, scratch: Vec<f32> },
    Seed(Plane),
}

impl<'a> Source<'a> {
    /// The first level of octave 0.
    pub(super) fn original(image: &'a GrayImage, options: &SiftOptions) -> Self {
        let blur_sq = options.sigma0.powi(2) - options.camera_sigma_px.powi(2);
        let kernel = Kernel::gaussian(blur_sq.sqrt());
        let rows = Ring::new(image.width, 2 * kernel.radius() + BATCH);
        Self { size: (image.width, image.height), kind: Kind::Original { image, kernel, rows } }
    }

    /// The first level of octave -1.
    pub(super) fn doubled(image: &'a GrayImage, options: &SiftOptions) -> Self {
        let blur_sq = (0.5 * options.sigma0).powi(2) - options.camera_sigma_px.powi(2);
        let sigma = blur_sq.max(MIN_INTERPOLATION_SIGMA_PX.powi(2)).sqrt();
        let radius = (CUTOFF_SIGMAS * sigma).round().max(1.0) as usize;
        // Weights for a position a quarter pixel before the central tap, at offsets -radius..=radius.
        let weight = |tap: usize| {
            let distance = tap as f32 - radius as f32 + 0.25;
            (-0.5 * (distance / sigma).powi(2)).exp()
        };
        let sum: f32 = (0..=2 * radius).map(weight).sum();
        let taps = (0..=2 * radius).map(|tap| weight(tap) / sum).collect();
        Self {
            size: (2 * image.width, 2 * image.height),
            kind: Kind::Doubled {
                image,
                taps,
                rows: Ring::new(image.width, 2 * radius + 1),
                columns: vec![0.0; padded(image.width) + 2 * radius],
                scratch: vec![0.0; 2 * padded(image.width)],
            },
        }
    }

    /// A finished first level.
    pub(super) fn seed(plane: Plane) -> Self {
        Self { size: (plane.width, plane.height), kind: Kind::Seed(plane) }
    }

    /// Columns and rows.
    pub(super) fn size(&self) -> (usize, usize) {
        self.size
    }

    /// Radius of the blur that `fill` does.
    pub(super) fn radius(&self) -> usize {
        match &self.kind {
            Kind::Original { kernel, .. } => kernel.radius(),
            Kind::Doubled { .. } | Kind::Seed(_) => 0,
        }
    }

    /// Writes rows `y..`, at most [`BATCH`] of them; rows are asked for in order.
    pub(super) fn fill(&mut self, isa: Isa, y: usize, scratch: &mut Scratch, outs: &mut [&mut [f32]]) {
        if let Kind::Original { image, kernel, rows } = &mut self.kind {
            read_rows(isa, image, rows, y + outs.len() - 1 + kernel.radius());
            blur_rows(isa, kernel, rows, self.size, y, scratch, outs);
            return;
        }
        for (y, out) in (y..).zip(outs) {
            self.fill_row(isa, y, out);
        }
    }

    /// Writes row `y` of a source that is not blurred from others.
    fn fill_row(&mut self, isa: Isa, y: usize, out: &mut [f32]) {
        match &mut self.kind {
            Kind::Original { .. } => {}
            Kind::Doubled { image, taps, rows, columns, scratch } => {
                let (radius, center) = (taps.len() / 2, y / 2);
                read_rows(isa, image, rows, center + radius);
                // Even rows lie a quarter pixel before the original row, odd ones after, where the taps are mirrored.
                let around: Vec<&[f32]> = (0..taps.len())
                    .map(|tap| if y.is_multiple_of(2) { tap } else { taps.len() - 1 - tap })
                    .map(|offset| rows.row((center + offset).saturating_sub(radius).min(image.height - 1)))
                    .collect();
                let stride = padded(image.width);
                mix_rows(isa, taps, &around, &mut columns[radius..radius + stride]);
                extend_border(columns, radius, image.width);
                let (before, after) = scratch.split_at_mut(stride);
                interpolate(isa, taps, columns, before, after);
                let pairs = before.iter().zip(after.iter());
                for (out, (&before, &after)) in out.chunks_exact_mut(2).zip(pairs) {
                    out[0] = before;
                    out[1] = after;
                }
            }
            Kind::Seed(plane) => out[..plane.width].copy_from_slice(plane.row(y)),
        }
    }
}

/// Pushes image rows, as grey values in [0, 1], until `last` is there or the image ends.
fn read_rows(isa: Isa, image: &GrayImage, rows: &mut Ring, last: usize) {
    while rows.next() <= last.min(image.height - 1) {
        let start = rows.next() * image.width;
        to_unit(isa, &image.data[start..start + image.width], rows.push());
    }
}

stamp!(
    /// Grey values as numbers in [0, 1].
    to_unit => to_unit_body(bytes: &[u8], out: &mut [f32])
);

#[inline(always)]
fn to_unit_body<const FMA: bool>(bytes: &[u8], out: &mut [f32]) {
    for (out, &byte) in out.iter_mut().zip(bytes) {
        *out = f32::from(byte) * (1.0 / 255.0);
    }
}

stamp!(
    /// Weighted sum of rows.
    mix_rows => mix_rows_body(weights: &[f32], rows: &[&[f32]], out: &mut [f32])
);

#[inline(always)]
fn mix_rows_body<const FMA: bool>(weights: &[f32], rows: &[&[f32]], out: &mut [f32]) {
    for (block, out) in out.chunks_exact_mut(BLOCK).enumerate() {
        let span = block * BLOCK..(block + 1) * BLOCK;
        let mut sum = [0.0_f32; BLOCK];
        for (&weight, row) in weights.iter().zip(rows) {
            let row = &row[span.clone()];
            for i in 0..BLOCK {
                sum[i] = mul_add::<FMA>(weight, row[i], sum[i]);
            }
        }
        out.copy_from_slice(&sum);
    }
}

stamp!(
    /// The values a quarter pixel before and after every pixel of `values`, which has a margin of the taps' radius.
    interpolate => interpolate_body(taps: &[f32], values: &[f32], before: &mut [f32], after: &mut [f32])
);

#[inline(always)]
fn interpolate_body<const FMA: bool>(taps: &[f32], values: &[f32], before: &mut [f32], after: &mut [f32]) {
    let blocks = before.chunks_exact_mut(BLOCK).zip(after.chunks_exact_mut(BLOCK));
    for (block, (before, after)) in blocks.enumerate() {
        let (mut sum_before, mut sum_after) = ([0.0_f32; BLOCK], [0.0_f32; BLOCK]);
        for (tap, (&forward, &backward)) in taps.iter().zip(taps.iter().rev()).enumerate() {
            let values = &values[block * BLOCK + tap..block * BLOCK + tap + BLOCK];
            for i in 0..BLOCK {
                sum_before[i] = mul_add::<FMA>(forward, values[i], sum_before[i]);
                sum_after[i] = mul_add::<FMA>(backward, values[i], sum_after[i]);
            }
        }
        before.copy_from_slice(&sum_before);
        after.copy_from_slice(&sum_after);
    }
}
