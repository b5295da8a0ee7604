//! The pairs that agree with each other, from the strongest on, and those put off.

use std::collections::BTreeMap;

use super::LookAlikeOptions;
use super::strength::strengths;
use crate::bundle::KeepGoing;
use crate::coarse::MapperInput;
use crate::coarse::tracks::{Relation, TrackBuilder};
use crate::scene::{ImageId, Observation};

/// A pair put off.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Suspect {
    pub(super) images: (ImageId, ImageId),
    pub(super) matches: usize,
    /// Matches both of whose keypoints are in tracks of stronger pairs.
    pub(super) known: usize,
    /// Matches within one track.
    pub(super) agreeing: usize,
    pub(super) strength: f64,
    pub(super) chain_strength: f64,
}

/// Takes pairs from the strongest to the weakest (ties by matches, then images) and puts off those that a stronger
/// chain and its tracks contradict. Wide baselines lose features on the way and so agree only in part; a set is taken
/// for free of look-alikes, and nothing is put off, unless some pair agrees nearly not at all. `keep_going` is asked
/// for every pair; once it says no, nothing is found.
pub(super) fn suspects(input: &MapperInput, options: &LookAlikeOptions, keep_going: &KeepGoing) -> Vec<Suspect> {
    let Some(strengths) = strengths(input, options, keep_going) else { return Vec::new() };
    let mut order: Vec<_> = input.graph.pairs.iter().map(|(&images, geometry)| (images, geometry)).collect();
    order.sort_by(|(pair, geometry), (other_pair, other)| {
        let by_strength = strengths[other_pair].total_cmp(&strengths[pair]);
        by_strength.then(other.inliers.len().cmp(&geometry.inliers.len())).then(pair.cmp(other_pair))
    });
    let mut tracks = TrackBuilder::new(&input.graph, &input.apart);
    let mut forest = SpanningForest::default();
    let mut suspects = Vec::new();
    for ((a, b), geometry) in order {
        if !keep_going() {
            return Vec::new();
        }
        let strength = strengths[&(a, b)];
        let chain_strength = forest.join_or_weakest_link(a, b, strength);
        let is_strong = chain_strength.is_none_or(|chain| strength >= options.joining_share * chain);
        let observations = geometry
            .inliers
            .iter()
            .map(|&(in_a, in_b)| (Observation { image: a, keypoint: in_a }, Observation { image: b, keypoint: in_b }));
        let relations: Vec<Relation> = observations.clone().map(|(in_a, in_b)| tracks.relation(in_a, in_b)).collect();
        let count = |wanted: Relation| relations.iter().filter(|&&relation| relation == wanted).count();
        let agreeing = count(Relation::Joined);
        let known = agreeing + count(Relation::Forked) + count(Relation::Open);
        let agrees = known > 0 && agreeing as f64 >= options.agreeing_share * known as f64;
        if let Some(chain_strength) = chain_strength
            && !agrees
        {
            let matches = geometry.inliers.len();
            suspects.push(Suspect { images: (a, b), matches, known, agreeing, strength, chain_strength });
            continue;
        }
        for ((in_a, in_b), relation) in observations.zip(relations) {
            // Weak pairs may extend tracks but not join two. Were one of them wrong and joined tracks, every pair after it
            // would seem to agree.
            if is_strong || relation != Relation::Open {
                tracks.join(in_a, in_b);
            }
        }
    }
    let alarmed = suspects.iter().any(|suspect| suspect.contradicted(options.alarming_share));
    if !alarmed {
        return Vec::new();
    }
    suspects.sort_by_key(|suspect| suspect.images);
    suspects
}

impl Suspect {
    /// Whether at most this share of the matches of which tracks know both keypoints agrees with them.
    fn contradicted(&self, share: f64) -> bool {
        self.known > 0 && self.agreeing as f64 <= share * self.known as f64
    }
}

/// Trees of images joined by descending strength. Trees are hung under the larger one's root and never flattened, so the
/// weakest link of the strongest chain between two images is the weakest on their ways up to where these meet, which are
/// logarithmically short.
#[derive(Default)]
struct SpanningForest {
    /// The parent and the strength of the join.
    parent: BTreeMap<ImageId, (ImageId, f64)>,
    size: BTreeMap<ImageId, usize>,
}

impl SpanningForest {
    /// The images from one up to its root, each with the weakest link on the way.
    fn way_up(&self, image: ImageId) -> Vec<(ImageId, f64)> {
        let mut way = vec![(image, f64::INFINITY)];
        let (mut at, mut weakest) = (image, f64::INFINITY);
        while let Some(&(parent, strength)) = self.parent.get(&at) {
            at = parent;
            weakest = strength.min(weakest);
            way.push((at, weakest));
        }
        way
    }

    /// Joins two trees; when the images are in one already, the weakest link of the strongest chain between them.
    fn join_or_weakest_link(&mut self, a: ImageId, b: ImageId, strength: f64) -> Option<f64> {
        let (way_a, way_b) = (self.way_up(a), self.way_up(b));
        let meeting = way_a.iter().find_map(|&(image, weakest_a)| {
            let &(_, weakest_b) = way_b.iter().find(|&&(other, _)| other == image)?;
            Some(weakest_a.min(weakest_b))
        });
        if meeting.is_some() {
            return meeting;
        }
        let (root_a, root_b) = (way_a[way_a.len() - 1].0, way_b[way_b.len() - 1].0);
        let [size_a, size_b] = [root_a, root_b].map(|root| self.size.get(&root).copied().unwrap_or(1));
        let (over, under) = if size_a >= size_b { (root_a, root_b) } else { (root_b, root_a) };
        self.parent.insert(under, (over, strength));
        self.size.insert(over, size_a + size_b);
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weakest_link_of_the_strongest_chain_is_found() {
        let mut forest = SpanningForest::default();
        let mut join = |a: u32, b: u32, strength: f64| forest.join_or_weakest_link(ImageId(a), ImageId(b), strength);
        assert_eq!(join(0, 1, 0.9), None);
        assert_eq!(join(2, 3, 0.8), None);
        assert_eq!(join(4, 3, 0.7), None);
        assert_eq!(join(1, 2, 0.5), None);
        assert_eq!(join(0, 4, 0.4), Some(0.5));
        assert_eq!(join(4, 2, 0.4), Some(0.7));
        assert_eq!(join(5, 0, 0.3), None);
        assert_eq!(join(5, 3, 0.2), Some(0.3));
    }
}
