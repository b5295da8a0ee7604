//! Foretells the scale below which nothing of the finest octave will be kept, while that octave is still being searched.
//!
//! The cap keeps the features of the largest scales, so which of the finest octave's belong to them is known only at its end,
//! and describing all of them meanwhile takes up to twice the time. But how the features spread over the rows is known
//! beforehand, from the coarser octaves: with the share F(y) of these above row y, and n(c) extrema of at least scale c seen
//! down to row y, about n(c) / F(y) will be seen in all. The largest c that promises more than enough is taken for the limit.
//! A forecast is never trusted: when too few features were kept in the end, the octave is searched again without it, so
//! what is kept does not depend on forecasts.

use std::collections::BTreeMap;

use crate::scene::Keypoint;

/// Features promised for each one that is kept: room for errors of the forecast.
const MARGIN: f32 = 1.15;
/// The forecast starts when the coarser octaves have this share of their features above.
const MIN_SHARE: f32 = 0.05;
/// Rows, in pixels of the octave, between two forecasts.
const INTERVAL: usize = 32;
/// Low bits of a scale that are left out to sort scales into bins: 64 bins an octave are left.
const BIN_SHIFT: u32 = 17;

/// See the module.
pub(super) struct Forecast {
    wanted: f32,
    /// Rows of the coarser octaves' features in original pixels, ascending.
    rows_px: Vec<f32>,
    /// Their scales, ascending.
    scales: Vec<f32>,
    /// Extrema seen so far, by the bin of their scale.
    seen: BTreeMap<u32, usize>,
    limit: f32,
    highest_limit: f32,
}

impl Forecast {
    /// From the features of the coarser octaves, when `wanted` features will be kept in all.
    pub(super) fn new(coarser: impl Iterator<Item = Keypoint>, wanted: usize) -> Self {
        let (mut rows_px, mut scales): (Vec<f32>, Vec<f32>) = coarser.map(|found| (found.y, found.scale)).unzip();
        rows_px.sort_by(f32::total_cmp);
        scales.sort_by(f32::total_cmp);
        let wanted = MARGIN * wanted as f32;
        Self { wanted, rows_px, scales, seen: BTreeMap::new(), limit: 0.0, highest_limit: 0.0 }
    }

    /// Counts an extremum of this scale; whether it is worth describing.
    pub(super) fn wants(&mut self, scale: f32) -> bool {
        *self.seen.entry(scale.to_bits() >> BIN_SHIFT).or_insert(0) += 1;
        scale >= self.limit
    }

    /// Row `y` of the octave, whose pixels are `step_px` original ones, is done.
    pub(super) fn finish_row(&mut self, y: usize, step_px: f32) {
        if !y.is_multiple_of(INTERVAL) || self.rows_px.is_empty() {
            return;
        }
        let above = self.rows_px.partition_point(|&row| row < y as f32 * step_px);
        let share = above as f32 / self.rows_px.len() as f32;
        self.limit = if share < MIN_SHARE { 0.0 } else { self.promising(share) };
        self.highest_limit = self.highest_limit.max(self.limit);
    }

    /// The largest scale from which on enough features are promised; 0 when there is none.
    fn promising(&self, share: f32) -> f32 {
        let mut seen = 0;
        for (bin, count) in self.seen.iter().rev() {
            seen += count;
            let scale = f32::from_bits(bin << BIN_SHIFT);
            let coarser = self.scales.len() - self.scales.partition_point(|&other| other < scale);
            if coarser as f32 + seen as f32 / share >= self.wanted {
                return scale;
            }
        }
        0.0
    }

    /// Everything from this scale on was described.
    pub(super) fn complete_from(&self) -> f32 {
        self.highest_limit
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keypoint(y: f32, scale: f32) -> Keypoint {
        Keypoint { x: 0.0, y, scale, orientation: 0.0 }
    }

    #[test]
    fn the_limit_leaves_the_promised_number() {
        // 100 coarser features spread evenly; the octave has ten extrema a row, of scales from 1 to 2.
        let coarser = (0..100).map(|i| keypoint(i as f32, 3.0));
        let mut forecast = Forecast::new(coarser, 500);
        let mut wanted = 0;
        for y in 0..200 {
            for i in 0..10 {
                let scale = 1.0 + 0.1 * i as f32 + 0.0004 * y as f32;
                wanted += usize::from(forecast.wants(scale));
            }
            forecast.finish_row(y, 0.5);
        }
        // All 320 down to the first forecast, then the three of each row that make the 475 promised with the margin.
        assert!((320 + 2 * 168..320 + 4 * 168).contains(&wanted), "{wanted}");
        assert!((1.6..1.9).contains(&forecast.complete_from()), "{}", forecast.complete_from());
    }

    #[test]
    fn nothing_is_refused_while_little_is_known() {
        let mut none = Forecast::new(std::iter::empty(), 1);
        let mut late = Forecast::new((0..50).map(|i| keypoint(90.0 + 0.1 * i as f32, 3.0)), 60);
        for y in 0..160 {
            assert!(none.wants(1.0) && late.wants(1.0), "row {y}");
            none.finish_row(y, 0.5);
            late.finish_row(y, 0.5);
        }
        assert_eq!((none.complete_from(), late.complete_from()), (0.0, 0.0));
    }
}
