//! Features near a line by strips: the exact and faster alternative to the paper's overlapping grids.
//!
//! The image is cut into strips across the line's major direction. Within a strip the band around the line spans an
//! interval, and as a strip's features are stored in order of small cells along it, the features of that interval are one
//! piece of memory: every feature near the band is looked at once, none is missed, no sampling is needed, and there are no
//! duplicates to weed out. Lines nearer to x than to y walk upright strips, the others lying ones, so there are two copies.

use nalgebra::Vector2;

use super::epipolar::{BoundingBox, EpipolarLine};

/// Some features in upright and in lying strips.
#[derive(Clone, Debug)]
pub struct Strips {
    bounds: BoundingBox,
    /// Strips across x and across y.
    across: [StripsAcross; 2],
}

/// Strips across one axis (the *major* one); cells run along the other (*minor*) one.
#[derive(Clone, Debug)]
struct StripsAcross {
    strips: usize,
    cells: usize,
    /// Cell c of strip s holds `features[starts[s * cells + c]..starts[s * cells + c + 1]]`.
    starts: Vec<u32>,
    features: Vec<(u32, Vector2<f64>)>,
    strip_px: f64,
    cell_px: f64,
}

/// Width of a strip in bands: narrower ones follow the line more closely, wider ones are fewer.
const STRIP_BANDS: f64 = 6.0;
/// Length of a cell in bands: what is looked at in vain at both ends of an interval.
const CELL_BANDS: f64 = 1.0;

impl Strips {
    /// Of the features `members` of `positions`, which all lie within `bounds`, for bands of a half-width.
    pub fn new(positions: &[Vector2<f64>], members: &[u32], bounds: BoundingBox, band_px: f64) -> Self {
        let across = [0, 1].map(|major| StripsAcross::new(major, positions, members, &bounds, band_px));
        Self { bounds, across }
    }

    /// Calls `found` for the features within a distance of a line, each once.
    pub fn visit(&self, line: &EpipolarLine, distance_px: f64, mut found: impl FnMut(u32)) {
        let Some([enter, leave]) = self.bounds.grown(distance_px).clip(line) else { return };
        let along = line.direction();
        let major = usize::from(along.x.abs() < along.y.abs());
        let strips = &self.across[major];
        let minor = 1 - major;
        let (origin, slope) = (self.bounds.min, along[minor] / along[major]);
        let half_interval_px = distance_px / along[major].abs();
        let strip_of = |major_px: f64| ((major_px - origin[major]) / strips.strip_px).max(0.0) as usize;
        let cell_of = |minor_px: f64| ((minor_px - origin[minor]) / strips.cell_px).max(0.0) as usize;
        let first = strip_of(enter[major].min(leave[major]) - distance_px);
        let last = strip_of(enter[major].max(leave[major]) + distance_px).min(strips.strips - 1);
        for strip in first..=last {
            let at =
                |edge: usize| enter[minor] + slope * (origin[major] + edge as f64 * strips.strip_px - enter[major]);
            let (a, b) = (at(strip), at(strip + 1));
            let (low, high) = (a.min(b) - half_interval_px, a.max(b) + half_interval_px);
            if high < origin[minor] {
                continue;
            }
            let (low, high) = (cell_of(low).min(strips.cells - 1), cell_of(high).min(strips.cells - 1));
            let row = strip * strips.cells;
            let range = strips.starts[row + low] as usize..strips.starts[row + high + 1] as usize;
            for (feature, position) in &strips.features[range] {
                if line.distance_px(position) <= distance_px {
                    found(*feature);
                }
            }
        }
    }
}

impl StripsAcross {
    fn new(major: usize, positions: &[Vector2<f64>], members: &[u32], bounds: &BoundingBox, band_px: f64) -> Self {
        let (strip_px, cell_px) = (STRIP_BANDS * band_px, CELL_BANDS * band_px);
        let size = bounds.max - bounds.min;
        let strips = (size[major] / strip_px) as usize + 1;
        let cells = (size[1 - major] / cell_px) as usize + 1;
        let cell_of = |feature: u32| {
            let offset = positions[feature as usize] - bounds.min;
            (offset[major] / strip_px) as usize * cells + (offset[1 - major] / cell_px) as usize
        };
        let mut features: Vec<(usize, u32)> = members.iter().map(|&feature| (cell_of(feature), feature)).collect();
        features.sort_unstable();
        let mut starts = vec![0; strips * cells + 1];
        for &(cell, _) in &features {
            starts[cell + 1] += 1;
        }
        for cell in 0..strips * cells {
            starts[cell + 1] += starts[cell];
        }
        let features = features.into_iter().map(|(_, feature)| (feature, positions[feature as usize])).collect();
        Self { strips, cells, starts, features, strip_px, cell_px }
    }
}
