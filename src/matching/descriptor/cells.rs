//! Rows and queries by the cells of a partition of descriptor space, for scans that compare only within cells.
//!
//! The rows of a cell are groups of their own ([`CellRows`]), so a cell is scanned as a whole set is; the queries that visit
//! it are a list of their ranks, read where they stand: a block of a few is prepared once for all rows of a cell.

use std::ops::Range;

use super::Top2;
use super::packed::{GROUP_ROWS, PackedDescriptors};
use super::tier::Tier;
use crate::math::Grouped;
use crate::scene::Descriptor;

/// Rows by cell, each cell's in groups of sixteen slots of which the last ones may be empty.
#[derive(Clone, Debug, Default)]
pub struct CellRows {
    pub(super) packed: PackedDescriptors,
    /// The rank of the row in every slot. An empty slot, which is never nearest to anything, has that of the slot before.
    ranks: Vec<u32>,
    /// The first group of every cell, and the end of the last.
    starts: Vec<u32>,
}

impl CellRows {
    /// Packs `descriptors[r]` of all ranks r in the cells of `lists`.
    ///
    /// # Panics
    /// When a rank is out of range.
    pub fn pack(descriptors: &[Descriptor], lists: &Grouped<u32>) -> Self {
        let mut rows = Self { starts: vec![0], ..Self::default() };
        rows.packed.reserve_groups(lists.num_items().div_ceil(GROUP_ROWS) + lists.num_groups());
        for cell in 0..lists.num_groups() {
            let of_cell = lists.group(cell);
            rows.packed.append_subset(descriptors, of_cell);
            rows.ranks.extend(of_cell);
            let groups = rows.packed.num_groups();
            if let Some(&last) = of_cell.last() {
                rows.ranks.resize(groups * GROUP_ROWS, last);
            }
            rows.starts.push(groups as u32);
        }
        rows
    }

    /// For every query the nearest and second-nearest of all rows, into `out` (cleared first), with the fastest instructions of
    /// this machine. The indices are slots. `out` stays empty when there are no rows.
    pub fn top2(&self, queries: &[Descriptor], out: &mut Vec<Top2>) {
        Tier::detected().top2(queries, &self.packed, out);
    }

    /// The rank of the row in a slot.
    ///
    /// # Panics
    /// When the slot is out of range.
    pub fn rank(&self, slot: u32) -> u32 {
        self.ranks[slot as usize]
    }

    /// The nearest and second-nearest of a few cells' rows to a query, with the fastest instructions of this machine; none when
    /// these cells are empty. Its index is a slot.
    ///
    /// # Panics
    /// When a cell is out of range.
    pub fn top2_of(&self, cells: &[u32], query: &Descriptor) -> Option<Top2> {
        Tier::detected().top2_of_cells(query, cells, self)
    }

    pub(super) fn num_cells(&self) -> usize {
        self.starts.len().saturating_sub(1)
    }

    /// The groups of a cell.
    pub(super) fn groups_of(&self, cell: usize) -> Range<usize> {
        self.starts[cell] as usize..self.starts[cell + 1] as usize
    }
}

/// Of every query the nearest rows among those of the cells that it visits, into `of_queries`, none where these are empty; and of
/// every slot the nearest queries among those that visit its cell, into `of_slots`, none where there are none. With the
/// fastest instructions of this machine. The indices are slots and ranks of queries.
///
/// # Panics
/// When `visitors` and `rows` have different numbers of cells, or a visitor's rank is out of range.
pub fn top2_in_cells(
    queries: &[Descriptor],
    visitors: &Grouped<u32>,
    rows: &CellRows,
    of_queries: &mut Vec<Option<Top2>>,
    of_slots: &mut Vec<Option<Top2>>,
) {
    assert_eq!(visitors.num_groups(), rows.num_cells(), "cells of different partitions");
    Tier::detected().top2_in_cells(queries, visitors, rows, of_queries, of_slots);
}
