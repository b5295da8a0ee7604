//! The gradients of a level that descriptors are made of.
//!
//! Neighbouring keypoints' patches overlap, so a level's gradients are computed once, row by row, while its rows are still in
//! the first-level cache. Only every second row and column is kept: what a Gaussian of more than a pixel leaves of an image
//! turns so slowly that the pixels between tell next to nothing, and a descriptor's bin is still two or more of those wide.
//! Length and direction share 32 bits, so a patch of a wide image is read from a few dozen cache lines, where the pixels
//! themselves, with the rows above and below, took two hundred: fetching these was five times the arithmetic.

use std::f32::consts::TAU;

use super::gradient::direction_of;
use super::ring::Ring;
use super::simd::{Isa, stamp, whole_number};

/// Rows and columns from one gradient to the next.
pub(super) const STEP: usize = 2;
/// Steps of direction in a full turn.
pub(super) const TURN: u32 = 1 << 16;
/// The bits of a gradient that hold its length, as the upper half of an `f32`.
const LENGTH_BITS: u32 = 0xffff_0000;

/// A gradient: its length in the upper half, rounded to eight binary digits, its direction from +x to +y in the lower, in
/// parts of a turn.
pub(super) type Gradient = u32;

/// The length of a gradient.
#[inline(always)]
pub(super) fn length(gradient: Gradient) -> f32 {
    f32::from_bits(gradient & LENGTH_BITS)
}

/// The direction of a gradient, of 2^32 to a turn.
#[inline(always)]
pub(super) fn direction(gradient: Gradient) -> u32 {
    gradient << 16
}

/// The last rows of gradients of a level, of every second row and column: the gradient in column c of row r is that of pixel
/// 2 c of row 2 r. On the border there are none, and what is stored there means nothing.
pub(super) struct GradientMap {
    rows: Ring<Gradient>,
}

impl GradientMap {
    /// An empty map of a level of `width` columns, that holds the gradients of `reach` rows of it.
    pub(super) fn new(width: usize, reach: usize) -> Self {
        Self { rows: Ring::new(width.div_ceil(STEP), reach.div_ceil(STEP) + 1) }
    }

    /// Adds the gradients of all rows of the level that have a row below them.
    pub(super) fn follow(&mut self, isa: Isa, level: &Ring) {
        while STEP * self.rows.next() + 1 < level.next() {
            let y = STEP * self.rows.next();
            let row = self.rows.push();
            if y > 0 {
                gradients(isa, level.row(y - 1), level.row(y + 1), level.row(y), row);
            }
        }
    }

    /// The rows up to `radius_px` from the pixel row `y`.
    pub(super) fn around(&self, y: f32, radius_px: f32) -> Rows<'_> {
        let first = ((y - radius_px).max(0.0) / STEP as f32) as usize;
        let (data, stride, capacity) = self.rows.stored();
        let (stride, capacity) = (stride as u32, capacity as u32);
        Rows { data, stride, capacity, before: first as u32 / capacity * capacity }
    }
}

/// Some rows of a gradient map, no more than it holds.
pub(super) struct Rows<'a> {
    data: &'a [Gradient],
    stride: u32,
    capacity: u32,
    /// Rows before the last one at or above these that lies at the start of the ring.
    before: u32,
}

impl Rows<'_> {
    /// Where the gradient of a row and a column is stored.
    #[inline(always)]
    pub(super) fn index(&self, row: u32, column: u32) -> u32 {
        let row = row.wrapping_sub(self.before);
        // One round of the ring is taken off where there is one: without, the difference is beyond all rows.
        row.min(row.wrapping_sub(self.capacity)) * self.stride + column
    }

    /// The gradient stored there.
    #[inline(always)]
    pub(super) fn at(&self, index: u32) -> Gradient {
        self.data[index as usize]
    }
}

stamp!(
    /// The gradients of a row's even pixels by central differences.
    gradients => gradients_body(above: &[f32], below: &[f32], row: &[f32], out: &mut [Gradient])
);

#[inline(always)]
fn gradients_body<const FMA: bool>(above: &[f32], below: &[f32], row: &[f32], out: &mut [Gradient]) {
    // One flat loop over pairs of pixels: only so does the compiler load whole registers and take them apart in one step.
    let (above, below, row) = (above.as_chunks::<STEP>().0, below.as_chunks::<STEP>().0, row.as_chunks::<STEP>().0);
    let count = row.len();
    let (above, below, out) = (&above[1..count], &below[1..count], &mut out[1..count]);
    for i in 0..count - 1 {
        let (x, y) = (row[i + 1][1] - row[i][1], below[i][0] - above[i][0]);
        let length = (x * x + y * y).sqrt();
        let direction = direction_of::<FMA>(x, y) * (TURN as f32 / TAU);
        // Both are rounded to the nearest; a whole turn is none.
        out[i] = (length.to_bits() + 0x8000) & LENGTH_BITS | whole_number(direction) & (TURN - 1);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    #[test]
    fn gradients_are_those_of_the_even_pixels() {
        let (width, height) = (77, 24);
        let mut rng = Rng::from_parts(&[11]);
        let pixels: Vec<Vec<f32>> = (0..height).map(|_| (0..width).map(|_| rng.uniform() as f32).collect()).collect();
        for isa in Isa::available() {
            let (mut level, mut map) = (Ring::new(width, 9), GradientMap::new(width, 9));
            for (y, row) in pixels.iter().enumerate() {
                level.push()[..width].copy_from_slice(row);
                // Some rows at a time, as an octave makes them.
                if y % 3 < 2 {
                    continue;
                }
                map.follow(isa, &level);
                for even in (2..y).step_by(STEP).rev().take(3) {
                    for x in (2..width - 1).step_by(STEP) {
                        let dx = pixels[even][x + 1] - pixels[even][x - 1];
                        let dy = pixels[even + 1][x] - pixels[even - 1][x];
                        let rows = map.around(even as f32, 4.0);
                        let found = rows.at(rows.index((even / STEP) as u32, (x / STEP) as u32));
                        let off = (length(found) / dx.hypot(dy) - 1.0).abs();
                        assert!(off < 1.0 / 256.0, "length of {x}, {even} is off by {off}");
                        let turn = TAU / TURN as f32;
                        let off = ((found & (TURN - 1)) as f32 * turn - dy.atan2(dx)).rem_euclid(TAU);
                        assert!(off.min(TAU - off) < turn, "direction of {x}, {even} is off by {off}");
                    }
                }
            }
        }
    }
}
