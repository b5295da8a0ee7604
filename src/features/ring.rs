//! The most recent rows of an image that is made row by row.

/// Rows are stored in multiples of this many values, so kernels work on whole blocks; values beyond the width mean nothing.
pub(super) const BLOCK: usize = 32;

/// `length` rounded up to whole blocks.
pub(super) fn padded(length: usize) -> usize {
    length.next_multiple_of(BLOCK)
}

/// The last `capacity` rows of an image.
pub(super) struct Ring<T = f32> {
    /// Values a row takes: whole blocks and a block of margin, so that a stretch of whole blocks may start at any pixel.
    stride: usize,
    capacity: usize,
    next: usize,
    data: Vec<T>,
}

impl<T: Copy + Default> Ring<T> {
    /// An empty ring for rows of `width` values.
    pub(super) fn new(width: usize, capacity: usize) -> Self {
        let stride = padded(width) + BLOCK;
        Self { stride, capacity, next: 0, data: vec![T::default(); stride * capacity] }
    }

    /// Number of rows pushed so far, the index of the next.
    pub(super) fn next(&self) -> usize {
        self.next
    }

    /// Row `y` with its padding, which must be among the last `capacity`.
    #[inline]
    pub(super) fn row(&self, y: usize) -> &[T] {
        debug_assert!(y < self.next && y + self.capacity >= self.next, "row {y} of {} is gone", self.next);
        let start = (y % self.capacity) * self.stride;
        &self.data[start..start + self.stride - BLOCK]
    }

    /// `length` values of row `y` from column `from` on, which may end in the margin.
    #[inline]
    pub(super) fn stretch(&self, y: usize, from: usize, length: usize) -> &[T] {
        debug_assert!(y < self.next && y + self.capacity >= self.next && from + length <= self.stride);
        let start = (y % self.capacity) * self.stride + from;
        &self.data[start..start + length]
    }

    /// All that is stored, how many values a row takes, and the capacity: row `y` is stored as row `y % capacity`.
    pub(super) fn stored(&self) -> (&[T], usize, usize) {
        (&self.data, self.stride, self.capacity)
    }

    /// Makes room for the next `count` rows (fewer than the capacity) and returns them in order, to be filled.
    pub(super) fn push_rows(&mut self, count: usize) -> Vec<&mut [T]> {
        let first = self.next % self.capacity;
        self.next += count;
        let length = self.stride - BLOCK;
        let (before, from) = self.data.split_at_mut(first * self.stride);
        let rows = from.chunks_exact_mut(self.stride).chain(before.chunks_exact_mut(self.stride));
        rows.take(count).map(|row| &mut row[..length]).collect()
    }

    /// Makes room for the next row and returns it, to be filled.
    pub(super) fn push(&mut self) -> &mut [T] {
        let start = (self.next % self.capacity) * self.stride;
        self.next += 1;
        &mut self.data[start..start + self.stride - BLOCK]
    }
}
