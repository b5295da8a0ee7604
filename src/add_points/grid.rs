//! Features near a line by four overlapping grids (paper, section 6.2.1, equations 4 to 9, mended).
//!
//! Cells are squares of side 2h. One grid has its cell corners at multiples of 2h, the other three are shifted by h along
//! x, along y and along both, so every position lies in four cells, with centres
//!
//!   unshifted  x_c = 2h floor(x / 2h) + h            shifted  x_c = 2h floor(x / 2h - 1/2) + 2h
//!
//! and the same for y (the print has d in place of 2h and 2d in place of h: with d = 10 it puts x = 45 into cells around 40
//! and 30 instead of 50 and 40). The centres of all four grids are the points of one lattice of pitch h; a position lies in
//! the cells of the four lattice points around it, and its *centre-most* cell is that of the nearest lattice point.
//!
//! A line is sampled every d (`K = max(1, ceil(length / d))` steps; the print's `length / d` is no integer, and 0 for short
//! chords), and the features of each sample's centre-most cell are gathered.
//!
//! What must h be so that no feature within d of the line is missed? Such a feature is within `sqrt(d^2 + (d/2)^2)` of a
//! sample, the sample within h/2 (in x and in y) of its cell's centre, and the cell reaches h:
//! `sqrt(5)/2 d + h/2 <= h`, so `h >= sqrt(5) d = 2.236 d`. The paper's `h = d` misses 8 % of the band ("in practice a slightly
//! larger grid"), the authors' code has `h = 2 d`, which misses next to nothing.

use nalgebra::Vector2;

use super::epipolar::{BoundingBox, EpipolarLine};

/// Some features binned into four overlapping grids. Features on the border of the image are binned like all others.
#[derive(Clone, Debug)]
pub struct OverlappingGrids {
    bounds: BoundingBox,
    /// h: pitch of the lattice of centres, half the side of a cell.
    pitch_px: f64,
    columns: usize,
    rows: usize,
    /// Cell c holds `features[starts[c]..starts[c + 1]]`.
    starts: Vec<u32>,
    features: Vec<u32>,
}

impl OverlappingGrids {
    /// Bins the features `members` of `positions`, which all lie within `bounds`.
    pub fn new(positions: &[Vector2<f64>], members: &[u32], bounds: BoundingBox, cell_half_size_px: f64) -> Self {
        let size = (bounds.max - bounds.min) / cell_half_size_px;
        let (columns, rows) = (size.x.floor() as usize + 2, size.y.floor() as usize + 2);
        let mut grids = Self {
            bounds,
            pitch_px: cell_half_size_px,
            columns,
            rows,
            starts: vec![0; columns * rows + 1],
            features: vec![0; 4 * members.len()],
        };
        for &member in members {
            for cell in grids.cells_containing(&positions[member as usize]) {
                grids.starts[cell + 1] += 1;
            }
        }
        for cell in 0..columns * rows {
            grids.starts[cell + 1] += grids.starts[cell];
        }
        let mut next = grids.starts.clone();
        for &member in members {
            for cell in grids.cells_containing(&positions[member as usize]) {
                grids.features[next[cell] as usize] = member;
                next[cell] += 1;
            }
        }
        grids
    }

    /// The cells of the four lattice points around a position within the bounds.
    fn cells_containing(&self, at: &Vector2<f64>) -> [usize; 4] {
        let cell = (at - self.bounds.min) / self.pitch_px;
        let (column, row) = (cell.x.floor() as usize, cell.y.floor() as usize);
        let first = row.min(self.rows - 2) * self.columns + column.min(self.columns - 2);
        [first, first + 1, first + self.columns, first + self.columns + 1]
    }

    /// The cell whose centre is nearest to a position.
    fn center_most_cell(&self, at: &Vector2<f64>) -> usize {
        let cell = (at - self.bounds.min) / self.pitch_px;
        // Conversion drops the fraction, so adding a half first rounds.
        let (column, row) = ((cell.x + 0.5).max(0.0) as usize, (cell.y + 0.5).max(0.0) as usize);
        row.min(self.rows - 1) * self.columns + column.min(self.columns - 1)
    }

    /// Calls `found` for the features in the centre-most cells of samples at most `spacing_px` apart along the line; for some
    /// of them more than once.
    pub fn visit(&self, line: &EpipolarLine, spacing_px: f64, mut found: impl FnMut(u32)) {
        let Some([enter, leave]) = self.bounds.grown(spacing_px).clip(line) else { return };
        let steps = ((leave - enter).norm() / spacing_px).ceil().max(1.0);
        let step = (leave - enter) / steps;
        let mut last = None;
        for k in 0..=steps as usize {
            let cell = self.center_most_cell(&(enter + step * k as f64));
            if last == Some(cell) {
                continue;
            }
            last = Some(cell);
            let range = self.starts[cell] as usize..self.starts[cell + 1] as usize;
            self.features[range].iter().for_each(|&feature| found(feature));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cells_are_those_of_the_corrected_formulas() {
        let h = 10.0;
        let bounds = BoundingBox { min: Vector2::zeros(), max: Vector2::new(200.0, 200.0) };
        for x in [0.0, 3.0, 10.0, 45.0, 137.5, 200.0] {
            let at = Vector2::new(x, 26.0);
            let grids = OverlappingGrids::new(&[at], &[0], bounds, h);
            let mut centers: Vec<f64> =
                grids.cells_containing(&at)[..2].iter().map(|cell| (cell % grids.columns) as f64 * h).collect();
            let unshifted = 2.0 * h * (x / (2.0 * h)).floor() + h;
            let shifted = 2.0 * h * (x / (2.0 * h) - 0.5).floor() + 2.0 * h;
            centers.sort_by(f64::total_cmp);
            assert_eq!(centers, [unshifted.min(shifted), unshifted.max(shifted)], "x = {x}");
        }
    }
}
