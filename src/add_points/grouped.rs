//! Items by groups.

/// Items by their groups, one after the other, ascending.
pub(super) struct Grouped<T> {
    /// Group g is `items[starts[g]..starts[g + 1]]`.
    starts: Vec<u32>,
    items: Vec<T>,
}

impl<T: Ord> Grouped<T> {
    /// Of `count` groups, from pairs of group and item.
    pub(super) fn new(count: usize, mut grouped: Vec<(u32, T)>) -> Self {
        grouped.sort_unstable();
        let mut starts = vec![0; count + 1];
        for (group, _) in &grouped {
            starts[*group as usize + 1] += 1;
        }
        for at in 0..count {
            starts[at + 1] += starts[at];
        }
        Self { starts, items: grouped.into_iter().map(|(_, item)| item).collect() }
    }

    /// Number of groups.
    pub(super) fn len(&self) -> usize {
        self.starts.len() - 1
    }

    /// The items of a group.
    pub(super) fn group(&self, group: usize) -> &[T] {
        &self.items[self.starts[group] as usize..self.starts[group + 1] as usize]
    }
}
