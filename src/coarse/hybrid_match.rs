//! Hybrid matching of the coarse features of two images (paper, section 4).
//!
//! The first half of the query's selected features (the top 10 % by scale, when 20 % are selected) is matched with all
//! selected features of the reference. Only if that gives more than a few matches is the second half matched too, so most
//! pairs that do not overlap cost half; matching may also end there when the matches are enough for a geometry. Images of
//! few features are matched in one go.
//!
//! Where many features are selected, they are matched by cells (`matching::cells`), all at once, as that costs less than
//! the first half does otherwise; the first half's matches still decide on the pair.
//!
//! Departures: neighbours are exact instead of approximate, and the cross-check runs over all features matched so far, so
//! a pair that goes through both batches has exactly the matches of an ordinary mutual matching.

use serde::{Deserialize, Serialize};

use crate::matching::cells::{CellOptions, CelledDescriptors, Codebook, match_in_cells};
use crate::matching::descriptor::{PackedDescriptors, Top2, top2_both};
use crate::matching::{MatchOptions, mutual_matches};
use crate::scene::{Descriptor, KeypointIdx};

/// How coarse features are matched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct HybridMatchOptions {
    /// Ratio test and cross-check.
    pub matching: MatchOptions,
    /// Match in two batches; otherwise all at once.
    pub two_batches: bool,
    /// The second batch follows only when the first gives more matches than this. 4 in the paper.
    pub gate_matches: usize,
    /// Leave the second batch out when the first gives at least this many matches; null to match it always. Saves half the
    /// time of the pairs that overlap most, and costs tracks where they are longest, so it is off by default. Named by
    /// the paper without a number.
    pub sufficient_matches: Option<usize>,
    /// An image with fewer selected features than this is matched all at once. 1000 in the paper.
    pub one_batch_below: usize,
    /// How many selected features are matched; null to compare each with all, always. Ours.
    pub cells: Option<CellOptions>,
    /// Sets are matched by cells when this many features are selected of any image.
    pub cells_from: usize,
}

impl Default for HybridMatchOptions {
    fn default() -> Self {
        Self {
            matching: MatchOptions::default(),
            two_batches: true,
            gate_matches: 4,
            sufficient_matches: None,
            one_batch_below: 1000,
            cells: Some(CellOptions::default()),
            cells_from: 1000,
        }
    }
}

impl HybridMatchOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.matching.validate(errors);
        if let Some(cells) = &self.cells {
            cells.validate(errors);
        }
        if self.sufficient_matches.is_some_and(|sufficient| sufficient <= self.gate_matches) {
            errors.push(format!("sufficient_matches must be above gate_matches ({})", self.gate_matches));
        }
    }

    /// How far a pair goes whose first batch gave so many matches.
    fn extent_after_first(&self, matches: usize, is_all: bool) -> HybridExtent {
        if is_all {
            HybridExtent::Complete
        } else if matches <= self.gate_matches {
            HybridExtent::StoppedAtGate
        } else if self.sufficient_matches.is_some_and(|sufficient| matches >= sufficient) {
            HybridExtent::StoppedSufficient
        } else {
            HybridExtent::Complete
        }
    }
}

/// The selected descriptors of an image, ready to be either side of a pair. Built once per image.
#[derive(Clone, Debug)]
pub struct CoarseDescriptors {
    descriptors: Vec<Descriptor>,
    layout: Layout,
}

/// How descriptors are laid out for matching.
#[derive(Clone, Debug)]
enum Layout {
    /// In order.
    Whole(PackedDescriptors),
    /// By cell.
    Celled(CelledDescriptors),
}

impl CoarseDescriptors {
    /// From the selected descriptors (the first of the image, which are sorted by descending scale); by the cells of a codebook
    /// where there is one, which must then be that of all images.
    pub fn new(selected: &[Descriptor], codebook: Option<&Codebook>) -> Self {
        let layout = match codebook {
            Some(codebook) => Layout::Celled(CelledDescriptors::new(selected, codebook)),
            None => Layout::Whole(PackedDescriptors::pack(selected)),
        };
        Self { descriptors: selected.to_vec(), layout }
    }

    /// Number of selected descriptors.
    pub fn len(&self) -> usize {
        self.descriptors.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.descriptors.is_empty()
    }

    /// The selected descriptors.
    pub fn descriptors(&self) -> &[Descriptor] {
        &self.descriptors
    }
}

/// How far the matching of a pair went.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum HybridExtent {
    /// The first batch gave too few matches.
    StoppedAtGate,
    /// The first batch gave enough.
    StoppedSufficient,
    /// All selected features were matched.
    Complete,
}

/// The matches of a pair.
#[derive(Clone, Debug, PartialEq)]
pub struct HybridMatches {
    /// (query, reference) keypoints, sorted.
    pub matches: Vec<(KeypointIdx, KeypointIdx)>,
    /// How far it went.
    pub extent: HybridExtent,
}

/// Matches the coarse features of two images.
///
/// # Panics
/// When one is laid out by cells and the other is not.
pub fn match_hybrid(
    query: &CoarseDescriptors,
    reference: &CoarseDescriptors,
    options: &HybridMatchOptions,
) -> HybridMatches {
    let one_batch = !options.two_batches || query.len().min(reference.len()) < options.one_batch_below;
    let first_batch = if one_batch { query.len() } else { query.len().div_ceil(2) };
    match (&query.layout, &reference.layout) {
        (Layout::Celled(in_query), Layout::Celled(in_reference)) => {
            let (query, reference) = ((query.descriptors(), in_query), (reference.descriptors(), in_reference));
            let mut matches = match_in_cells(query, reference, &options.matching);
            let in_first = matches.partition_point(|(keypoint, _)| keypoint.index() < first_batch);
            let extent = options.extent_after_first(in_first, one_batch);
            if extent != HybridExtent::Complete {
                matches.truncate(in_first);
            }
            HybridMatches { matches, extent }
        }
        (Layout::Whole(_), Layout::Whole(reference)) => {
            match_whole(&query.descriptors, first_batch, reference, options)
        }
        _ => panic!("descriptors by cells are matched with such alone"),
    }
}

/// Matches the first batch with all of the reference, and, if that says so, the second.
fn match_whole(
    query: &[Descriptor],
    first_batch: usize,
    reference: &PackedDescriptors,
    options: &HybridMatchOptions,
) -> HybridMatches {
    let (first, second) = query.split_at(first_batch);
    let (mut of_query, mut of_reference) = (Vec::new(), Vec::new());
    top2_both(first, reference, &mut of_query, &mut of_reference);
    let test = options.matching.test();
    let matches_of = |of_query: &[Top2], of_reference: &[Top2]| {
        mutual_matches(of_query, options.matching.cross_check.then_some(of_reference), &test)
    };
    let matches = matches_of(&of_query, &of_reference);
    let extent = options.extent_after_first(matches.len(), second.is_empty());
    if extent != HybridExtent::Complete || second.is_empty() {
        return HybridMatches { matches, extent };
    }
    let (mut of_second, mut of_reference_later) = (Vec::new(), Vec::new());
    top2_both(second, reference, &mut of_second, &mut of_reference_later);
    of_query.append(&mut of_second);
    for (found, mut later) in of_reference.iter_mut().zip(of_reference_later) {
        later.index += first.len() as u32;
        *found = found.joined_with(later);
    }
    HybridMatches { matches: matches_of(&of_query, &of_reference), extent: HybridExtent::Complete }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::matching::match_mutual;
    use crate::math::Rng;

    /// `n` unlike descriptors.
    fn random(rng: &mut Rng, n: usize) -> Vec<Descriptor> {
        (0..n).map(|_| std::array::from_fn(|_| rng.below(91) as u8)).collect()
    }

    /// A copy with a little noise.
    fn sighting(descriptor: &Descriptor, rng: &mut Rng) -> Descriptor {
        descriptor.map(|byte| byte.saturating_add(rng.below(9) as u8))
    }

    /// Two images of 1200 features of which `overlaps` (ranks in both) look alike.
    fn pair(overlaps: impl Fn(usize) -> bool) -> (CoarseDescriptors, CoarseDescriptors) {
        let mut rng = Rng::from_parts(&[3]);
        let query = random(&mut rng, 1200);
        let mut reference = random(&mut rng, 1200);
        for rank in (0..1200).filter(|&rank| overlaps(rank)) {
            reference[rank] = sighting(&query[rank], &mut rng);
        }
        (CoarseDescriptors::new(&query, None), CoarseDescriptors::new(&reference, None))
    }

    #[test]
    fn a_complete_pair_has_the_ordinary_matches() {
        let (query, reference) = pair(|rank| rank % 3 == 0);
        for cross_check in [true, false] {
            let matching = MatchOptions { cross_check, ..MatchOptions::default() };
            let found = match_hybrid(
                &query,
                &reference,
                &HybridMatchOptions { matching: matching.clone(), ..Default::default() },
            );
            assert_eq!(found.extent, HybridExtent::Complete);
            assert_eq!(found.matches.len(), 400);
            assert_eq!(found.matches, match_mutual(query.descriptors(), reference.descriptors(), &matching));
        }
    }

    #[test]
    fn by_cells_the_first_half_decides_too() {
        let cells = CellOptions { visited: 1000, ..CellOptions::default() };
        for (first_half, extent, count) in [(4, HybridExtent::StoppedAtGate, 4), (5, HybridExtent::Complete, 205)] {
            let (query, reference) = pair(|rank| rank < first_half || rank >= 1000);
            let codebook = Codebook::train(query.descriptors(), 8, &cells);
            let by_cells = |image: &CoarseDescriptors| CoarseDescriptors::new(image.descriptors(), codebook.as_ref());
            let found = match_hybrid(&by_cells(&query), &by_cells(&reference), &HybridMatchOptions::default());
            assert_eq!((found.extent, found.matches.len()), (extent, count));
            assert_eq!(found.matches, match_hybrid(&query, &reference, &HybridMatchOptions::default()).matches);
        }
    }

    #[test]
    fn the_gate_wants_more_than_four() {
        let matches_with = |first_half: usize| {
            let (query, reference) = pair(|rank| rank < first_half || rank >= 1000);
            match_hybrid(&query, &reference, &HybridMatchOptions::default())
        };
        let (four, five) = (matches_with(4), matches_with(5));
        assert_eq!((four.extent, four.matches.len()), (HybridExtent::StoppedAtGate, 4));
        assert_eq!((five.extent, five.matches.len()), (HybridExtent::Complete, 205));
    }

    #[test]
    fn matching_ends_early_when_asked_to() {
        let (query, reference) = pair(|_| true);
        let options = HybridMatchOptions { sufficient_matches: Some(500), ..Default::default() };
        let found = match_hybrid(&query, &reference, &options);
        assert_eq!((found.extent, found.matches.len()), (HybridExtent::StoppedSufficient, 600));
    }

    #[test]
    fn small_images_and_empty_ones_go_in_one_batch() {
        let (query, reference) = pair(|rank| rank == 1100);
        let options = HybridMatchOptions { one_batch_below: 1201, ..Default::default() };
        let found = match_hybrid(&query, &reference, &options);
        assert_eq!(found.matches, [(KeypointIdx(1100), KeypointIdx(1100))]);
        let none = CoarseDescriptors::new(&[], None);
        assert!(match_hybrid(&query, &none, &options).matches.is_empty());
        assert!(match_hybrid(&none, &reference, &HybridMatchOptions::default()).matches.is_empty());
    }
}
