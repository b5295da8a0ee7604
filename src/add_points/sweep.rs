//! Features near epipolar lines by a sweep about the epipole: the exact and faster alternative to the paper's grids.
//!
//! A line that turns about the epipole meets the target's features one after the other. Stored in that order, the features
//! in the band around any line are one run of neighbours, so nothing has to be looked up, gathered or made unique for a line:
//! queries in the order of their lines slide a window along the features ([`top2_in_bands`]). That holds as it stands for
//! features of equal reach ([`super::pencil`]); those nearer to the epipole are in a band for more turns. So features are
//! cut into rings of at most a factor of two in reach, each sorted by itself, with a window each. An epipole outside the image
//! has one or two rings; one in the image a dozen, of which the inner ones hold next to nothing.
//!
//! Where the paper shares a line's candidates among queries with nearly the same line (6.2.2), neighbours in the sweep share
//! them here, and yet each has exactly those of its own line.
//!
//! [`top2_in_bands`]: crate::matching::descriptor::top2_in_bands

use std::ops::Range;

use nalgebra::{Vector2, Vector3};

use super::epipolar::{BoundingBox, EpipolarLine};
use super::pencil::{Pencil, PencilLine, Turn};
use crate::matching::descriptor::{BandQuery, BandedRows};
use crate::scene::Descriptor;

/// Some features of an image, by their turns about an epipole.
pub struct Sweep {
    pencil: Pencil,
    rows: BandedRows,
    /// The feature in every slot of the rows; none where a slot only fills up a group.
    features: Vec<Option<u32>>,
    rings: Vec<Ring>,
}

struct Ring {
    first_slot: usize,
    /// Ascending, one a feature.
    turns: Vec<Turn>,
    least_reach: f64,
}

/// More rings than this would cut up what lies within a thousandth of the image's size about the epipole.
const MAX_RINGS: usize = 12;
/// What the wedge is widened by, relatively, to be safe from rounding: the exact test comes after it.
const WEDGE_SLACK: f64 = 1e-3;

/// Where the last line's windows began and ended in every ring: the next line's are near.
pub struct SweepCursor {
    ends: Vec<[usize; 2]>,
}

impl Sweep {
    /// Of the features `members` of `positions` (undistorted pixels, within `bounds`) about an epipole.
    pub fn new(
        epipole: &Vector3<f64>,
        bounds: &BoundingBox,
        positions: &[Vector2<f64>],
        descriptors: &[Descriptor],
        members: &[u32],
    ) -> Self {
        let pencil = Pencil::new(epipole, bounds);
        let placed: Vec<(u32, Turn, f64)> = members
            .iter()
            .map(|&feature| {
                let (turn, reach) = pencil.position(&positions[feature as usize]);
                (feature, turn, reach)
            })
            .collect();
        let farthest = placed.iter().fold(0.0, |farthest, (_, _, reach)| reach.max(farthest));
        let mut of_rings: Vec<Vec<(Turn, u32)>> = vec![Vec::new(); MAX_RINGS];
        let mut least_reach = [f64::INFINITY; MAX_RINGS];
        for (feature, turn, reach) in placed {
            let (mut ring, mut edge) = (0, farthest / 2.0);
            while reach < edge && ring + 1 < MAX_RINGS {
                ring += 1;
                edge /= 2.0;
            }
            of_rings[ring].push((turn, feature));
            least_reach[ring] = reach.min(least_reach[ring]);
        }
        let mut sweep = Self {
            pencil,
            rows: BandedRows::with_room(members.len(), MAX_RINGS),
            features: Vec::new(),
            rings: Vec::new(),
        };
        for (mut members, least_reach) in of_rings.into_iter().zip(least_reach) {
            if members.is_empty() {
                continue;
            }
            members.sort_unstable();
            let first_slot = sweep.rows.slots();
            let indices: Vec<u32> = members.iter().map(|&(_, feature)| feature).collect();
            let mut rows = std::mem::take(&mut sweep.rows);
            sweep.append_to(&mut rows, descriptors, &indices, positions);
            sweep.rows = rows;
            sweep.features.extend(indices.into_iter().map(Some));
            sweep.features.resize(sweep.rows.slots(), None);
            let turns = members.into_iter().map(|(turn, _)| turn).collect();
            sweep.rings.push(Ring { first_slot, turns, least_reach });
        }
        sweep
    }

    /// The lines this is a sweep of.
    pub fn pencil(&self) -> &Pencil {
        &self.pencil
    }

    /// The features in their order.
    pub fn rows(&self) -> &BandedRows {
        &self.rows
    }

    /// The feature in a slot; none where the slot is empty.
    pub fn feature(&self, slot: u32) -> Option<u32> {
        self.features.get(slot as usize).copied().flatten()
    }

    /// Appends features to rows whose positions are those of the sweep's.
    pub fn append_to(
        &self,
        rows: &mut BandedRows,
        descriptors: &[Descriptor],
        features: &[u32],
        positions: &[Vector2<f64>],
    ) {
        let center = self.pencil.center();
        rows.append(descriptors, features, |feature| about(&center, &positions[feature as usize]));
    }

    /// The features in a query's band, given its windows.
    pub fn features_in_band<'a>(
        &'a self,
        query: &'a BandQuery<'_>,
        windows: &'a [Range<u32>],
    ) -> impl Iterator<Item = u32> + 'a {
        let rows = windows.iter().flat_map(|window| window.clone()).flat_map(|at| self.rows.positions_of_group(at));
        rows.filter(|(_, [x, y])| query.contains(*x, *y)).filter_map(|(slot, _)| self.feature(slot))
    }

    /// A query with the band around its line.
    pub fn query<'a>(&self, descriptor: &'a Descriptor, line: &EpipolarLine, band_px: f64) -> BandQuery<'a> {
        let offset_px = line.offset_px + line.normal.dot(&self.pencil.center());
        let line = [line.normal.x as f32, line.normal.y as f32, offset_px as f32];
        BandQuery { descriptor, line, half_width: band_px as f32 }
    }

    /// Whether a position lies in a query's band, as the scan sees it.
    pub fn contains(&self, query: &BandQuery<'_>, at: &Vector2<f64>) -> bool {
        let [x, y] = about(&self.pencil.center(), at);
        query.contains(x, y)
    }

    /// Number of windows of a line.
    pub fn windows_per_line(&self) -> usize {
        2 * self.rings.len()
    }

    /// For the first line of a sweep.
    pub fn cursor(&self) -> SweepCursor {
        SweepCursor { ends: vec![[0; 2]; self.rings.len()] }
    }

    /// Appends a line's windows, as groups of the rows: they hold every feature of its band. Fast for lines near the one
    /// before.
    pub fn windows(&self, line: &PencilLine, band_px: f64, cursor: &mut SweepCursor, windows: &mut Vec<Range<u32>>) {
        for (ring, ends) in self.rings.iter().zip(&mut cursor.ends) {
            let all = ring.turns.len();
            let groups = |of: Range<usize>| BandedRows::groups_of(ring.first_slot + of.start..ring.first_slot + of.end);
            let Some((low, high)) = line.wedge(band_px * (1.0 + WEDGE_SLACK), ring.least_reach) else {
                windows.extend([groups(0..all), 0..0]);
                continue;
            };
            walk(&mut ends[0], &ring.turns, |turn| turn < low);
            walk(&mut ends[1], &ring.turns, |turn| turn <= high);
            windows.extend(if low <= high {
                [groups(ends[0]..ends[1]), 0..0]
            } else {
                [groups(0..ends[1]), groups(ends[0]..all)]
            });
        }
    }
}

/// A position about the middle, in single precision.
fn about(center: &Vector2<f64>, at: &Vector2<f64>) -> [f32; 2] {
    (at - center).map(|coordinate| coordinate as f32).into()
}

/// Moves to the first turn that is not `before`, from somewhere near.
fn walk(end: &mut usize, turns: &[Turn], before: impl Fn(Turn) -> bool) {
    while *end > 0 && !before(turns[*end - 1]) {
        *end -= 1;
    }
    while *end < turns.len() && before(turns[*end]) {
        *end += 1;
    }
}
