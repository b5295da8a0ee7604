//! Matching of large sets of descriptors by cells: a fraction of the comparisons, and nothing found that exact matching would not
//! find.
//!
//! Descriptor space is divided into the cells of the nearest of some typical descriptors, the [`Codebook`], which k-means finds
//! among the set's own (the inverted file of Sivic, Zisserman, "Video Google", ICCV 2003; with several cells visited, Jégou,
//! Douze, Schmid, "Product quantization for nearest neighbor search", PAMI 2011). A descriptor is compared with those of the
//! cells nearest to it alone. What so passes the ratio test and the cross-check is then compared with all: whatever is the
//! nearest of all is also the nearest of some, and a second nearest of some is never nearer than that of all, so these
//! tests never refuse a match that exact matching finds among the visited cells; the second comparison refuses those
//! that it wouldn't. Left out are the matches whose cell is not visited.
//!
//! Of the matches of 40 pairs of photographs with 7,000 to 13,000 descriptors, visits to 8 of 128 cells found 98 %, in a fourteenth
//! of the comparisons; to 4 of 128 92 %, to 8 of 256 96 %, and to 8 of 64 99 %, in a seventh. Beyond comparing, a visit
//! costs as much as some hundred comparisons: five visits take a third less time than eight and find 2 % fewer matches,
//! which no model here showed.

use serde::{Deserialize, Serialize};

use super::clusters::k_means;
use super::descriptor::{CellRows, PackedDescriptors, Top2, distances_sq, top2_in_cells};
use super::{MatchOptions, RatioTest};
use crate::math::Grouped;
use crate::scene::{Descriptor, KeypointIdx};

/// How descriptor space is divided.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CellOptions {
    /// One cell for so many descriptors of an image. Lower: fewer comparisons, and more matches missed; below some 32, groups of
    /// sixteen are half empty.
    pub descriptors_per_cell: usize,
    /// Never more cells than this.
    pub max_cells: usize,
    /// Cells that a descriptor is compared with. More: fewer matches missed, and more comparisons.
    pub visited: usize,
    /// Rounds of k-means.
    pub rounds: usize,
    /// For every cell, descriptors that the cells are found from, of all images together.
    pub sample_per_cell: usize,
}

impl Default for CellOptions {
    fn default() -> Self {
        Self { descriptors_per_cell: 40, max_cells: 128, visited: 5, rounds: 8, sample_per_cell: 128 }
    }
}

impl CellOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        for (name, value) in [
            ("descriptors_per_cell", self.descriptors_per_cell),
            ("max_cells", self.max_cells),
            ("visited", self.visited),
            ("sample_per_cell", self.sample_per_cell),
        ] {
            if value == 0 {
                errors.push(format!("{name} must be at least 1"));
            }
        }
    }

    /// Number of cells for images of so many descriptors.
    pub fn num_cells(&self, descriptors: usize) -> usize {
        (descriptors / self.descriptors_per_cell).clamp(1, self.max_cells)
    }
}

/// The typical descriptors whose cells divide descriptor space.
#[derive(Clone, Debug)]
pub struct Codebook {
    words: PackedDescriptors,
    visited: usize,
}

impl Codebook {
    /// Of at most `num_cells` cells, from a sample; none where that is empty.
    pub fn train(sample: &[Descriptor], num_cells: usize, options: &CellOptions) -> Option<Self> {
        let words = PackedDescriptors::pack(&k_means(sample, num_cells, options.rounds));
        let visited = options.visited.min(words.len());
        (!words.is_empty()).then_some(Self { words, visited })
    }

    /// The cells that each descriptor visits, `visited` of them, its own first.
    fn visits(&self, descriptors: &[Descriptor]) -> Vec<u32> {
        /// Descriptors whose distances are held at a time.
        const AT_A_TIME: usize = 256;
        let mut visits = Vec::with_capacity(self.visited * descriptors.len());
        let (mut distances, mut ranked) = (Vec::new(), Vec::new());
        for some in descriptors.chunks(AT_A_TIME) {
            distances_sq(some, &self.words, &mut distances);
            for of_one in distances.chunks(self.words.len()) {
                ranked.clear();
                ranked.extend(of_one.iter().copied().zip(0u32..));
                ranked.select_nth_unstable(self.visited - 1);
                ranked[..self.visited].sort_unstable();
                visits.extend(ranked[..self.visited].iter().map(|&(_, cell)| cell));
            }
        }
        visits
    }
}

/// An image's descriptors by cell, ready to be either side of a pair. Built once per image.
#[derive(Clone, Debug)]
pub struct CelledDescriptors {
    visitors: Grouped<u32>,
    rows: CellRows,
}

impl CelledDescriptors {
    /// Divides them.
    pub fn new(descriptors: &[Descriptor], codebook: &Codebook) -> Self {
        let (num_cells, visits) = (codebook.words.len(), codebook.visits(descriptors));
        let visits = (0u32..).zip(visits.chunks(codebook.visited));
        let all = visits.clone().flat_map(|(rank, cells)| cells.iter().map(move |&cell| (cell, rank)));
        let own = visits.map(|(rank, cells)| (cells[0], rank));
        Self {
            visitors: Grouped::new(num_cells, all),
            rows: CellRows::pack(descriptors, &Grouped::new(num_cells, own)),
        }
    }
}

/// Of the matches of [`super::match_mutual`] those whose b lies in a cell that a visits, sorted by the first index. Both sides
/// were divided by one codebook.
pub fn match_in_cells(
    (descriptors_a, a): (&[Descriptor], &CelledDescriptors),
    (descriptors_b, b): (&[Descriptor], &CelledDescriptors),
    options: &MatchOptions,
) -> Vec<(KeypointIdx, KeypointIdx)> {
    let test = options.test();
    let (mut of_a, mut of_slots) = (Vec::new(), Vec::new());
    top2_in_cells(descriptors_a, &a.visitors, &b.rows, &mut of_a, &mut of_slots);
    let agreed = |rank: u32, found: &Top2| {
        !options.cross_check
            || of_slots[found.index as usize].is_some_and(|back| back.index == rank && test.accepts(&back))
    };
    let in_cells = (0u32..).zip(&of_a).filter_map(|(rank, found)| Some((rank, (*found)?)));
    let in_cells = in_cells.filter(|(rank, found)| test.accepts(found) && agreed(*rank, found));
    let mut matches: Vec<(u32, u32)> = in_cells.map(|(rank, found)| (rank, b.rows.rank(found.index))).collect();
    keep_nearest_of_all(&mut matches, (descriptors_a, &b.rows), |&(in_a, in_b)| (in_a, in_b), &test);
    if options.cross_check {
        keep_nearest_of_all(&mut matches, (descriptors_b, &a.rows), |&(in_a, in_b)| (in_b, in_a), &test);
    }
    matches.into_iter().map(|(in_a, in_b)| (KeypointIdx(in_a), KeypointIdx(in_b))).collect()
}

/// Keeps those matches whose row is the nearest of all rows to its query and passes the test.
fn keep_nearest_of_all(
    matches: &mut Vec<(u32, u32)>,
    (queries, rows): (&[Descriptor], &CellRows),
    query_and_row: impl Fn(&(u32, u32)) -> (u32, u32),
    test: &RatioTest,
) {
    let doubted: Vec<Descriptor> = matches.iter().map(|pair| queries[query_and_row(pair).0 as usize]).collect();
    let mut nearest = Vec::new();
    rows.top2(&doubted, &mut nearest);
    let mut nearest = nearest.iter();
    matches.retain(|pair| {
        nearest.next().is_some_and(|found| rows.rank(found.index) == query_and_row(pair).1 && test.accepts(found))
    });
}

#[cfg(test)]
mod tests {
    use super::super::match_mutual;
    use super::*;
    use crate::math::Rng;

    /// Two sets of which two thirds are sightings of the same things, of twenty kinds that are much alike.
    fn sightings(rng: &mut Rng) -> [Vec<Descriptor>; 2] {
        let kinds: Vec<Descriptor> = (0..20).map(|_| std::array::from_fn(|_| rng.below(150) as u8)).collect();
        let mut thing = |kind: usize| -> Descriptor { kinds[kind].map(|byte| byte + rng.below(60) as u8) };
        let things: Vec<Descriptor> = (0..2400).map(|at| thing(at % 20)).collect();
        let mut of = |range: std::ops::Range<usize>| -> Vec<Descriptor> {
            let mut seen: Vec<Descriptor> =
                things[range].iter().map(|thing| thing.map(|byte| byte + rng.below(30) as u8)).collect();
            rng.shuffle(&mut seen);
            seen
        };
        [of(0..1800), of(600..2400)]
    }

    fn celled(descriptors: &[Descriptor], codebook: &Codebook) -> CelledDescriptors {
        CelledDescriptors::new(descriptors, codebook)
    }

    #[test]
    fn nearly_all_matches_and_no_others_are_found() {
        let [a, b] = sightings(&mut Rng::from_parts(&[21]));
        let options = CellOptions { visited: 4, ..CellOptions::default() };
        let codebook = Codebook::train(&a[..900], options.num_cells(a.len()), &options).unwrap();
        assert_eq!(codebook.words.len(), 45);
        for cross_check in [true, false] {
            // Few are told apart from others of their kind at this ratio, and more when compared with some alone.
            let matching = MatchOptions { ratio: 0.6, cross_check, ..MatchOptions::default() };
            let exact = match_mutual(&a, &b, &matching);
            let found = match_in_cells((&a, &celled(&a, &codebook)), (&b, &celled(&b, &codebook)), &matching);
            assert!(exact.len() > 300, "{}", exact.len());
            assert!(found.iter().all(|pair| exact.contains(pair)));
            assert!(found.len() as f64 > 0.95 * exact.len() as f64, "{} of {}", found.len(), exact.len());
            assert!(found.is_sorted());
        }
    }

    #[test]
    fn visits_to_all_cells_find_all() {
        let [a, b] = sightings(&mut Rng::from_parts(&[22]));
        let options = CellOptions { visited: 100, ..CellOptions::default() };
        let codebook = Codebook::train(&b, 10, &options).unwrap();
        assert_eq!((codebook.words.len(), codebook.visited), (10, 10));
        let matching = MatchOptions::default();
        let found = match_in_cells((&a, &celled(&a, &codebook)), (&b, &celled(&b, &codebook)), &matching);
        assert_eq!(found, match_mutual(&a, &b, &matching));
    }

    #[test]
    fn a_descriptor_visits_the_nearest_cells_its_own_first() {
        let spike = |at: usize, byte: u8| -> Descriptor { std::array::from_fn(|i| if i == at { byte } else { 0 }) };
        let words: Vec<Descriptor> = [10, 20, 40, 80].map(|byte| spike(0, byte)).to_vec();
        let codebook = Codebook { words: PackedDescriptors::pack(&words), visited: 2 };
        assert_eq!(codebook.visits(&[spike(0, 12), spike(0, 38), spike(0, 255)]), [0, 1, 2, 1, 3, 2]);
    }

    #[test]
    fn nothing_gives_nothing() {
        let options = CellOptions::default();
        assert!(Codebook::train(&[], 5, &options).is_none());
        let some = vec![[1; crate::scene::DESCRIPTOR_LEN]; 3];
        let codebook = Codebook::train(&some, 5, &options).unwrap();
        let (none, three) = (celled(&[], &codebook), celled(&some, &codebook));
        let matching = MatchOptions::default();
        assert!(match_in_cells((&[], &none), (&some, &three), &matching).is_empty());
        assert!(match_in_cells((&some, &three), (&[], &none), &matching).is_empty());
    }
}
