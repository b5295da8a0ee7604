//! Separable Gaussian blur of one row: first down the columns of the source rows around it, then along the result.
//! Beyond the border the image goes on with its outermost pixels.

use super::ring::{BLOCK, Ring, padded};
use super::simd::{Isa, mul_add, stamp};

/// Kernels are cut off at this many sigmas, where a Gaussian has fallen to 3e-4 of its peak.
const CUTOFF_SIGMAS: f32 = 4.0;

/// Half a symmetric, normalised Gaussian kernel.
pub(super) struct Kernel {
    /// The weight of the centre, then of its neighbours outwards.
    weights: Vec<f32>,
}

impl Kernel {
    /// The kernel of this sigma in pixels.
    pub(super) fn gaussian(sigma: f32) -> Self {
        let radius = (CUTOFF_SIGMAS * sigma).ceil().max(1.0) as usize;
        let weight = |k: usize| (-0.5 * (k as f64 / f64::from(sigma)).powi(2)).exp();
        let sum = weight(0) + 2.0 * (1..=radius).map(weight).sum::<f64>();
        Self { weights: (0..=radius).map(|k| (weight(k) / sum) as f32).collect() }
    }

    /// Pixels that it reaches to either side.
    pub(super) fn radius(&self) -> usize {
        self.weights.len() - 1
    }
}

/// Buffers of a blur over rows of one width.
pub(super) struct Scratch {
    columns: Vec<f32>,
}

impl Scratch {
    /// For rows of `width` values and kernels up to `radius`.
    pub(super) fn new(width: usize, radius: usize) -> Self {
        Self { columns: vec![0.0; padded(width) + 2 * radius] }
    }
}

/// Writes row `y` of the blurred image to `out`; `source` must hold the rows around it, as far as they exist.
pub(super) fn blur_row(
    isa: Isa,
    kernel: &Kernel,
    source: &Ring,
    (width, height): (usize, usize),
    y: usize,
    scratch: &mut Scratch,
    out: &mut [f32],
) {
    let radius = kernel.radius();
    let pairs: Vec<(&[f32], &[f32])> =
        (1..=radius).map(|k| (source.row(y.saturating_sub(k)), source.row((y + k).min(height - 1)))).collect();
    let columns = &mut scratch.columns[..padded(width) + 2 * radius];
    blur_columns(isa, &kernel.weights, source.row(y), &pairs, &mut columns[radius..radius + padded(width)]);
    extend_border(columns, radius, width);
    blur_along(isa, &kernel.weights, columns, out);
}

/// Repeats the outermost of the `width` values that start at `margin` over all before and after them.
pub(super) fn extend_border(values: &mut [f32], margin: usize, width: usize) {
    let (first, last) = (values[margin], values[margin + width - 1]);
    values[..margin].fill(first);
    values[margin + width..].fill(last);
}

stamp!(
    /// Weighted sum of a row and the pairs of rows around it.
    blur_columns => blur_columns_body(weights: &[f32], center: &[f32], pairs: &[(&[f32], &[f32])], out: &mut [f32])
);

#[inline(always)]
fn blur_columns_body<const FMA: bool>(weights: &[f32], center: &[f32], pairs: &[(&[f32], &[f32])], out: &mut [f32]) {
    for (block, out) in out.chunks_exact_mut(BLOCK).enumerate() {
        let span = block * BLOCK..(block + 1) * BLOCK;
        let mut sum = [0.0_f32; BLOCK];
        for (sum, value) in sum.iter_mut().zip(&center[span.clone()]) {
            *sum = weights[0] * value;
        }
        for (&weight, (above, below)) in weights[1..].iter().zip(pairs) {
            let (above, below) = (&above[span.clone()], &below[span.clone()]);
            for i in 0..BLOCK {
                sum[i] = mul_add::<FMA>(weight, above[i] + below[i], sum[i]);
            }
        }
        out.copy_from_slice(&sum);
    }
}

stamp!(
    /// Convolves `values`, which start and end with a margin of the kernel's radius.
    blur_along => blur_along_body(weights: &[f32], values: &[f32], out: &mut [f32])
);

#[inline(always)]
fn blur_along_body<const FMA: bool>(weights: &[f32], values: &[f32], out: &mut [f32]) {
    let radius = weights.len() - 1;
    for (block, out) in out.chunks_exact_mut(BLOCK).enumerate() {
        let start = block * BLOCK + radius;
        let mut sum = [0.0_f32; BLOCK];
        for (sum, value) in sum.iter_mut().zip(&values[start..start + BLOCK]) {
            *sum = weights[0] * value;
        }
        for (k, &weight) in weights.iter().enumerate().skip(1) {
            let (left, right) = (&values[start - k..start - k + BLOCK], &values[start + k..start + k + BLOCK]);
            for i in 0..BLOCK {
                sum[i] = mul_add::<FMA>(weight, left[i] + right[i], sum[i]);
            }
        }
        out.copy_from_slice(&sum);
    }
}
