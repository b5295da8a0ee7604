//! Foretells the scale below which nothing of the finest octave will be kept, while that octave is still being searched.
//!
//! The cap keeps the features of the largest scales, so which of the finest octave's belong to them is known only at its end,
//! and describing all of them meanwhile takes up to twice the time. But how the features spread over the rows is known
//! beforehand, from the coarser octaves: with the share F(y) of these above row y, and n(c) extrema of at least scale c seen
//! down to row y, about n(c) / F(y) will be seen in all. The largest c that promises more than enough is taken for the limit.
//! A forecast is not trusted: when far too few features were kept in the end, the octave is searched again without it. Where
//! a few are missing (of 191 photographs three missed up to 5 %), those of smaller scale that were found before the limit rose
//! take their places, as another search for the last few costs three quarters of a photograph's time.
//!
//! Distinct and faint features (`collector`) have a limit each. The faint ones' follows from what they must make up: the number
//! they fill less the distinct ones promised; where those promise it all, faint extrema are not even sought.

use std::collections::BTreeMap;

use super::collector::Class;
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
    /// Features described for those kept: the distinct ones, and both together where faint ones make up a number.
    wanted: [f32; 2],
    /// Rows of the coarser octaves' features in original pixels, ascending.
    rows_px: Vec<f32>,
    /// What is known of each class.
    classes: [ClassSoFar; 2],
}

/// What is known of the features of a class.
struct ClassSoFar {
    /// Scales in the coarser octaves, ascending.
    scales: Vec<f32>,
    /// Extrema seen so far, by the bin of their scale.
    seen: BTreeMap<u32, usize>,
    limit: f32,
    highest_limit: f32,
}

impl Forecast {
    /// From the features of the coarser octaves, when `limit` distinct features will be kept in all, and with faint ones
    /// `faint_up_to`.
    pub(super) fn new<I: Iterator<Item = Keypoint>>(
        coarser: impl Fn(Class) -> I,
        limit: usize,
        faint_up_to: usize,
    ) -> Self {
        let mut rows_px: Vec<f32> = Vec::new();
        let classes = [Class::Distinct, Class::Faint].map(|class| {
            let mut scales: Vec<f32> = Vec::new();
            for found in coarser(class) {
                rows_px.push(found.y);
                scales.push(found.scale);
            }
            scales.sort_by(f32::total_cmp);
            ClassSoFar { scales, seen: BTreeMap::new(), limit: 0.0, highest_limit: 0.0 }
        });
        rows_px.sort_by(f32::total_cmp);
        Self { wanted: [limit, faint_up_to].map(|wanted| MARGIN * wanted as f32), rows_px, classes }
    }

    /// Counts an extremum of this scale; whether it is worth describing.
    pub(super) fn wants(&mut self, class: Class, scale: f32) -> bool {
        let so_far = &mut self.classes[class as usize];
        *so_far.seen.entry(scale.to_bits() >> BIN_SHIFT).or_insert(0) += 1;
        scale >= so_far.limit
    }

    /// Whether distinct features alone don't promise all that will be kept.
    pub(super) fn has_room_for_faint(&self) -> bool {
        self.classes[Class::Faint as usize].limit < f32::INFINITY
    }

    /// Row `y` of the octave, whose pixels are `step_px` original ones, is done.
    pub(super) fn finish_row(&mut self, y: usize, step_px: f32) {
        if !y.is_multiple_of(INTERVAL) || self.rows_px.is_empty() {
            return;
        }
        let above = self.rows_px.partition_point(|&row| row < y as f32 * step_px);
        let share = above as f32 / self.rows_px.len() as f32;
        if share < MIN_SHARE {
            return;
        }
        let [distinct, faint] = &mut self.classes;
        distinct.set_limit(share, self.wanted[Class::Distinct as usize]);
        faint.set_limit(share, self.wanted[Class::Faint as usize] - distinct.promised(share));
    }

    /// Whether the limits have been above this scale, so that smaller ones are not counted on any more.
    pub(super) fn has_passed(&self, scale: f32) -> bool {
        self.classes.iter().all(|so_far| so_far.highest_limit >= scale)
    }

    /// Everything of a class from this scale on was described.
    pub(super) fn complete_from(&self, class: Class) -> f32 {
        self.classes[class as usize].highest_limit
    }
}

impl ClassSoFar {
    /// The number there will be in all.
    fn promised(&self, share: f32) -> f32 {
        self.scales.len() as f32 + self.seen.values().sum::<usize>() as f32 / share
    }

    /// The limit becomes the largest scale from which on `wanted` are promised; 0 when there is none.
    fn set_limit(&mut self, share: f32, wanted: f32) {
        self.limit = if wanted <= 0.0 { f32::INFINITY } else { self.promising(share, wanted) };
        self.highest_limit = self.highest_limit.max(self.limit);
    }

    fn promising(&self, share: f32, wanted: f32) -> f32 {
        let mut seen = 0;
        for (bin, count) in self.seen.iter().rev() {
            seen += count;
            let scale = f32::from_bits(bin << BIN_SHIFT);
            let coarser = self.scales.len() - self.scales.partition_point(|&other| other < scale);
            if coarser as f32 + seen as f32 / share >= wanted {
                return scale;
            }
        }
        0.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn keypoint(y: f32, scale: f32) -> Keypoint {
        Keypoint { x: 0.0, y, scale, orientation: 0.0 }
    }

    /// Coarser octaves with distinct features only.
    fn distinct(found: impl IntoIterator<Item = Keypoint>) -> impl Fn(Class) -> std::vec::IntoIter<Keypoint> {
        let found: Vec<Keypoint> = found.into_iter().collect();
        move |class| if class == Class::Distinct { found.clone() } else { Vec::new() }.into_iter()
    }

    #[test]
    fn the_limit_leaves_the_promised_number() {
        // 100 coarser features spread evenly; the octave has ten extrema a row, of scales from 1 to 2.
        let mut forecast = Forecast::new(distinct((0..100).map(|i| keypoint(i as f32, 3.0))), 500, 0);
        let mut wanted = 0;
        for y in 0..200 {
            for i in 0..10 {
                let scale = 1.0 + 0.1 * i as f32 + 0.0004 * y as f32;
                wanted += usize::from(forecast.wants(Class::Distinct, scale));
            }
            forecast.finish_row(y, 0.5);
        }
        // All 320 down to the first forecast, then the three of each row that make the 475 promised with the margin.
        assert!((320 + 2 * 168..320 + 4 * 168).contains(&wanted), "{wanted}");
        assert!(
            (1.6..1.9).contains(&forecast.complete_from(Class::Distinct)),
            "{}",
            forecast.complete_from(Class::Distinct)
        );
    }

    #[test]
    fn nothing_is_refused_while_little_is_known() {
        let mut none = Forecast::new(distinct([]), 1, 1);
        let mut late = Forecast::new(distinct((0..50).map(|i| keypoint(90.0 + 0.1 * i as f32, 3.0))), 60, 60);
        for y in 0..160 {
            assert!(none.wants(Class::Distinct, 1.0) && late.wants(Class::Faint, 1.0), "row {y}");
            none.finish_row(y, 0.5);
            late.finish_row(y, 0.5);
        }
        for class in [Class::Distinct, Class::Faint] {
            assert_eq!((none.complete_from(class), late.complete_from(class)), (0.0, 0.0));
        }
    }

    #[test]
    fn faint_ones_are_refused_once_distinct_ones_make_up_the_number() {
        for (faint_up_to, is_refused) in [(900, true), (3000, false)] {
            let mut forecast = Forecast::new(distinct((0..100).map(|i| keypoint(i as f32, 3.0))), 10_000, faint_up_to);
            for y in 0..=INTERVAL {
                for _ in 0..10 {
                    forecast.wants(Class::Distinct, 1.0);
                }
                forecast.finish_row(y, 0.5);
            }
            assert_eq!(!forecast.has_room_for_faint(), is_refused, "{faint_up_to}");
            assert_eq!(forecast.complete_from(Class::Faint) > 0.0, is_refused, "{faint_up_to}");
        }
    }
}
