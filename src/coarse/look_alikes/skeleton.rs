//! The pairs that agree with each other, from the strongest on, and those put off.

use std::collections::{BTreeMap, BTreeSet};

use super::LookAlikeOptions;
use super::forest::{Link, SpanningForest};
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
    /// The strength of the weakest pair of the strongest chain between its images.
    pub(super) chain_strength: f64,
}

/// The pairs put off by the skeleton of the strongest pairs. A set is taken for free of look-alikes, and nothing is put off,
/// unless some pair agrees nearly not at all. `keep_going` is asked for every pair; once it says no, nothing is found.
///
/// Strength tells true pairs from wrong ones where one is much stronger. Two parts that nothing else joins may have a
/// wrong pair and true ones of about the same strength, and then the number of matches tells more: the true ones have
/// more each. So where a pair that is put off is a rival of a link of the chain that it contradicts
/// ([`LookAlikeOptions::rival_share`]), the skeleton is built with the rival before that link, too, and the one that is
/// contradicted less is taken. Of any link: a wrong one need not be the weakest of the chains that it spoils. (Fifty photographs
/// around a toy fox were torn by a wrong pair of 90 matches that came just before true ones of 213 and 239; a random subset by one
/// of 38 in a chain that a true one of 121 ended.)
pub(super) fn suspects(input: &MapperInput, options: &LookAlikeOptions, keep_going: &KeepGoing) -> Vec<Suspect> {
    let found = strengths(input, options, keep_going).and_then(|of| least_contradicted(input, of, options, keep_going));
    let mut suspects = found.unwrap_or_default();
    if !suspects.iter().any(|suspect| suspect.contradicted(options.alarming_share)) {
        return Vec::new();
    }
    suspects.sort_by_key(|suspect| suspect.images);
    suspects
}

/// The strength of every pair.
type Strengths = BTreeMap<(ImageId, ImageId), f64>;

/// What the skeleton that is contradicted least puts off, of those with rivals before their links. None once `keep_going`
/// says no.
fn least_contradicted(
    input: &MapperInput,
    mut strengths: Strengths,
    options: &LookAlikeOptions,
    keep_going: &KeepGoing,
) -> Option<Vec<Suspect>> {
    let matches = |images: &(ImageId, ImageId)| input.graph.pairs[images].inliers.len();
    // Squared: a hundred pairs of a few dozen matches, as copies have them, must not outweigh ten pairs of hundreds.
    let contradicting = |suspects: &[Suspect]| -> usize {
        let all = suspects.iter().filter(|suspect| suspect.contradicted(options.alarming_share));
        all.map(|suspect| suspect.matches * suspect.matches).sum()
    };
    let (mut found, mut forest) = put_off(input, &strengths, options, keep_going)?;
    let mut tried = BTreeSet::new();
    for _ in 0..options.max_rivals {
        let rival_of = |suspect: &Suspect| -> Option<Link> {
            let is_rival = |link: &Link| {
                suspect.strength >= options.rival_share * link.strength
                    && suspect.matches as f64 >= options.rival_matches * matches(&link.images) as f64
                    && !tried.contains(&(suspect.images, link.images))
            };
            forest
                .chain(suspect.images)
                .into_iter()
                .filter(is_rival)
                .min_by_key(|link| (matches(&link.images), link.images))
        };
        let contradicted = found.iter().filter(|suspect| suspect.contradicted(options.alarming_share));
        let rivals = contradicted.filter_map(|suspect| Some((suspect, rival_of(suspect)?)));
        let Some((rival, link)) = rivals.max_by_key(|(suspect, _)| (suspect.matches, suspect.images)) else { break };
        tried.insert((rival.images, link.images));
        let mut raised = strengths.clone();
        // Of equal strength, the one of more matches comes first.
        raised.insert(rival.images, link.strength);
        let instead = put_off(input, &raised, options, keep_going)?;
        if contradicting(&instead.0) < contradicting(&found) {
            ((found, forest), strengths) = (instead, raised);
        }
    }
    Some(found)
}

/// Takes pairs from the strongest to the weakest (ties by matches, then images) and puts off those that a stronger chain and
/// its tracks contradict, with the forest of the links. Wide baselines lose features on the way and so agree only in part. None
/// once `keep_going` says no.
fn put_off(
    input: &MapperInput,
    strengths: &Strengths,
    options: &LookAlikeOptions,
    keep_going: &KeepGoing,
) -> Option<(Vec<Suspect>, SpanningForest)> {
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
            return None;
        }
        let strength = strengths[&(a, b)];
        let weakest = forest.join_or_weakest_link(Link { images: (a, b), strength });
        let is_strong = weakest.is_none_or(|weakest| strength >= options.joining_share * weakest.strength);
        let observations = geometry
            .inliers
            .iter()
            .map(|&(in_a, in_b)| (Observation { image: a, keypoint: in_a }, Observation { image: b, keypoint: in_b }));
        let relations: Vec<Relation> = observations.clone().map(|(in_a, in_b)| tracks.relation(in_a, in_b)).collect();
        let count = |wanted: Relation| relations.iter().filter(|&&relation| relation == wanted).count();
        let agreeing = count(Relation::Joined);
        let known = agreeing + count(Relation::Forked) + count(Relation::Open);
        let agrees = known > 0 && agreeing as f64 >= options.agreeing_share * known as f64;
        if let Some(weakest) = weakest
            && !agrees
        {
            let matches = geometry.inliers.len();
            let chain_strength = weakest.strength;
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
    Some((suspects, forest))
}

impl Suspect {
    /// Whether at most this share of the matches of which tracks know both keypoints agrees with them.
    fn contradicted(&self, share: f64) -> bool {
        self.known > 0 && self.agreeing as f64 <= share * self.known as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Pixel;
    use crate::coarse::look_alikes::tests::matched_input;
    use crate::scene::KeypointIdx;

    /// A pair and its inliers: keypoints with those so many ranks on.
    type Pair = ((ImageId, ImageId), Vec<(KeypointIdx, KeypointIdx)>);

    fn pair(a: u32, b: u32, matches: u32, shift: u32) -> Pair {
        let inliers = (0..matches).map(|k| (KeypointIdx(k), KeypointIdx(k + shift))).collect();
        ((ImageId(a), ImageId(b)), inliers)
    }

    /// What is put off, with these strengths.
    fn found(input: &MapperInput, strength: impl Fn(u32, u32) -> f64) -> Vec<(u32, u32)> {
        let strengths: Strengths = input.graph.pairs.keys().map(|&(a, b)| ((a, b), strength(a.0, b.0))).collect();
        let found = least_contradicted(input, strengths, &LookAlikeOptions::default(), &|| true).unwrap();
        found.iter().map(|suspect| (suspect.images.0.0, suspect.images.1.0)).collect()
    }

    /// Four photographs in two parts, 0 with 1 and 2 with 3, each keypoint k of which shows place k; a wrong pair joins 1
    /// and 2, and true ones the others.
    fn two_parts(wrong_matches: u32, true_matches: u32) -> MapperInput {
        let pairs = [
            pair(0, 1, 200, 0),
            pair(2, 3, 200, 0),
            pair(1, 2, wrong_matches, 100),
            pair(0, 2, true_matches, 0),
            pair(1, 3, true_matches, 0),
        ];
        matched_input((1000, 800), vec![vec![Pixel::new(0.0, 0.0); 400]; 4], pairs)
    }

    #[test]
    fn of_rivals_the_link_is_taken_that_is_contradicted_less() {
        // Strength of the true pairs, matches of the wrong and of the true ones, and whether the wrong pair is put off.
        for (true_strength, wrong, right, is_found) in
            [(0.07, 20, 100, true), (0.02, 20, 100, false), (0.07, 80, 100, false), (0.1, 80, 100, true)]
        {
            let input = two_parts(wrong, right);
            let found = found(&input, |a, b| match (a, b) {
                (0, 1) | (2, 3) => 0.5,
                (1, 2) => 0.09,
                _ => true_strength,
            });
            let wanted = if is_found { vec![(1, 2)] } else { vec![(0, 2), (1, 3)] };
            assert_eq!(found, wanted, "{true_strength} {wrong} {right}");
        }
    }
    #[test]
    fn a_wrong_link_gives_way_though_the_chain_has_a_weaker_one() {
        // 1 and 2 make the wrong pair, and the chain from 0 to 4 over them ends in a true one that is weaker still.
        let pairs = [
            pair(0, 1, 200, 0),
            pair(2, 3, 200, 0),
            pair(1, 2, 20, 100),
            pair(3, 4, 100, 0),
            pair(0, 4, 100, 0),
            pair(1, 4, 100, 0),
        ];
        let input = matched_input((1000, 800), vec![vec![Pixel::new(0.0, 0.0); 400]; 5], pairs);
        let found = found(&input, |a, b| match (a, b) {
            (0, 1) | (2, 3) => 0.5,
            (1, 2) => 0.09,
            (3, 4) => 0.08,
            _ => 0.07,
        });
        assert_eq!(found, [(1, 2)]);
    }
}
