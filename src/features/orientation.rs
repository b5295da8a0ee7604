//! Dominant gradient directions around an extremum (Lowe 2004, section 5).

use std::f32::consts::TAU;

use super::gradient::Patch;
use super::ring::Ring;
use super::simd::Isa;

/// Bins of the histogram over the full turn.
const BINS: usize = 36;
/// Sigma of the Gaussian window, in sigmas of the keypoint.
const WINDOW_SIGMAS: f32 = 1.5;
/// The window is cut off at this many of its own sigmas.
const CUTOFF: f32 = 3.0;
/// Peaks of at least this part of the highest give further orientations.
const PEAK_PART: f32 = 0.8;
/// Passes of the smoothing filter (1 4 6 4 1) / 16 over the histogram.
const SMOOTHINGS: usize = 1;

/// The orientations in [0, 2 pi) of the highest peaks, highest first, at most `most`.
pub(super) fn find(
    isa: Isa,
    ring: &Ring,
    (width, height): (usize, usize),
    (x, y): (f32, f32),
    sigma: f32,
    most: usize,
    patch: &mut Patch,
) -> Vec<f32> {
    let window = WINDOW_SIGMAS * sigma;
    let radius = CUTOFF * window;
    let falloff = -0.5 / (window * window);
    // One bin more takes what the last shares with the first.
    let mut histogram = [0.0_f32; BINS + 1];
    let (top, bottom) = clip(y, radius, height);
    let (from, to) = clip(x, radius, width);
    patch.set_window(x, falloff, from, to);
    for row in top..bottom {
        let dy = row as f32 - y;
        let half = (radius * radius - dy * dy).max(0.0).sqrt();
        let (left, right) = clip(x, half, width);
        if left >= right {
            continue;
        }
        patch.fill(isa, ring, row, left, right, (falloff * dy * dy).exp());
        for (weight, direction) in patch.weight.iter().zip(&patch.direction).take(right - left) {
            let place = direction * (BINS as f32 / TAU);
            let bin = (place as usize).min(BINS - 1);
            let part = weight * (place - bin as f32);
            histogram[bin] += weight - part;
            histogram[bin + 1] += part;
        }
    }
    histogram[0] += histogram[BINS];
    let mut histogram: [f32; BINS] = std::array::from_fn(|i| histogram[i]);
    for _ in 0..SMOOTHINGS {
        let at = |i: usize| histogram[i % BINS];
        histogram = std::array::from_fn(|i| {
            (6.0 * at(i) + 4.0 * (at(i + 1) + at(i + BINS - 1)) + at(i + 2) + at(i + BINS - 2)) / 16.0
        });
    }
    peaks(&histogram, most)
}

/// The whole pixels within `radius` of `center` that are not on the border, as a half-open range.
pub(super) fn clip(center: f32, radius: f32, length: usize) -> (usize, usize) {
    let from = (center - radius).ceil().max(1.0) as usize;
    let to = ((center + radius).floor() + 1.0).clamp(0.0, (length - 1) as f32) as usize;
    (from, to)
}

/// The directions of the peaks, by a parabola through each and its neighbours.
fn peaks(histogram: &[f32; BINS], most: usize) -> Vec<f32> {
    let highest = histogram.iter().fold(0.0_f32, |a, &b| a.max(b));
    let mut found: Vec<(f32, f32)> = Vec::new();
    for (bin, &value) in histogram.iter().enumerate() {
        let (before, after) = (histogram[(bin + BINS - 1) % BINS], histogram[(bin + 1) % BINS]);
        if value > before && value >= after && value >= PEAK_PART * highest {
            let shift = 0.5 * (before - after) / (before - 2.0 * value + after);
            let angle = (bin as f32 + shift) * (TAU / BINS as f32);
            let angle = if angle < 0.0 { angle + TAU } else { angle };
            found.push((value, if angle >= TAU { 0.0 } else { angle }));
        }
    }
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    found.truncate(most);
    found.into_iter().map(|(_, angle)| angle).collect()
}
