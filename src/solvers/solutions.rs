//! What a minimal solver returns: a few candidates, without allocation.

/// At most `N` candidates.
#[derive(Clone, Copy, Debug)]
pub struct Solutions<T, const N: usize> {
    items: [Option<T>; N],
    len: usize,
}

impl<T: Copy, const N: usize> Default for Solutions<T, N> {
    fn default() -> Self {
        Self { items: [None; N], len: 0 }
    }
}

impl<T: Copy, const N: usize> Solutions<T, N> {
    /// Adds a candidate; beyond `N` it is dropped.
    pub fn push(&mut self, item: T) {
        if self.len < N {
            self.items[self.len] = Some(item);
            self.len += 1;
        }
    }

    /// Number of candidates.
    pub fn len(&self) -> usize {
        self.len
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.len == 0
    }

    /// Forgets all candidates.
    pub fn clear(&mut self) {
        self.len = 0;
    }

    /// The candidates.
    pub fn iter(&self) -> impl Iterator<Item = &T> {
        self.items[..self.len].iter().flatten()
    }
}
