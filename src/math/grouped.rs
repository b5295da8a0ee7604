//! Items by groups.

/// Items by their groups, one after the other, in the order in which they came.
#[derive(Clone, Debug)]
pub struct Grouped<T> {
    /// Group g is `items[starts[g]..starts[g + 1]]`.
    starts: Vec<u32>,
    items: Vec<T>,
}

impl<T: Copy> Grouped<T> {
    /// Of `count` groups, from pairs of group and item.
    ///
    /// # Panics
    /// When a group is out of range.
    pub fn new(count: usize, grouped: impl Iterator<Item = (u32, T)> + Clone) -> Self {
        let mut starts = vec![0; count + 1];
        for (group, _) in grouped.clone() {
            starts[group as usize + 1] += 1;
        }
        for at in 0..count {
            starts[at + 1] += starts[at];
        }
        let mut items: Vec<T> = grouped.clone().map(|(_, item)| item).collect();
        let mut next = starts.clone();
        for (group, item) in grouped {
            let place = &mut next[group as usize];
            items[*place as usize] = item;
            *place += 1;
        }
        Self { starts, items }
    }

    /// Number of groups.
    pub fn num_groups(&self) -> usize {
        self.starts.len() - 1
    }

    /// Number of items.
    pub fn num_items(&self) -> usize {
        self.items.len()
    }

    /// The items of a group.
    ///
    /// # Panics
    /// When it is out of range.
    pub fn group(&self, group: usize) -> &[T] {
        &self.items[self.starts[group] as usize..self.starts[group + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn items_keep_their_order_within_groups() {
        let grouped = Grouped::new(4, [(2, 'c'), (0, 'b'), (2, 'a'), (0, 'd'), (3, 'e')].into_iter());
        assert_eq!((grouped.num_groups(), grouped.num_items()), (4, 5));
        let groups: Vec<&[char]> = (0..4).map(|group| grouped.group(group)).collect();
        assert_eq!(groups, [&['b', 'd'][..], &[], &['c', 'a'], &['e']]);
    }

    #[test]
    fn nothing_gives_empty_groups() {
        let grouped = Grouped::<u32>::new(2, std::iter::empty());
        assert_eq!((grouped.num_groups(), grouped.group(1).len()), (2, 0));
    }
}
