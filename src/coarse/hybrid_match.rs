//! Hybrid matching of the coarse features of two images (paper, section 4).
//!
//! The first half of the query's selected features (the top 10 % by scale, when 20 % are selected) is matched with all
//! selected features of the reference. Only if that gives more than a few matches is the second half matched too, so most
//! pairs that do not overlap cost half; matching may also end there when the matches are enough for a geometry. Images of
//! few features are matched in one go.
//!
//! Departures: neighbours are exact instead of approximate, and the cross-check runs over all features matched so far, so
//! a pair that goes through both batches has exactly the matches of an ordinary mutual matching.

use serde::{Deserialize, Serialize};

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
}

impl Default for HybridMatchOptions {
    fn default() -> Self {
        Self {
            matching: MatchOptions::default(),
            two_batches: true,
            gate_matches: 4,
            sufficient_matches: None,
            one_batch_below: 1000,
        }
    }
}

impl HybridMatchOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.matching.validate(errors);
        if self.sufficient_matches.is_some_and(|sufficient| sufficient <= self.gate_matches) {
            errors.push(format!("sufficient_matches must be above gate_matches ({})", self.gate_matches));
        }
    }
}

/// The selected descriptors of an image, ready to be either side of a pair. Built once per image.
#[derive(Clone, Debug)]
pub struct CoarseDescriptors {
    descriptors: Vec<Descriptor>,
    packed: PackedDescriptors,
}

impl CoarseDescriptors {
    /// From the selected descriptors (the first of the image, which are sorted by descending scale).
    pub fn new(selected: &[Descriptor]) -> Self {
        Self { descriptors: selected.to_vec(), packed: PackedDescriptors::pack(selected) }
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

    /// The same, packed.
    pub fn packed(&self) -> &PackedDescriptors {
        &self.packed
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
pub fn match_hybrid(
    query: &CoarseDescriptors,
    reference: &CoarseDescriptors,
    options: &HybridMatchOptions,
) -> HybridMatches {
    let one_batch = !options.two_batches || query.len().min(reference.len()) < options.one_batch_below;
    let (first, second) = query.descriptors.split_at(if one_batch { query.len() } else { query.len().div_ceil(2) });
    let (mut of_query, mut of_reference) = (Vec::new(), Vec::new());
    top2_both(first, &reference.packed, &mut of_query, &mut of_reference);
    let test = options.matching.test();
    let matches_of = |of_query: &[Top2], of_reference: &[Top2]| {
        mutual_matches(of_query, options.matching.cross_check.then_some(of_reference), &test)
    };
    let matches = matches_of(&of_query, &of_reference);
    if one_batch {
        return HybridMatches { matches, extent: HybridExtent::Complete };
    }
    if matches.len() <= options.gate_matches {
        return HybridMatches { matches, extent: HybridExtent::StoppedAtGate };
    }
    if options.sufficient_matches.is_some_and(|sufficient| matches.len() >= sufficient) {
        return HybridMatches { matches, extent: HybridExtent::StoppedSufficient };
    }
    let (mut of_second, mut of_reference_later) = (Vec::new(), Vec::new());
    top2_both(second, &reference.packed, &mut of_second, &mut of_reference_later);
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
        (CoarseDescriptors::new(&query), CoarseDescriptors::new(&reference))
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
        let none = CoarseDescriptors::new(&[]);
        assert!(match_hybrid(&query, &none, &options).matches.is_empty());
        assert!(match_hybrid(&none, &reference, &HybridMatchOptions::default()).matches.is_empty());
    }
}
