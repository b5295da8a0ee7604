//! Exact nearest and second-nearest descriptors by brute force.
//!
//! For a query q and a database row v (both 128 unsigned bytes),
//!
//! ```text
//! d^2 = |q - v|^2 = |q|^2 + |v|^2 - 2 q.v = |q|^2 + bias(v) - 2 (q - o).v,      bias(v) = |v|^2 - 2 o sum(v)
//! ```
//!
//! where the offset o = 128 turns the query into signed bytes, because the instruction that multiplies four bytes and
//! adds them up (`vpdpbusd`) takes one unsigned and one signed operand; o = 0 where both may be unsigned (NEON). `bias`
//! is kept with the row, so the inner loop is dot products alone, and everything is an exact 32-bit integer: every tier
//! of instructions gives the same bits, and the scalar tier is the oracle of the others.
//!
//! Speed comes from the layout ([`PackedDescriptors`]): sixteen rows side by side, four bytes of each at a time, so that
//! one vector holds one partial sum per row and no horizontal sums are needed, and from tiles of several queries by
//! several groups of rows that keep their sums in registers. Best, second best and index are updated as soon as a tile is
//! done: no matrix of distances is ever written. When both images' nearest neighbours are wanted, the same tile serves
//! both ([`top2_both`]), at about a quarter more work instead of twice as much.
//!
//! The limit is arithmetic: a pair is 128 multiplications, two 512-bit instructions' share, so a core that starts two of them a
//! cycle does at most one pair a cycle. One core of a Zen 5 does 3.0 Gpair/s with AVX-512 VNNI (2.8 both ways), about three
//! quarters of that, and 1.5 with AVX-VNNI (`cargo bench --bench matching`).

mod banded;
mod cells;
mod kernel;
#[cfg(target_arch = "aarch64")]
mod neon;
mod packed;
mod scalar;
#[cfg(test)]
mod tests;
mod tier;
#[cfg(target_arch = "x86_64")]
mod x86;

pub use banded::{BandQuery, BandTop2, BandedRows, NearestQueries, nearest_off_bands, top2_in_bands};
pub use cells::{CellRows, top2_in_cells};
pub use packed::PackedDescriptors;
pub use tier::Tier;

use crate::scene::Descriptor;

/// Length of a RootSIFT descriptor as quantised ([`Descriptor`]): a distance of 1 between unit vectors is this many units.
pub const DESCRIPTOR_NORM: f64 = 512.0;

/// The nearest of a set of descriptors, and how far the next one is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Top2 {
    /// Rank of the nearest row in the set (the lowest of equally near ones).
    pub index: u32,
    /// Squared distance to it, in quantised units ([`DESCRIPTOR_NORM`]).
    pub distance_sq: u32,
    /// Squared distance to the second nearest row; none when the set has a single row.
    pub second_distance_sq: Option<u32>,
}

impl Top2 {
    /// The nearest of two disjoint sets, given the nearest of each; `later` numbers its rows above those of `self`.
    pub fn joined_with(self, later: Self) -> Self {
        let (best, other) = if later.distance_sq < self.distance_sq { (later, self) } else { (self, later) };
        let runner_up = best.second_distance_sq.map_or(other.distance_sq, |second| second.min(other.distance_sq));
        Self { second_distance_sq: Some(runner_up), ..best }
    }
}

/// For every query the nearest and second-nearest row of `packed`, into `out` (cleared first), in query order, with the
/// fastest instructions of this machine. `out` stays empty when `packed` is empty.
pub fn top2(queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<Top2>) {
    Tier::detected().top2(queries, packed, out);
}

/// [`top2`] in both directions from one pass: for every query its nearest rows, and for every row its nearest queries.
pub fn top2_both(
    queries: &[Descriptor],
    packed: &PackedDescriptors,
    of_queries: &mut Vec<Top2>,
    of_rows: &mut Vec<Top2>,
) {
    Tier::detected().top2_both(queries, packed, of_queries, of_rows);
}

/// Every squared distance, that of query q and row r at `q * packed.len() + r` of `out` (cleared first), with the fastest
/// instructions of this machine. For few rows.
pub fn distances_sq(queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<u32>) {
    Tier::detected().distances_sq(queries, packed, out);
}

/// The squared distance from a query to the nearest of the rows `descriptors[indices[0]], ...`; none when there are none. For a
/// few rows that are not worth packing, with the fastest instructions of this machine.
///
/// # Panics
/// When an index is out of range.
pub fn least_distance_sq(query: &Descriptor, descriptors: &[Descriptor], indices: &[u32]) -> Option<u32> {
    Tier::detected().least_distance_sq(query, descriptors, indices)
}

/// The squared distance of two descriptors.
#[inline(always)]
pub fn distance_sq(a: &Descriptor, b: &Descriptor) -> u32 {
    a.iter().zip(b).map(|(&x, &y)| u32::from(x.abs_diff(y)).pow(2)).sum()
}
