//! Separable Gaussian blur of a few rows: first down the columns of the source rows around them, then along the result.
//! Beyond the border the image goes on with its outermost pixels.

use super::ring::{BLOCK, Ring, padded};
use super::simd::{Isa, mul_add, stamp};

/// Kernels are cut off at this many sigmas, where a Gaussian has fallen to a hundredth of its peak. What is cut off is a 370th
/// of all; that it is the part farthest out, a widening of what is left makes good.
const CUTOFF_SIGMAS: f64 = 3.0;
/// Steps of the widening, each of which leaves an error ten times smaller.
const WIDENINGS: usize = 8;

/// A symmetric, normalised Gaussian kernel.
pub(super) struct Kernel {
    /// All weights from one end to the other.
    weights: Vec<f32>,
}

/// Rows made together.
pub(super) const BATCH: usize = 4;

impl Kernel {
    /// The kernel of this sigma in pixels.
    pub(super) fn gaussian(sigma: f32) -> Self {
        let sigma = f64::from(sigma);
        let radius = (CUTOFF_SIGMAS * sigma).ceil().max(1.0) as usize;
        let weight_of = |k: usize, sigma: f64| (-0.5 * (k as f64 / sigma).powi(2)).exp();
        let sum_of = |sigma: f64| weight_of(0, sigma) + 2.0 * (1..=radius).map(|k| weight_of(k, sigma)).sum::<f64>();
        let variance_of =
            |of: f64| 2.0 * (1..=radius).map(|k| (k * k) as f64 * weight_of(k, of)).sum::<f64>() / sum_of(of);
        let widened = (0..WIDENINGS).fold(sigma, |widened, _| widened * sigma / variance_of(widened).sqrt());
        let (weight, sum) = (|k: usize| weight_of(k, widened), sum_of(widened));
        Self { weights: (0..=2 * radius).map(|k| (weight(k.abs_diff(radius)) / sum) as f32).collect() }
    }

    /// Pixels that it reaches to either side.
    pub(super) fn radius(&self) -> usize {
        self.weights.len() / 2
    }

    /// The weight of the centre, then of its neighbours outwards.
    fn half(&self) -> &[f32] {
        &self.weights[self.radius()..]
    }
}

/// Buffers of a blur over rows of one width.
pub(super) struct Scratch {
    columns: [Vec<f32>; BATCH],
}

impl Scratch {
    /// For rows of `width` values and kernels up to `radius`.
    pub(super) fn new(width: usize, radius: usize) -> Self {
        Self { columns: std::array::from_fn(|_| vec![0.0; padded(width) + 2 * radius]) }
    }
}

/// Writes rows `y..` of the blurred image to `outs`, at most [`BATCH`] of them; `source` must hold the rows around them, as
/// far as they exist.
///
/// Down the columns, the rows of a wide image do not fit the first-level cache, and one output row alone would be limited by
/// the second level's bandwidth: `2 radius + 1` loads for as many multiplications. So each value loaded serves `BATCH` output
/// rows, whose sums stay in registers, and arithmetic is the limit.
pub(super) fn blur_rows(
    isa: Isa,
    kernel: &Kernel,
    source: &Ring,
    (width, height): (usize, usize),
    y: usize,
    scratch: &mut Scratch,
    outs: &mut [&mut [f32]],
) {
    let radius = kernel.radius();
    // Where fewer rows are left, those beyond the last are made for nothing.
    let around: Vec<&[f32]> =
        (0..2 * radius + BATCH).map(|at| source.row((y + at).saturating_sub(radius).min(height - 1))).collect();
    let stride = padded(width) + 2 * radius;
    let mut columns: [&mut [f32]; BATCH] = scratch.columns.each_mut().map(|columns| &mut columns[..stride]);
    {
        let targets = columns.each_mut().map(|columns| &mut columns[radius..radius + padded(width)]);
        blur_columns(isa, &kernel.weights, &around, targets);
    }
    for (columns, out) in columns.iter_mut().zip(outs) {
        extend_border(columns, radius, width);
        blur_along(isa, kernel.half(), columns, out);
    }
}

/// Repeats the outermost of the `width` values that start at `margin` over all before and after them.
pub(super) fn extend_border(values: &mut [f32], margin: usize, width: usize) {
    let (first, last) = (values[margin], values[margin + width - 1]);
    values[..margin].fill(first);
    values[margin + width..].fill(last);
}

/// Weighted sums of the rows `around` each of the rows `outs`. The first rows add to the first sums alone, the last ones to
/// the last, and all between them to every sum.
///
/// The sums of a piece of the rows must fit the registers beside the values loaded: 32 registers of 16 floats hold
/// pieces of 32, 16 registers of 8 floats pieces of 16 (with 32 the compiler stores and loads sums within the loop, at
/// twice the time).
fn blur_columns(isa: Isa, weights: &[f32], around: &[&[f32]], outs: [&mut [f32]; BATCH]) {
    if isa.has_many_registers() {
        blur_columns_wide(isa, weights, around, outs);
    } else {
        blur_columns_narrow(isa, weights, around, outs);
    }
}

stamp!(
    /// [`blur_columns`] in pieces of 32.
    blur_columns_wide => blur_columns_wide_body(weights: &[f32], around: &[&[f32]], outs: [&mut [f32]; BATCH])
);

stamp!(
    /// [`blur_columns`] in pieces of 16.
    blur_columns_narrow => blur_columns_narrow_body(weights: &[f32], around: &[&[f32]], outs: [&mut [f32]; BATCH])
);

#[inline(always)]
fn blur_columns_wide_body<const FMA: bool>(weights: &[f32], around: &[&[f32]], outs: [&mut [f32]; BATCH]) {
    blur_columns_body::<FMA, BLOCK>(weights, around, outs);
}

#[inline(always)]
fn blur_columns_narrow_body<const FMA: bool>(weights: &[f32], around: &[&[f32]], outs: [&mut [f32]; BATCH]) {
    blur_columns_body::<FMA, { BLOCK / 2 }>(weights, around, outs);
}

#[inline(always)]
fn blur_columns_body<const FMA: bool, const PIECE: usize>(
    weights: &[f32],
    around: &[&[f32]],
    outs: [&mut [f32]; BATCH],
) {
    let taps = weights.len();
    assert!(taps >= BATCH - 1 && around.len() == taps + BATCH - 1, "a kernel has three weights or more");
    let [out_0, out_1, out_2, out_3] = outs.map(|out| out.as_chunks_mut::<PIECE>().0);
    let pieces = out_0.iter_mut().zip(out_1).zip(out_2).zip(out_3).enumerate();
    for (at, (((out_0, out_1), out_2), out_3)) in pieces {
        // Four arrays by name, not an array of arrays: the compiler keeps only these in registers.
        let (mut sum_0, mut sum_1) = ([0.0_f32; PIECE], [0.0_f32; PIECE]);
        let (mut sum_2, mut sum_3) = ([0.0_f32; PIECE], [0.0_f32; PIECE]);
        let piece = |row: usize| &around[row].as_chunks::<PIECE>().0[at];
        add_weighted::<FMA, PIECE>(weights[0], piece(0), &mut sum_0);
        add_weighted::<FMA, PIECE>(weights[1], piece(1), &mut sum_0);
        add_weighted::<FMA, PIECE>(weights[0], piece(1), &mut sum_1);
        add_weighted::<FMA, PIECE>(weights[2], piece(2), &mut sum_0);
        add_weighted::<FMA, PIECE>(weights[1], piece(2), &mut sum_1);
        add_weighted::<FMA, PIECE>(weights[0], piece(2), &mut sum_2);
        for (row, weights) in around[BATCH - 1..taps].iter().zip(weights.windows(BATCH)) {
            let row = &row.as_chunks::<PIECE>().0[at];
            add_weighted::<FMA, PIECE>(weights[3], row, &mut sum_0);
            add_weighted::<FMA, PIECE>(weights[2], row, &mut sum_1);
            add_weighted::<FMA, PIECE>(weights[1], row, &mut sum_2);
            add_weighted::<FMA, PIECE>(weights[0], row, &mut sum_3);
        }
        add_weighted::<FMA, PIECE>(weights[taps - 1], piece(taps), &mut sum_1);
        add_weighted::<FMA, PIECE>(weights[taps - 2], piece(taps), &mut sum_2);
        add_weighted::<FMA, PIECE>(weights[taps - 3], piece(taps), &mut sum_3);
        add_weighted::<FMA, PIECE>(weights[taps - 1], piece(taps + 1), &mut sum_2);
        add_weighted::<FMA, PIECE>(weights[taps - 2], piece(taps + 1), &mut sum_3);
        add_weighted::<FMA, PIECE>(weights[taps - 1], piece(taps + 2), &mut sum_3);
        (*out_0, *out_1, *out_2, *out_3) = (sum_0, sum_1, sum_2, sum_3);
    }
}

/// Adds the weighted values to the sums.
#[inline(always)]
fn add_weighted<const FMA: bool, const PIECE: usize>(weight: f32, values: &[f32; PIECE], sums: &mut [f32; PIECE]) {
    for i in 0..PIECE {
        sums[i] = mul_add::<FMA>(weight, values[i], sums[i]);
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn kernels_have_the_variance_of_their_gaussian() {
        for sigma in [0.6_f32, 0.92, 1.16, 1.46, 1.84, 2.31, 4.0] {
            let weights = Kernel::gaussian(sigma).weights;
            let middle = (weights.len() / 2) as f64;
            let sum: f64 = weights.iter().map(|&weight| f64::from(weight)).sum();
            let variance: f64 =
                weights.iter().enumerate().map(|(k, &weight)| (k as f64 - middle).powi(2) * f64::from(weight)).sum();
            assert!((sum - 1.0).abs() < 1e-6 && (variance.sqrt() - f64::from(sigma)).abs() < 1e-5, "{sigma}");
        }
    }

    /// All rows of a picture, the last batch of which is not full, against the sums of the definition.
    #[test]
    fn rows_are_those_of_the_definition() {
        let (width, height, kernel) = (53_usize, 22_usize, Kernel::gaussian(1.5));
        let (radius, mut rng) = (kernel.radius(), Rng::from_parts(&[8]));
        let mut source = Ring::new(width, height);
        for _ in 0..height {
            source.push()[..width].fill_with(|| rng.uniform() as f32);
        }
        let clamped = |at: usize, length: usize| at.saturating_sub(radius).min(length - 1);
        let weighted = |of: &dyn Fn(usize) -> f64| -> f64 {
            kernel.weights.iter().enumerate().map(|(k, &weight)| f64::from(weight) * of(k)).sum()
        };
        for isa in Isa::available() {
            let mut scratch = Scratch::new(width, radius);
            for y in (0..height).step_by(BATCH) {
                let mut blurred = vec![vec![0.0_f32; padded(width)]; BATCH.min(height - y)];
                let mut outs: Vec<&mut [f32]> = blurred.iter_mut().map(|row| &mut row[..]).collect();
                blur_rows(isa, &kernel, &source, (width, height), y, &mut scratch, &mut outs);
                for (row, blurred) in blurred.iter().enumerate() {
                    for (x, &found) in blurred[..width].iter().enumerate() {
                        let down =
                            |column: usize| weighted(&|k| f64::from(source.row(clamped(y + row + k, height))[column]));
                        let wanted = weighted(&|k| down(clamped(x + k, width)));
                        assert!((f64::from(found) - wanted).abs() < 1e-5, "{isa:?} ({x}, {}): {found}", y + row);
                    }
                }
            }
        }
    }
}
