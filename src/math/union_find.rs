//! Disjoint sets with path halving and union by size.

/// A partition of `0..n`.
#[derive(Clone, Debug)]
pub struct UnionFind {
    parent: Vec<u32>,
    size: Vec<u32>,
}

impl UnionFind {
    /// `n` singletons.
    pub fn new(n: usize) -> Self {
        Self { parent: (0..n as u32).collect(), size: vec![1; n] }
    }

    /// The representative of the set of `item`.
    pub fn find(&mut self, item: usize) -> usize {
        let mut item = item as u32;
        while self.parent[item as usize] != item {
            let grandparent = self.parent[self.parent[item as usize] as usize];
            self.parent[item as usize] = grandparent;
            item = grandparent;
        }
        item as usize
    }

    /// Joins the sets of `a` and `b`; false when they were one already.
    pub fn union(&mut self, a: usize, b: usize) -> bool {
        let (a, b) = (self.find(a), self.find(b));
        if a == b {
            return false;
        }
        let (large, small) = if (self.size[a], b) >= (self.size[b], a) { (a, b) } else { (b, a) };
        self.parent[small] = large as u32;
        self.size[large] += self.size[small];
        true
    }

    /// The number of items in the set of `item`.
    pub fn size_of(&mut self, item: usize) -> usize {
        let root = self.find(item);
        self.size[root] as usize
    }

    /// All sets, each in ascending order, ordered by their smallest item.
    pub fn sets(&mut self) -> Vec<Vec<usize>> {
        let n = self.parent.len();
        let mut rank_of_root = vec![None; n];
        let mut sets: Vec<Vec<usize>> = Vec::new();
        for item in 0..n {
            let root = self.find(item);
            let rank = *rank_of_root[root].get_or_insert_with(|| {
                sets.push(Vec::new());
                sets.len() - 1
            });
            sets[rank].push(item);
        }
        sets
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn joins_and_lists() {
        let mut sets = UnionFind::new(6);
        assert!(sets.union(0, 3) && sets.union(3, 5) && !sets.union(0, 5));
        assert_eq!(sets.sets(), vec![vec![0, 3, 5], vec![1], vec![2], vec![4]]);
        assert_eq!(sets.size_of(5), 3);
    }
}
