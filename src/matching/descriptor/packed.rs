//! The database side of the kernels.

use crate::scene::{DESCRIPTOR_LEN, Descriptor};

/// Rows side by side in a group: the 32-bit lanes of the widest vector.
pub(super) const GROUP_ROWS: usize = 16;
/// Quads (runs of four bytes) in a descriptor.
pub(super) const QUADS: usize = DESCRIPTOR_LEN / 4;
/// o of the module's formula.
pub(super) const QUERY_OFFSET: u8 = if cfg!(target_arch = "aarch64") { 0 } else { 128 };
/// Bias of the rows that only fill up the last group: larger than any squared distance (128 * 255^2 < 2^24), and two of
/// them still add without overflow.
pub(super) const PADDING_BIAS: i32 = 1 << 29;

/// One quad of each of the sixteen rows of a group: a cache line.
#[derive(Clone, Copy, Debug)]
#[repr(C, align(64))]
pub(super) struct Line(pub(super) [[u8; 4]; GROUP_ROWS]);

/// What the kernel of AVX2 must know of a group to multiply bytes with sums of 16 bits (see `x86::Avx2`).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "read by the kernel of AVX2 alone"))]
pub(super) struct ShortSums {
    /// For every row `(128 - SHORT_OFFSET)` times the sum of its bytes.
    pub(super) shifts: [i32; GROUP_ROWS],
    /// The largest sum of four bytes of a row whose products are added up in 16 bits.
    pub(super) most: i32,
}

/// What is taken from a query's bytes for sums of 16 bits: half of what few of them exceed.
pub(super) const SHORT_OFFSET: u8 = 64;

impl ShortSums {
    /// Of the rows of a group with these sums of bytes, of which `most` is known.
    #[inline(always)]
    pub(super) fn new(row_sums: &[i32; GROUP_ROWS], most: i32) -> Self {
        let weight = i32::from(QUERY_OFFSET) - i32::from(SHORT_OFFSET);
        Self { shifts: row_sums.map(|sum| weight * sum), most }
    }
}

/// A group of rows as the kernels take it.
#[derive(Clone, Copy)]
pub(super) struct Group<'a> {
    /// Its quads.
    pub(super) lines: &'a [Line; QUADS],
    /// Used where bytes are multiplied with sums of 16 bits.
    #[cfg_attr(not(target_arch = "x86_64"), allow(dead_code, reason = "read by the kernel of AVX2 alone"))]
    pub(super) short: &'a ShortSums,
}

/// Descriptors laid out for the kernels: groups of 16 rows; in a group 32 lines, one for each run of four bytes; in a line
/// these four bytes of each of the 16 rows.
///
/// The memory is kept when the set is packed again, so thousands of small sets cost no allocation.
#[derive(Clone, Debug, Default)]
pub struct PackedDescriptors {
    pub(super) lines: Vec<Line>,
    /// For every row, padding included, the bias of the module's formula.
    pub(super) biases: Vec<i32>,
    /// Of every group.
    short: Vec<ShortSums>,
    len: usize,
}

impl PackedDescriptors {
    /// An empty set.
    pub fn new() -> Self {
        Self::default()
    }

    /// Packs all of `descriptors`, in order.
    pub fn pack(descriptors: &[Descriptor]) -> Self {
        let mut packed = Self::new();
        packed.repack(descriptors);
        packed
    }

    /// Packs `descriptors[indices[0]], descriptors[indices[1]], ...`: row r is the descriptor `indices[r]`.
    ///
    /// # Panics
    /// When an index is out of range.
    pub fn pack_subset(descriptors: &[Descriptor], indices: &[u32]) -> Self {
        let mut packed = Self::new();
        packed.repack_subset(descriptors, indices);
        packed
    }

    /// [`PackedDescriptors::pack`] into this set's memory, replacing what it held.
    pub fn repack(&mut self, descriptors: &[Descriptor]) {
        self.fill(descriptors.len(), |row| &descriptors[row]);
    }

    /// [`PackedDescriptors::pack_subset`] into this set's memory, replacing what it held.
    ///
    /// # Panics
    /// When an index is out of range.
    pub fn repack_subset(&mut self, descriptors: &[Descriptor], indices: &[u32]) {
        self.fill(indices.len(), |row| &descriptors[indices[row] as usize]);
    }

    /// Appends rows as [`PackedDescriptors::repack_subset`] packs them, starting with a new group.
    ///
    /// # Panics
    /// When an index is out of range.
    pub(super) fn append_subset(&mut self, descriptors: &[Descriptor], indices: &[u32]) {
        self.append(indices.len(), |row| &descriptors[indices[row] as usize]);
    }

    /// Makes room for so many groups more.
    pub(super) fn reserve_groups(&mut self, groups: usize) {
        self.lines.reserve(groups * QUADS);
        self.biases.reserve(groups * GROUP_ROWS);
        self.short.reserve(groups);
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is no row.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Number of groups, the last one possibly padded.
    pub(super) fn num_groups(&self) -> usize {
        self.biases.len() / GROUP_ROWS
    }

    /// Group `at`.
    #[inline(always)]
    pub(super) fn group(&self, at: usize) -> Group<'_> {
        Group { lines: &self.lines.as_chunks().0[at], short: &self.short[at] }
    }

    fn fill<'a>(&mut self, len: usize, descriptor: impl Fn(usize) -> &'a Descriptor) {
        self.len = 0;
        self.lines.clear();
        self.biases.clear();
        self.short.clear();
        self.append(len, descriptor);
    }

    fn append<'a>(&mut self, len: usize, descriptor: impl Fn(usize) -> &'a Descriptor) {
        const EMPTY: Descriptor = [0; DESCRIPTOR_LEN];
        self.len += len;
        for first in (0..len).step_by(GROUP_ROWS) {
            let rows: [&Descriptor; GROUP_ROWS] =
                std::array::from_fn(|lane| if first + lane < len { descriptor(first + lane) } else { &EMPTY });
            for lane in 0..GROUP_ROWS.min(len.saturating_sub(first + GROUP_ROWS)) {
                fetch_early(descriptor(first + GROUP_ROWS + lane));
            }
            let (mut lines, mut biases) = ([Line([[0; 4]; GROUP_ROWS]); QUADS], [0; GROUP_ROWS]);
            let short = pack_group(&rows, &mut lines, &mut biases);
            biases[(len - first).min(GROUP_ROWS)..].fill(PADDING_BIAS);
            self.lines.extend_from_slice(&lines);
            self.biases.extend_from_slice(&biases);
            self.short.push(short);
        }
    }
}

/// Asks for a descriptor that will be read soon. Subsets are read in an order that no cache foresees, and waiting for them took
/// a third of the time of packing.
#[inline(always)]
pub(super) fn fetch_early(descriptor: &Descriptor) {
    #[cfg(target_arch = "x86_64")]
    {
        use std::arch::x86_64::{_MM_HINT_T0, _mm_prefetch};
        let start = descriptor.as_ptr().cast::<i8>();
        for line in (0..DESCRIPTOR_LEN).step_by(64) {
            // SAFETY: a hint, of an address inside the descriptor.
            unsafe { _mm_prefetch::<_MM_HINT_T0>(start.add(line)) };
        }
    }
    #[cfg(not(target_arch = "x86_64"))]
    let _ = descriptor;
}

/// The lines, biases and the rest of sixteen rows, with the fastest instructions of this machine.
#[inline]
fn pack_group(
    rows: &[&Descriptor; GROUP_ROWS],
    lines: &mut [Line; QUADS],
    biases: &mut [i32; GROUP_ROWS],
) -> ShortSums {
    #[cfg(target_arch = "x86_64")]
    if std::is_x86_feature_detected!("avx2") {
        // SAFETY: the instructions are there.
        return unsafe { super::x86::pack_group(rows, lines, biases) };
    }
    pack_group_plainly(rows, lines, biases)
}

/// [`pack_group`] without special instructions.
pub(super) fn pack_group_plainly(
    rows: &[&Descriptor; GROUP_ROWS],
    lines: &mut [Line; QUADS],
    biases: &mut [i32; GROUP_ROWS],
) -> ShortSums {
    for (quad, line) in lines.iter_mut().enumerate() {
        let at = 4 * quad;
        *line = Line(rows.map(|row| [row[at], row[at + 1], row[at + 2], row[at + 3]]));
    }
    let row_sums = rows.map(sum);
    biases_of(rows, &row_sums, biases);
    let eights = rows.iter().flat_map(|row| row.as_chunks::<8>().0);
    let fours = eights.flat_map(|eight| [0, 2].map(|at| [at, at + 1, at + 4, at + 5].map(|at| i32::from(eight[at]))));
    ShortSums::new(&row_sums, fours.map(|four| four.iter().sum()).max().unwrap_or(0))
}

/// Squared length of a descriptor. At most 128 * 255^2, so wrapping never happens; saying so keeps the loop free of checks.
#[inline(always)]
pub(super) fn norm_sq(descriptor: &Descriptor) -> i32 {
    descriptor
        .iter()
        .fold(0, |sum, &byte| i32::wrapping_add(sum, i32::from(u16::wrapping_mul(byte.into(), byte.into()))))
}

/// The biases of the module's formula, of rows with these sums of bytes.
#[inline(always)]
pub(super) fn biases_of(
    rows: &[&Descriptor; GROUP_ROWS],
    row_sums: &[i32; GROUP_ROWS],
    biases: &mut [i32; GROUP_ROWS],
) {
    for ((bias, row), row_sum) in biases.iter_mut().zip(rows).zip(row_sums) {
        *bias = norm_sq(row) - 2 * i32::from(QUERY_OFFSET) * row_sum;
    }
}

/// The sum of a descriptor's bytes.
#[inline(always)]
pub(super) fn sum(row: &Descriptor) -> i32 {
    row.iter().fold(0, |sum, &byte| i32::wrapping_add(sum, byte.into()))
}
