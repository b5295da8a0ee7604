//! From nearest neighbours to matches: ratio test, largest distance, cross-check.
//!
//! The ratio test (Lowe, "Distinctive image features from scale-invariant keypoints", IJCV 2004, section 7.1) keeps a
//! nearest neighbour only when it is clearly nearer than the second; the cross-check keeps it only when the relation
//! holds both ways, which also makes the matches one to one.

use serde::{Deserialize, Serialize};

use super::descriptor::{DESCRIPTOR_NORM, PackedDescriptors, Top2, top2, top2_both};
use crate::scene::{Descriptor, KeypointIdx};

/// How descriptors are matched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct MatchOptions {
    /// Largest ratio of the distances to the nearest and to the second-nearest descriptor, in (0, 1]; 1 switches the test
    /// off. Higher: more matches, more of them wrong. Lowe's value; it wants the cross-check beside it.
    pub ratio: f64,
    /// Largest distance between two matching descriptors, as a multiple of a descriptor's length, in (0, 2]. Higher: more
    /// matches under strong change of light or viewpoint. Unit vectors at 0.7 are 41 degrees apart.
    pub max_distance: f64,
    /// Keep only pairs of which each is the other's nearest and passes the ratio test both ways.
    pub cross_check: bool,
}

impl Default for MatchOptions {
    fn default() -> Self {
        Self { ratio: 0.8, max_distance: 0.7, cross_check: true }
    }
}

impl MatchOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if !(self.ratio > 0.0 && self.ratio <= 1.0) {
            errors.push(format!("ratio is {}, it must be above 0 and at most 1", self.ratio));
        }
        if !(self.max_distance > 0.0 && self.max_distance <= 2.0) {
            errors.push(format!("max_distance is {}, it must be above 0 and at most 2", self.max_distance));
        }
    }

    /// The test on a pair's distances that these options ask for.
    pub fn test(&self) -> RatioTest {
        RatioTest::new(self.ratio, self.max_distance)
    }
}

/// The ratio test and the largest distance, in squared quantised units.
#[derive(Clone, Copy, Debug)]
pub struct RatioTest {
    ratio_sq: f64,
    max_distance_sq: f64,
}

impl RatioTest {
    /// With a largest ratio of distances and a largest distance in descriptor lengths.
    pub fn new(ratio: f64, max_distance: f64) -> Self {
        Self { ratio_sq: ratio * ratio, max_distance_sq: (max_distance * DESCRIPTOR_NORM).powi(2) }
    }

    /// Whether a nearest neighbour is near and distinct enough. A lone candidate passes the ratio test: there is nothing it
    /// could be confused with. Two candidates at distance 0 fail it, unless the ratio is 1.
    #[inline]
    pub fn accepts(&self, found: &Top2) -> bool {
        let distance_sq = f64::from(found.distance_sq);
        let distinct = match found.second_distance_sq {
            Some(_) if self.ratio_sq >= 1.0 => true,
            Some(second) => distance_sq < self.ratio_sq * f64::from(second),
            None => true,
        };
        distinct && distance_sq <= self.max_distance_sq
    }
}

/// Matches between two sets of descriptors, sorted by the first index.
pub fn match_mutual(a: &[Descriptor], b: &[Descriptor], options: &MatchOptions) -> Vec<(KeypointIdx, KeypointIdx)> {
    match_mutual_packed(a, &PackedDescriptors::pack(b), options)
}

/// [`match_mutual`] against descriptors packed beforehand.
pub fn match_mutual_packed(
    a: &[Descriptor],
    b: &PackedDescriptors,
    options: &MatchOptions,
) -> Vec<(KeypointIdx, KeypointIdx)> {
    let mut of_a = Vec::new();
    if options.cross_check {
        let mut of_b = Vec::new();
        top2_both(a, b, &mut of_a, &mut of_b);
        mutual_matches(&of_a, Some(&of_b), &options.test())
    } else {
        top2(a, b, &mut of_a);
        mutual_matches(&of_a, None, &options.test())
    }
}

/// The matches among nearest neighbours: `of_a[i]` is the nearest b of the i-th a and, for the cross-check, `of_b[j]` the
/// nearest a of the j-th b. Sorted by the first index.
pub fn mutual_matches(of_a: &[Top2], of_b: Option<&[Top2]>, test: &RatioTest) -> Vec<(KeypointIdx, KeypointIdx)> {
    let agreed = |i: u32, found: &Top2| match of_b {
        Some(of_b) => {
            let back = &of_b[found.index as usize];
            back.index == i && test.accepts(back)
        }
        None => true,
    };
    (0u32..)
        .zip(of_a)
        .filter(|(i, found)| test.accepts(found) && agreed(*i, found))
        .map(|(i, found)| (KeypointIdx(i), KeypointIdx(found.index)))
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::DESCRIPTOR_LEN;

    /// A descriptor of length 512 with a distance of about `step` from the plain one.
    fn spike(at: usize, step: u8) -> Descriptor {
        let mut descriptor = [45; DESCRIPTOR_LEN];
        descriptor[at] += step;
        descriptor
    }

    fn pairs(matches: &[(KeypointIdx, KeypointIdx)]) -> Vec<(u32, u32)> {
        matches.iter().map(|(a, b)| (a.0, b.0)).collect()
    }

    #[test]
    fn an_ambiguous_neighbour_is_dropped() {
        let query = [spike(0, 0)];
        let one_way = |ratio| MatchOptions { ratio, cross_check: false, ..MatchOptions::default() };
        // Distances 70 and 100: the ratio is 0.7.
        let rows = [spike(1, 100), spike(2, 70)];
        assert_eq!(pairs(&match_mutual(&query, &rows, &one_way(0.71))), [(0, 1)]);
        assert!(match_mutual(&query, &rows, &one_way(0.69)).is_empty());
        // Exact repeats can't be told apart.
        let repeats = [query[0], query[0]];
        assert!(match_mutual(&query, &repeats, &one_way(0.99)).is_empty());
        assert_eq!(pairs(&match_mutual(&query, &repeats, &one_way(1.0))), [(0, 0)]);
    }

    #[test]
    fn a_far_neighbour_is_dropped() {
        let (query, row) = ([spike(0, 0)], [spike(1, 103)]);
        let within = |max_distance| MatchOptions { max_distance, ..MatchOptions::default() };
        assert_eq!(match_mutual(&query, &row, &within(103.5 / 512.0)).len(), 1);
        assert!(match_mutual(&query, &row, &within(102.5 / 512.0)).is_empty());
    }

    #[test]
    fn the_cross_check_keeps_one_of_two_that_claim_the_same() {
        let a = [spike(3, 30), spike(3, 10), spike(9, 200)];
        let b = [spike(3, 0), spike(9, 190)];
        let loose = MatchOptions { ratio: 1.0, max_distance: 2.0, cross_check: false };
        assert_eq!(pairs(&match_mutual(&a, &b, &loose)), [(0, 0), (1, 0), (2, 1)]);
        let strict = MatchOptions { cross_check: true, ..loose };
        assert_eq!(pairs(&match_mutual(&a, &b, &strict)), [(1, 0), (2, 1)]);
        // The ratio test holds both ways: row 0 has two queries at distances 10 and 30.
        let stricter = MatchOptions { ratio: 0.3, ..strict };
        assert_eq!(pairs(&match_mutual(&a, &b, &stricter)), [(2, 1)]);
    }

    #[test]
    fn nothing_matches_nothing() {
        assert!(match_mutual(&[], &[spike(0, 0)], &MatchOptions::default()).is_empty());
        assert!(match_mutual(&[spike(0, 0)], &[], &MatchOptions::default()).is_empty());
    }

    #[test]
    fn options_out_of_range_are_all_named() {
        let mut errors = Vec::new();
        MatchOptions { ratio: f64::NAN, max_distance: 0.0, cross_check: true }.validate(&mut errors);
        assert_eq!(errors.len(), 2);
    }
}
