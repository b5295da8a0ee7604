//! Nearest descriptors among the rows near a line: descriptor distances and a geometric restriction in one scan.
//!
//! The rows stand in an order in which those near a query's line are few contiguous runs (its *windows*), so that nothing is
//! gathered or packed for a query: a block of queries with neighbouring lines walks the union of their windows, and in every
//! lane the distance of the row from the query's own line decides whether the row counts. That test costs six instructions for
//! sixteen rows, where their dot products cost thirty-two.
//!
//! Positions are single precision about the middle of the image: errors below a thousandth of a pixel for images up to
//! 10,000 pixels wide. No fused multiply-add is used, so every tier decides alike.

use std::ops::Range;

use super::kernel::{Kernel, PADDING_LIMIT, Running, block, reduce};
use super::packed::{GROUP_ROWS, PADDING_BIAS, PackedDescriptors, fetch_early};
use super::tier::Tier;
use crate::scene::Descriptor;

/// Rows with positions, in groups of sixteen; a section ends with its group.
#[derive(Clone, Debug, Default)]
pub struct BandedRows {
    packed: PackedDescriptors,
    x: Vec<f32>,
    y: Vec<f32>,
}

/// A query and the band around its line.
#[derive(Clone, Copy, Debug)]
pub struct BandQuery<'a> {
    /// What is compared.
    pub descriptor: &'a Descriptor,
    /// Unit normal and offset of the line: `line[0] x + line[1] y + line[2]` is the signed distance of a position.
    pub line: [f32; 3],
    /// Half-width of the band, in the unit of the positions.
    pub half_width: f32,
}

/// A query's nearest rows within its band.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BandTop2 {
    /// Slot of the nearest row (the lowest of equally near ones) and the squared distance to it; none when the band is empty.
    pub nearest: Option<(u32, u32)>,
    /// Squared distance to the second nearest.
    pub second_distance_sq: Option<u32>,
    /// Rows within the band.
    pub candidates: u32,
}

/// Of every slot of some rows the nearest of the queries in whose bands it lies.
#[derive(Clone, Debug, Default)]
pub struct NearestQueries {
    distance_sq: Vec<[i32; GROUP_ROWS]>,
    query: Vec<[i32; GROUP_ROWS]>,
}

impl NearestQueries {
    /// The rank of the query nearest to the row in a slot (the lowest of equally near ones); none when no query that was
    /// scanned has the row in its band.
    pub fn of(&self, slot: u32) -> Option<usize> {
        let slot = slot as usize;
        (self.distance_sq.as_flattened()[slot] < PADDING_LIMIT).then(|| self.query.as_flattened()[slot] as usize)
    }

    /// Forgets all and makes room for so many groups.
    fn restart(&mut self, num_groups: usize) {
        self.distance_sq.clear();
        self.distance_sq.resize(num_groups, [PADDING_BIAS; GROUP_ROWS]);
        self.query.clear();
        self.query.resize(num_groups, [0; GROUP_ROWS]);
    }
}

impl BandQuery<'_> {
    /// Whether a position lies within the band: the scan's own test.
    pub fn contains(&self, x: f32, y: f32) -> bool {
        (self.line[0] * x + self.line[1] * y + self.line[2]).abs() <= self.half_width
    }
}

impl BandedRows {
    /// With room for so many rows in so many sections.
    pub fn with_room(rows: usize, sections: usize) -> Self {
        let groups = rows.div_ceil(GROUP_ROWS) + sections;
        let mut packed = PackedDescriptors::new();
        packed.reserve_groups(groups);
        let position = || Vec::with_capacity(groups * GROUP_ROWS);
        Self { packed, x: position(), y: position() }
    }

    /// Appends a section: the rows `descriptors[indices[0]], ...` with their positions. It starts at the slot
    /// [`BandedRows::slots`] before the call, with a new group.
    ///
    /// # Panics
    /// When an index is out of range.
    pub fn append(&mut self, descriptors: &[Descriptor], indices: &[u32], position: impl Fn(u32) -> [f32; 2]) {
        self.packed.append_subset(descriptors, indices);
        for &index in indices {
            let [x, y] = position(index);
            self.x.push(x);
            self.y.push(y);
        }
        // Nothing lies near any line.
        self.x.resize(self.slots(), f32::NAN);
        self.y.resize(self.slots(), f32::NAN);
    }

    /// Slots taken, those that fill up the sections' last groups included.
    pub fn slots(&self) -> usize {
        self.packed.num_groups() * GROUP_ROWS
    }

    /// The groups of sixteen slots that hold a range of slots.
    pub fn groups_of(slots: Range<usize>) -> Range<u32> {
        if slots.is_empty() {
            return 0..0;
        }
        (slots.start / GROUP_ROWS) as u32..slots.end.div_ceil(GROUP_ROWS) as u32
    }

    /// The positions of a group's rows; not a number where a slot is empty.
    pub fn positions_of_group(&self, group: u32) -> impl Iterator<Item = (u32, [f32; 2])> + '_ {
        let first = group as usize * GROUP_ROWS;
        (first..first + GROUP_ROWS).map(|slot| (slot as u32, [self.x[slot], self.y[slot]]))
    }
}

/// For every query the nearest rows within its band and its windows, into `out` (cleared first), with the fastest
/// instructions of this machine. Query q has the windows `windows[q * n..(q + 1) * n]`, n of them, as ranges of groups in
/// ascending order; a window may be empty. Rows outside a query's own windows may be found too when they lie in its band.
/// The same distances tell for every row its nearest query, into `of_rows`, at a twentieth more work.
pub fn top2_in_bands(
    queries: &[BandQuery<'_>],
    windows: &[Range<u32>],
    rows: &BandedRows,
    out: &mut Vec<BandTop2>,
    of_rows: &mut NearestQueries,
) {
    Tier::detected().top2_in_bands(queries, windows, rows, out, of_rows);
}

/// For every query the squared distance to the nearest of the first `ranks[q]` rows that are not within its band.
pub fn nearest_off_bands(queries: &[BandQuery<'_>], ranks: &[u32], rows: &BandedRows, out: &mut Vec<Option<u32>>) {
    Tier::detected().nearest_off_bands(queries, ranks, rows, out);
}

/// [`top2_in_bands`] with the instructions of `K`, Q queries at a time.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn scan<K: Kernel, const Q: usize>(
    queries: &[BandQuery<'_>],
    windows: &[Range<u32>],
    rows: &BandedRows,
    out: &mut Vec<BandTop2>,
    of_rows: &mut NearestQueries,
) {
    out.clear();
    of_rows.restart(rows.packed.num_groups());
    if queries.is_empty() {
        return;
    }
    let per_query = windows.len() / queries.len();
    let (biases, _) = rows.packed.biases.as_chunks::<GROUP_ROWS>();
    let ((xs, _), (ys, _)) = (rows.x.as_chunks::<GROUP_ROWS>(), rows.y.as_chunks::<GROUP_ROWS>());
    for first in (0..queries.len()).step_by(Q) {
        let used = (queries.len() - first).min(Q);
        let (prepared, norms_sq) = block::<K, Q>(used, |q| queries[first + q].descriptor);
        for next in queries.iter().skip(first + Q).take(Q) {
            fetch_early(next.descriptor);
        }
        let bands: [BandQuery<'_>; Q] = std::array::from_fn(|q| queries[first + q.min(used - 1)]);
        // SAFETY: passed on to the caller.
        unsafe {
            let (zero, padding) = (K::splat(0), K::splat(PADDING_BIAS));
            let mut running = [Running { best: padding, second: padding, group: zero }; Q];
            let mut candidates = [zero; Q];
            let mut scanned_to = 0;
            for window in 0..per_query {
                let of_block = (first..first + used).map(|q| &windows[q * per_query + window]);
                let joined = of_block.filter(|window| !window.is_empty()).fold(None, |joined, window| match joined {
                    None => Some(window.clone()),
                    Some(joined) => Some(joined.start.min(window.start)..joined.end.max(window.end)),
                });
                let Some(joined) = joined else { continue };
                for group in joined.start.max(scanned_to)..joined.end {
                    let at = group as usize;
                    let dots = K::dots::<Q, 1>(&prepared, &[rows.packed.group(at)]);
                    let (biases, group) = (K::load(&biases[at]), K::splat(group as i32));
                    let mut least = K::load(&of_rows.distance_sq[at]);
                    let mut nearest = K::load(&of_rows.query[at]);
                    for q in 0..Q {
                        let near = K::near(&bands[q].line, bands[q].half_width, &xs[at], &ys[at]);
                        candidates[q] = K::add(candidates[q], near);
                        let distance = K::add(K::minus_twice(biases, dots[q][0]), K::splat(norms_sq[q]));
                        let distance = K::select_less(zero, near, distance, padding);
                        running[q].update::<K>(distance, group);
                        nearest = K::select_less(distance, least, K::splat((first + q) as i32), nearest);
                        least = K::min(least, distance);
                    }
                    K::store(least, &mut of_rows.distance_sq[at]);
                    K::store(nearest, &mut of_rows.query[at]);
                }
                scanned_to = scanned_to.max(joined.end);
            }
            // Not in a closure: see `reduce`.
            for q in 0..used {
                let nearest = reduce::<K>(&running[q]);
                let mut counts = [0; GROUP_ROWS];
                K::store(candidates[q], &mut counts);
                out.push(BandTop2 {
                    nearest: (nearest.distance_sq < PADDING_LIMIT as u32)
                        .then_some((nearest.index, nearest.distance_sq)),
                    second_distance_sq: nearest.second_distance_sq,
                    candidates: counts.iter().sum::<i32>() as u32,
                });
            }
        }
    }
}

/// [`nearest_off_bands`] with the instructions of `K`, Q queries at a time.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn scan_off<K: Kernel, const Q: usize>(
    queries: &[BandQuery<'_>],
    ranks: &[u32],
    rows: &BandedRows,
    out: &mut Vec<Option<u32>>,
) {
    out.clear();
    let (biases, _) = rows.packed.biases.as_chunks::<GROUP_ROWS>();
    let ((xs, _), (ys, _)) = (rows.x.as_chunks::<GROUP_ROWS>(), rows.y.as_chunks::<GROUP_ROWS>());
    for first in (0..queries.len()).step_by(Q) {
        let used = (queries.len() - first).min(Q);
        let (prepared, norms_sq) = block::<K, Q>(used, |q| queries[first + q].descriptor);
        let last = |q: usize| first + q.min(used - 1);
        // SAFETY: passed on to the caller.
        unsafe {
            let padding = K::splat(PADDING_BIAS);
            let mut nearest = [padding; Q];
            for at in 0..rows.packed.num_groups() {
                let dots = K::dots::<Q, 1>(&prepared, &[rows.packed.group(at)]);
                let biases = K::load(&biases[at]);
                let slots = K::load(&std::array::from_fn(|lane| (at * GROUP_ROWS + lane) as i32));
                for q in 0..Q {
                    let query = &queries[last(q)];
                    let near = K::near(&query.line, query.half_width, &xs[at], &ys[at]);
                    let distance = K::add(K::minus_twice(biases, dots[q][0]), K::splat(norms_sq[q]));
                    let distance = K::select_less(near, K::splat(1), distance, padding);
                    let distance = K::select_less(slots, K::splat(ranks[last(q)] as i32), distance, padding);
                    nearest[q] = K::min(nearest[q], distance);
                }
            }
            for &lanes in &nearest[..used] {
                let mut distances = [0; GROUP_ROWS];
                K::store(lanes, &mut distances);
                let least = distances.into_iter().fold(i32::MAX, i32::min);
                out.push((least < PADDING_LIMIT).then_some(least as u32));
            }
        }
    }
}
