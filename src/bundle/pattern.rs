//! Where the blocks of the reduced camera system are stored.
//!
//! The system is symmetric; its lower half is stored by columns. A column of a slot holds the rows of all slots that share a
//! point with it (or, dense, of all slots), so a block is found by the position of its first entry and the stride of its
//! column. Every pair of slots that a point joins is looked up once, when the pattern is made: the elimination then reads the
//! positions as a stream, in the order in which it visits the pairs.

use super::problem::{Problem, Slot};

/// Share of the lower half that must be empty for the sparse solution to pay.
const MIN_EMPTY_SHARE: f64 = 0.4;
/// Multiplications of the pair of two poses, for sharing out the work.
const PAIR_WORK: usize = 4;
/// The same for the derivatives of a sighting.
const SIGHTING_WORK: usize = 8;
/// Work below which a part is not worth a thread, and the most parts there are. Both are fixed so that sums are taken in the
/// same order by any number of threads.
const MIN_PART_WORK: usize = 50_000;
const MAX_PARTS: usize = 16;

/// A range of points that one thread eliminates.
#[derive(Clone, Copy, Debug)]
pub(super) struct Part {
    pub first_point: usize,
    pub end_point: usize,
    /// Where its pairs begin in [`Pattern::pairs`].
    pub first_pair: usize,
}

/// Rows of a sparse system, as faer wants them.
pub(super) struct SparseRows {
    pub column_start: Vec<usize>,
    pub rows: Vec<usize>,
    /// Slots joined to each slot, itself and later ones only, ascending.
    pub neighbors: Vec<Vec<u32>>,
}

/// The storage of the reduced system.
pub(super) struct Pattern {
    /// Number of stored values.
    pub num_values: usize,
    /// Distance of neighbouring columns of each slot.
    pub stride: Vec<usize>,
    /// First entry of the block of each slot with itself.
    pub diagonal: Vec<usize>,
    /// First entry of the block of each pose (column) with its camera (row), where both are free.
    pub pose_camera: Vec<usize>,
    /// First entry of the block of every pair of slots of every variable point.
    pub pairs: Vec<u32>,
    /// How the points are shared out.
    pub parts: Vec<Part>,
    /// None when the storage is dense.
    pub sparse: Option<SparseRows>,
}

/// The slots that a point's sightings touch, ascending.
pub(super) fn slots_of_point(problem: &Problem, point: usize, slots: &mut Vec<u32>) {
    slots.clear();
    let range = problem.point_start[point] as usize..problem.point_start[point + 1] as usize;
    let sightings = &problem.sightings[range];
    slots.extend(sightings.iter().filter_map(|seen| problem.poses[seen.pose as usize].slot));
    let num_poses = slots.len();
    for seen in sightings {
        let camera = problem.poses[seen.pose as usize].camera;
        if let Some(slot) = problem.cameras[camera as usize].slot {
            let at = num_poses + slots[num_poses..].partition_point(|&other| other < slot);
            if slots.get(at) != Some(&slot) {
                slots.insert(at, slot);
            }
        }
    }
}

/// Which slots share a point: a bit for every pair, kept for the lower half.
struct Adjacency {
    words: usize,
    bits: Vec<u64>,
}

impl Adjacency {
    fn new(num_slots: usize) -> Self {
        let words = num_slots.div_ceil(64);
        Self { words, bits: vec![0; words * num_slots] }
    }

    fn join(&mut self, column: u32, row: u32) {
        self.bits[column as usize * self.words + row as usize / 64] |= 1 << (row % 64);
    }

    fn rows(&self, column: usize) -> Vec<u32> {
        let words = &self.bits[column * self.words..(column + 1) * self.words];
        (0u32..)
            .zip(words)
            .flat_map(|(word, &bits)| (0..64).filter(move |bit| bits >> bit & 1 == 1).map(move |bit| 64 * word + bit))
            .collect()
    }
}

/// Finds the first entry of a block.
enum Locator<'a> {
    Dense { slots: &'a [Slot], num_unknowns: usize },
    Sparse { adjacency: &'a Adjacency, before_word: Vec<u32>, offsets: Vec<Vec<u32>>, first: Vec<usize> },
}

impl Locator<'_> {
    fn find(&self, column: u32, row: u32) -> usize {
        match self {
            Self::Dense { slots, num_unknowns } => {
                slots[column as usize].first * num_unknowns + slots[row as usize].first
            }
            Self::Sparse { adjacency, before_word, offsets, first } => {
                let word = column as usize * adjacency.words + row as usize / 64;
                let below = adjacency.bits[word] & ((1u64 << (row % 64)) - 1);
                let rank = before_word[word] + below.count_ones();
                first[column as usize] + offsets[column as usize][rank as usize] as usize
            }
        }
    }
}

impl Pattern {
    /// The pattern of a problem; sparse where there are more unknowns than `max_dense_unknowns` and enough blocks are empty.
    pub fn new(problem: &Problem, max_dense_unknowns: usize) -> Self {
        let num_slots = problem.slots.len();
        let n = problem.num_unknowns;
        let mut slots = Vec::new();
        let mut adjacency = Adjacency::new(if n > max_dense_unknowns { num_slots } else { 0 });
        let mut neighbors: Option<Vec<Vec<u32>>> = None;
        if n > max_dense_unknowns {
            for slot in 0..num_slots as u32 {
                adjacency.join(slot, slot);
            }
            for pose in &problem.poses {
                if let (Some(pose), Some(camera)) = (pose.slot, problem.cameras[pose.camera as usize].slot) {
                    adjacency.join(pose, camera);
                }
            }
            for point in (0..problem.point_ids.len()).filter(|&point| problem.point_is_variable[point]) {
                slots_of_point(problem, point, &mut slots);
                for (at, &column) in slots.iter().enumerate() {
                    for &row in &slots[at..] {
                        adjacency.join(column, row);
                    }
                }
            }
            let lists: Vec<Vec<u32>> = (0..num_slots).map(|column| adjacency.rows(column)).collect();
            let filled: usize = lists
                .iter()
                .zip(&problem.slots)
                .map(|(rows, slot)| slot.len * rows.iter().map(|&row| problem.slots[row as usize].len).sum::<usize>())
                .sum();
            if (filled as f64) < (1.0 - MIN_EMPTY_SHARE) * 0.5 * (n * n) as f64 {
                neighbors = Some(lists);
            }
        }
        match neighbors {
            None => {
                let locator = Locator::Dense { slots: &problem.slots, num_unknowns: n };
                Self::fill(problem, n * n, vec![n; num_slots], &locator, None)
            }
            Some(neighbors) => Self::sparse(problem, &adjacency, neighbors),
        }
    }

    /// Makes row and column of an unknown those of the identity: the unknown is held.
    pub fn isolate(&self, problem: &Problem, unknown: usize, values: &mut [f64]) {
        let n = problem.num_unknowns;
        match &self.sparse {
            None => {
                for other in 0..n {
                    values[other * n + unknown] = 0.0;
                    values[unknown * n + other] = 0.0;
                }
                values[unknown * n + unknown] = 1.0;
            }
            Some(sparse) => {
                for column in 0..n {
                    let range = sparse.column_start[column]..sparse.column_start[column + 1];
                    for (row, value) in sparse.rows[range.clone()].iter().zip(&mut values[range]) {
                        if *row == unknown || column == unknown {
                            *value = if *row == column { 1.0 } else { 0.0 };
                        }
                    }
                }
            }
        }
    }

    fn sparse(problem: &Problem, adjacency: &Adjacency, neighbors: Vec<Vec<u32>>) -> Self {
        let mut stride = Vec::new();
        let mut first = Vec::new();
        let mut offsets = Vec::new();
        let (mut column_start, mut rows, mut num_values) = (vec![0], Vec::new(), 0);
        for (slot, joined) in problem.slots.iter().zip(&neighbors) {
            let mut height = 0;
            let mut offset = Vec::with_capacity(joined.len());
            for &row in joined {
                offset.push(height as u32);
                height += problem.slots[row as usize].len;
            }
            first.push(num_values);
            stride.push(height);
            offsets.push(offset);
            num_values += height * slot.len;
            for _ in 0..slot.len {
                for &row in joined {
                    let block = problem.slots[row as usize];
                    rows.extend(block.first..block.first + block.len);
                }
                column_start.push(rows.len());
            }
        }
        let mut before_word = vec![0; adjacency.bits.len()];
        for column in 0..problem.slots.len() {
            let mut before = 0;
            let range = column * adjacency.words..(column + 1) * adjacency.words;
            for (before_word, word) in before_word[range.clone()].iter_mut().zip(&adjacency.bits[range]) {
                *before_word = before;
                before += word.count_ones();
            }
        }
        let locator = Locator::Sparse { adjacency, before_word, offsets, first };
        Self::fill(problem, num_values, stride, &locator, Some(SparseRows { column_start, rows, neighbors }))
    }

    fn fill(
        problem: &Problem,
        num_values: usize,
        stride: Vec<usize>,
        locator: &Locator<'_>,
        sparse: Option<SparseRows>,
    ) -> Self {
        let diagonal = (0..problem.slots.len() as u32).map(|slot| locator.find(slot, slot)).collect();
        let pose_camera = problem
            .poses
            .iter()
            .map(|pose| match (pose.slot, problem.cameras[pose.camera as usize].slot) {
                (Some(pose), Some(camera)) => locator.find(pose, camera),
                _ => 0,
            })
            .collect();
        let mut slots = Vec::new();
        let mut pairs = Vec::new();
        let mut pair_start = Vec::with_capacity(problem.point_ids.len());
        let mut work = Vec::with_capacity(problem.point_ids.len());
        for point in 0..problem.point_ids.len() {
            pair_start.push(pairs.len());
            if problem.point_is_variable[point] {
                slots_of_point(problem, point, &mut slots);
                for (at, &column) in slots.iter().enumerate() {
                    pairs.extend(slots[at..].iter().map(|&row| locator.find(column, row) as u32));
                }
            }
            let sightings = (problem.point_start[point + 1] - problem.point_start[point]) as usize;
            work.push(SIGHTING_WORK * sightings + PAIR_WORK * (pairs.len() - pair_start[point]));
        }
        let parts = share_out(&work, &pair_start, num_values);
        Self { num_values, stride, diagonal, pose_camera, pairs, parts, sparse }
    }
}

/// Cuts the points into parts of about equal work.
fn share_out(work: &[usize], pair_start: &[usize], num_values: usize) -> Vec<Part> {
    let total: usize = work.iter().sum();
    let count = (total / MIN_PART_WORK.max(num_values)).clamp(1, MAX_PARTS);
    let mut parts: Vec<Part> = Vec::with_capacity(count);
    let (mut first_point, mut done) = (0, 0);
    for (point, work) in work.iter().enumerate() {
        done += work;
        if done * count >= total * (parts.len() + 1) || point + 1 == pair_start.len() {
            parts.push(Part { first_point, end_point: point + 1, first_pair: pair_start[first_point] });
            first_point = point + 1;
        }
    }
    parts
}
