//! The scan over tiles, written once for all instruction sets.
//!
//! A tile is Q queries by G groups of 16 rows; its Q * G vectors of dot products stay in registers. The rows are walked in
//! chunks that fit the second-level cache while all queries pass by. For each query three vectors (best, second, number of
//! the best one's group) run along a chunk and are reduced to a [`Top2`] at its end; for each row, when both directions are
//! wanted, the same three are kept in memory ([`RowStates`]).
//!
//! Ties go to the lowest index: a lane sees its rows in ascending order and changes its mind only for strictly smaller
//! distances, and the final reduction takes the lowest index among equal lanes.

use super::Top2;
use super::cells::CellRows;
use super::packed::{GROUP_ROWS, Group, PADDING_BIAS, PackedDescriptors, fetch_early, norm_sq};
use crate::math::Grouped;
use crate::scene::{DESCRIPTOR_LEN, Descriptor};

/// Groups in a chunk: 64 * 2 KiB = 128 KiB of rows.
const CHUNK_GROUPS: usize = 64;

/// Any distance at or above this belongs to padding.
pub(super) const PADDING_LIMIT: i32 = PADDING_BIAS / 2;

/// Sixteen 32-bit lanes and the dot products of queries with groups of rows.
///
/// # Safety
/// The methods may use instructions that the implementing type names; callers make sure that the machine has them.
pub(super) unsafe trait Kernel {
    /// Sixteen 32-bit integers.
    type Lanes: Copy;
    /// A query in the form its multiplications need.
    type Query: Copy;

    fn prepare(query: &Descriptor) -> Self::Query;

    /// `(q - o) . v` of every query with every row of the groups.
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q];

    unsafe fn splat(value: i32) -> Self::Lanes;
    unsafe fn load(from: &[i32; GROUP_ROWS]) -> Self::Lanes;
    unsafe fn store(lanes: Self::Lanes, to: &mut [i32; GROUP_ROWS]);
    /// `a - 2 b`.
    unsafe fn minus_twice(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    unsafe fn add(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    unsafe fn min(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    unsafe fn max(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes;
    /// In every lane `a < b ? if_less : otherwise`.
    unsafe fn select_less(a: Self::Lanes, b: Self::Lanes, if_less: Self::Lanes, otherwise: Self::Lanes) -> Self::Lanes;
    /// In every lane 1 where `|line[0] x + line[1] y + line[2]| <= half_width`, added up from the left, else 0.
    unsafe fn near(line: &[f32; 3], half_width: f32, x: &[f32; GROUP_ROWS], y: &[f32; GROUP_ROWS]) -> Self::Lanes;
}

/// A block of up to Q queries in the form the multiplications need, with their squared lengths. A query that only fills up
/// the block is farther from every row than any real one.
#[inline(always)]
pub(super) fn block<'a, K: Kernel, const Q: usize>(
    used: usize,
    query: impl Fn(usize) -> &'a Descriptor,
) -> ([K::Query; Q], [i32; Q]) {
    const EMPTY: Descriptor = [0; DESCRIPTOR_LEN];
    let prepared = std::array::from_fn(|q| K::prepare(if q < used { query(q) } else { &EMPTY }));
    (prepared, std::array::from_fn(|q| if q < used { norm_sq(query(q)) } else { PADDING_BIAS }))
}

/// Best and second-best squared distance and the best query of every row seen so far.
struct RowStates {
    best: Vec<[i32; GROUP_ROWS]>,
    second: Vec<[i32; GROUP_ROWS]>,
    query: Vec<[i32; GROUP_ROWS]>,
}

impl RowStates {
    /// Of so many groups of rows that no query was seen of.
    fn new(num_groups: usize) -> Self {
        Self {
            best: vec![[PADDING_BIAS; GROUP_ROWS]; num_groups],
            second: vec![[PADDING_BIAS; GROUP_ROWS]; num_groups],
            query: vec![[0; GROUP_ROWS]; num_groups],
        }
    }

    /// The nearest queries of the row in a slot; none where there is no row, or no query was seen.
    fn of(&self, slot: usize) -> Option<Top2> {
        let of_slot = |values: &[[i32; GROUP_ROWS]]| values[slot / GROUP_ROWS][slot % GROUP_ROWS];
        let (best, second) = (of_slot(&self.best), of_slot(&self.second));
        (best < PADDING_LIMIT).then(|| Top2 {
            index: of_slot(&self.query) as u32,
            distance_sq: best as u32,
            second_distance_sq: (second < PADDING_LIMIT).then_some(second as u32),
        })
    }
}

/// Nearest rows of every query.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn top2<K: Kernel, const Q: usize, const G: usize>(
    queries: &[Descriptor],
    packed: &PackedDescriptors,
    out: &mut Vec<Top2>,
) {
    // SAFETY: passed on to the caller.
    unsafe { scan::<K, Q, G>(queries, packed, out, None) };
}

/// Nearest rows of every query and nearest queries of every row.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn top2_both<K: Kernel, const Q: usize, const G: usize>(
    queries: &[Descriptor],
    packed: &PackedDescriptors,
    of_queries: &mut Vec<Top2>,
    of_rows: &mut Vec<Top2>,
) {
    let mut rows = RowStates::new(packed.num_groups());
    // SAFETY: passed on to the caller.
    unsafe { scan::<K, Q, G>(queries, packed, of_queries, Some(&mut rows)) };
    of_rows.clear();
    if queries.is_empty() {
        return;
    }
    of_rows.extend((0..packed.len()).filter_map(|row| rows.of(row)));
}

/// Every squared distance, that of query q and row r at `q * packed.len() + r`. For few rows.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn distances_sq<K: Kernel, const Q: usize>(
    queries: &[Descriptor],
    packed: &PackedDescriptors,
    out: &mut Vec<u32>,
) {
    out.clear();
    out.resize(queries.len() * packed.len(), 0);
    let (biases, _) = packed.biases.as_chunks::<GROUP_ROWS>();
    for first in (0..queries.len()).step_by(Q) {
        let used = (queries.len() - first).min(Q);
        let (prepared, norms_sq) = block::<K, Q>(used, |q| &queries[first + q]);
        for (group, biases) in biases.iter().enumerate() {
            let first_row = group * GROUP_ROWS;
            let num_rows = (packed.len() - first_row).min(GROUP_ROWS);
            // SAFETY: passed on to the caller.
            unsafe {
                let dots = K::dots::<Q, 1>(&prepared, &[packed.group(group)]);
                let biases = K::load(biases);
                for q in 0..used {
                    let mut distances = [0; GROUP_ROWS];
                    let of_rows = K::add(K::minus_twice(biases, dots[q][0]), K::splat(norms_sq[q]));
                    K::store(of_rows, &mut distances);
                    let start = (first + q) * packed.len() + first_row;
                    for (out, distance_sq) in out[start..start + num_rows].iter_mut().zip(distances) {
                        *out = distance_sq as u32;
                    }
                }
            }
        }
    }
}

/// Of every query its nearest rows among those of the cells that it visits, and of every slot its nearest queries among those
/// that visit its cell.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn top2_in_cells<K: Kernel, const Q: usize, const G: usize>(
    queries: &[Descriptor],
    visitors: &Grouped<u32>,
    rows: &CellRows,
    of_queries: &mut Vec<Option<Top2>>,
    of_slots: &mut Vec<Option<Top2>>,
) {
    let packed = &rows.packed;
    let mut states = RowStates::new(packed.num_groups());
    of_queries.clear();
    of_queries.resize(queries.len(), None);
    for cell in 0..rows.num_cells() {
        let (visiting, groups) = (visitors.group(cell), rows.groups_of(cell));
        for chunk in groups.clone().step_by(CHUNK_GROUPS) {
            let chunk_end = (chunk + CHUNK_GROUPS).min(groups.end);
            for first in (0..visiting.len()).step_by(Q) {
                let (block_of, later) = visiting[first..].split_at(Q.min(visiting.len() - first));
                for &query in &later[..Q.min(later.len())] {
                    fetch_early(&queries[query as usize]);
                }
                let (prepared, norms_sq) = block::<K, Q>(block_of.len(), |q| &queries[block_of[q] as usize]);
                // SAFETY: passed on to the caller.
                let found = unsafe {
                    scan_block::<K, Q, G>(&prepared, &norms_sq, first, packed, chunk..chunk_end, Some(&mut states))
                };
                for (found, &query) in found.into_iter().zip(block_of) {
                    let before = &mut of_queries[query as usize];
                    *before = Some(before.map_or(found, |before| before.joined_with(found)));
                }
            }
        }
    }
    of_slots.clear();
    for cell in 0..rows.num_cells() {
        let (visiting, groups) = (visitors.group(cell), rows.groups_of(cell));
        let slots = groups.start * GROUP_ROWS..groups.end * GROUP_ROWS;
        of_slots.extend(
            slots.map(|slot| states.of(slot).map(|found| Top2 { index: visiting[found.index as usize], ..found })),
        );
    }
}

/// The nearest rows of a few cells to one query.
///
/// # Safety
/// The machine must have the instructions of `K`.
#[inline(always)]
pub(super) unsafe fn top2_of_cells<K: Kernel, const G: usize>(
    query: &Descriptor,
    cells: &[u32],
    rows: &CellRows,
) -> Option<Top2> {
    let (prepared, norms_sq) = block::<K, 1>(1, |_| query);
    let mut nearest: Option<Top2> = None;
    for &cell in cells {
        let groups = rows.groups_of(cell as usize);
        if !groups.is_empty() {
            // SAFETY: passed on to the caller.
            let [found] = unsafe { scan_block::<K, 1, G>(&prepared, &norms_sq, 0, &rows.packed, groups, None) };
            nearest = Some(nearest.map_or(found, |before| before.joined_with(found)));
        }
    }
    nearest
}

#[inline(always)]
unsafe fn scan<K: Kernel, const Q: usize, const G: usize>(
    queries: &[Descriptor],
    packed: &PackedDescriptors,
    out: &mut Vec<Top2>,
    mut rows: Option<&mut RowStates>,
) {
    out.clear();
    let num_groups = packed.num_groups();
    for chunk in (0..num_groups).step_by(CHUNK_GROUPS) {
        let chunk_end = (chunk + CHUNK_GROUPS).min(num_groups);
        for first in (0..queries.len()).step_by(Q) {
            let used = (queries.len() - first).min(Q);
            let (prepared, norms_sq) = block::<K, Q>(used, |q| &queries[first + q]);
            // SAFETY: passed on to the caller.
            let found = unsafe {
                scan_block::<K, Q, G>(&prepared, &norms_sq, first, packed, chunk..chunk_end, rows.as_deref_mut())
            };
            for (q, found) in found.into_iter().take(used).enumerate() {
                match out.get_mut(first + q) {
                    Some(before) => *before = before.joined_with(found),
                    None => out.push(found),
                }
            }
        }
    }
}

/// Vectors that run along rows for one query.
#[derive(Clone, Copy)]
pub(super) struct Running<L> {
    pub(super) best: L,
    pub(super) second: L,
    pub(super) group: L,
}

impl<L: Copy> Running<L> {
    /// Takes a group's distances in.
    ///
    /// # Safety
    /// The machine must have the instructions of `K`.
    #[inline(always)]
    pub(super) unsafe fn update<K: Kernel<Lanes = L>>(&mut self, distance: L, group: L) {
        // SAFETY: passed on to the caller.
        unsafe {
            self.group = K::select_less(distance, self.best, group, self.group);
            self.second = K::min(self.second, K::max(self.best, distance));
            self.best = K::min(self.best, distance);
        }
    }
}

#[inline(always)]
unsafe fn scan_block<K: Kernel, const Q: usize, const G: usize>(
    prepared: &[K::Query; Q],
    norms_sq: &[i32; Q],
    first_query: usize,
    packed: &PackedDescriptors,
    groups: std::ops::Range<usize>,
    mut rows: Option<&mut RowStates>,
) -> [Top2; Q] {
    let (biases, _) = packed.biases.as_chunks::<GROUP_ROWS>();
    // SAFETY: the caller vouches for the instructions of `K`; everything else is safe.
    unsafe {
        let padding = K::splat(PADDING_BIAS);
        let mut running = [Running { best: padding, second: padding, group: K::splat(0) }; Q];
        let mut at = groups.start;
        while at + G <= groups.end {
            let tile: [Group<'_>; G] = std::array::from_fn(|g| packed.group(at + g));
            let dots = K::dots::<Q, G>(prepared, &tile);
            let columns: [[K::Lanes; Q]; G] = std::array::from_fn(|g| std::array::from_fn(|q| dots[q][g]));
            for column in columns {
                update::<K, Q>(&column, norms_sq, first_query, &biases[at], at, &mut running, rows.as_deref_mut());
                at += 1;
            }
        }
        while at < groups.end {
            let dots = K::dots::<Q, 1>(prepared, &[packed.group(at)]);
            let column = std::array::from_fn(|q| dots[q][0]);
            update::<K, Q>(&column, norms_sq, first_query, &biases[at], at, &mut running, rows.as_deref_mut());
            at += 1;
        }
        let mut found = [reduce::<K>(&running[0]); Q];
        for (found, running) in found.iter_mut().zip(&running).skip(1) {
            *found = reduce::<K>(running);
        }
        found
    }
}

/// Folds the dot products of Q queries with one group into the running states.
#[inline(always)]
unsafe fn update<K: Kernel, const Q: usize>(
    dots: &[K::Lanes; Q],
    norms_sq: &[i32; Q],
    first_query: usize,
    biases: &[i32; GROUP_ROWS],
    group: usize,
    running: &mut [Running<K::Lanes>; Q],
    rows: Option<&mut RowStates>,
) {
    // SAFETY: the caller vouches for the instructions of `K`.
    unsafe {
        let biases = K::load(biases);
        let group_number = K::splat(group as i32);
        let mut distances = [biases; Q];
        for q in 0..Q {
            let distance = K::add(K::minus_twice(biases, dots[q]), K::splat(norms_sq[q]));
            running[q].update::<K>(distance, group_number);
            distances[q] = distance;
        }
        let Some(rows) = rows else { return };
        let mut best = K::load(&rows.best[group]);
        let mut second = K::load(&rows.second[group]);
        let mut query = K::load(&rows.query[group]);
        for (q, &distance) in distances.iter().enumerate() {
            query = K::select_less(distance, best, K::splat((first_query + q) as i32), query);
            second = K::min(second, K::max(best, distance));
            best = K::min(best, distance);
        }
        K::store(best, &mut rows.best[group]);
        K::store(second, &mut rows.second[group]);
        K::store(query, &mut rows.query[group]);
    }
}

/// The best and second best over the sixteen lanes. Neither this nor its callers use closures around the methods of
/// `K`: a closure is compiled without the instructions of the function around it, and every one of `K` in it becomes a
/// call through memory.
#[inline(always)]
pub(super) unsafe fn reduce<K: Kernel>(running: &Running<K::Lanes>) -> Top2 {
    let (mut best, mut second, mut group) = ([0; GROUP_ROWS], [0; GROUP_ROWS], [0; GROUP_ROWS]);
    // SAFETY: the caller vouches for the instructions of `K`.
    unsafe {
        K::store(running.best, &mut best);
        K::store(running.second, &mut second);
        K::store(running.group, &mut group);
    }
    let nearest = best.iter().copied().fold(i32::MAX, i32::min);
    let mut index = i32::MAX;
    for (lane, (&best, &group)) in best.iter().zip(&group).enumerate() {
        let row = group * GROUP_ROWS as i32 + lane as i32;
        index = index.min(if best == nearest { row } else { i32::MAX });
    }
    // In the winner's lane its own second takes the place of the best. By comparison: storing it there would make the vector that
    // is read next wait for a single lane.
    let winner = index as usize % GROUP_ROWS;
    let mut runner_up = i32::MAX;
    for (lane, (&best, &second)) in best.iter().zip(&second).enumerate() {
        runner_up = runner_up.min(if lane == winner { second } else { best });
    }
    Top2 {
        index: index as u32,
        distance_sq: nearest as u32,
        second_distance_sq: (runner_up < PADDING_LIMIT).then_some(runner_up as u32),
    }
}
