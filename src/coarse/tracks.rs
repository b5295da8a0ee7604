//! Tracks: keypoints of several images that the verified matches say are one point.
//!
//! Connected components of the matches, with the rule that a track sees an image at most once: matches are joined in
//! descending order of their pair's inliers, and one that would bring two keypoints of an image together is refused. Joining
//! the strongest pairs first leaves the conflict, and so the loss, to the weakest.

use std::collections::BTreeMap;

use super::MatchGraph;
use crate::bundle::KeepGoing;
use crate::math::UnionFind;
use crate::scene::{ApartImages, ImageId, KeypointIdx, Observation};

/// All tracks of a match graph.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    /// The sightings of each track, sorted, at least two.
    pub tracks: Vec<Vec<Observation>>,
    /// The track of each matched keypoint, by image, sorted by keypoint.
    pub of_image: BTreeMap<ImageId, Vec<(KeypointIdx, usize)>>,
}

impl Tracks {
    /// Builds the tracks of a graph, none of which joins images that are apart. Once `keep_going`, which is asked for
    /// every pair, says no, further pairs are left out.
    pub fn build(graph: &MatchGraph, apart: &ApartImages, keep_going: &KeepGoing) -> Self {
        let mut builder = TrackBuilder::new(graph, apart);
        let mut order: Vec<_> = graph.pairs.iter().collect();
        order.sort_by_key(|(_, geometry)| std::cmp::Reverse(geometry.inliers.len()));
        for (&(a, b), geometry) in order.into_iter().take_while(|_| keep_going()) {
            for &(in_a, in_b) in &geometry.inliers {
                builder.join(Observation { image: a, keypoint: in_a }, Observation { image: b, keypoint: in_b });
            }
        }
        builder.finish()
    }

    /// The tracked keypoints of an image with their tracks.
    pub fn of(&self, image: ImageId) -> &[(KeypointIdx, usize)] {
        self.of_image.get(&image).map_or(&[], Vec::as_slice)
    }
}

/// How two sightings stand to each other while tracks grow.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Relation {
    /// They are in one track.
    Joined,
    /// Both are in tracks, of no image in common, that could be one.
    Open,
    /// One of them is in no track yet.
    Fresh,
    /// Their tracks meet in an image, at two keypoints: they can't be one point.
    Forked,
}

/// Tracks that grow match by match.
pub(super) struct TrackBuilder<'a> {
    apart: &'a ApartImages,
    nodes: Vec<Observation>,
    sets: UnionFind,
    images_of_root: Vec<Vec<ImageId>>,
}

impl<'a> TrackBuilder<'a> {
    /// Every matched keypoint of the graph as a track of its own.
    pub(super) fn new(graph: &MatchGraph, apart: &'a ApartImages) -> Self {
        let mut is_matched: BTreeMap<ImageId, Vec<bool>> = BTreeMap::new();
        for (&(a, b), geometry) in &graph.pairs {
            let mut note = |image: ImageId, keypoints: &mut dyn Iterator<Item = KeypointIdx>| {
                let of_image = is_matched.entry(image).or_default();
                for keypoint in keypoints {
                    of_image.resize(of_image.len().max(keypoint.index() + 1), false);
                    of_image[keypoint.index()] = true;
                }
            };
            note(a, &mut geometry.inliers.iter().map(|inlier| inlier.0));
            note(b, &mut geometry.inliers.iter().map(|inlier| inlier.1));
        }
        // By image, then keypoint.
        let nodes: Vec<Observation> = is_matched
            .into_iter()
            .flat_map(|(image, of_image)| {
                let matched = (0u32..).map(KeypointIdx).zip(of_image).filter(|&(_, is_matched)| is_matched);
                matched.map(move |(keypoint, _)| Observation { image, keypoint })
            })
            .collect();
        Self {
            apart,
            sets: UnionFind::new(nodes.len()),
            images_of_root: nodes.iter().map(|seen| vec![seen.image]).collect(),
            nodes,
        }
    }

    fn roots(&mut self, a: Observation, b: Observation) -> (usize, usize) {
        let [a, b] = [a, b].map(|seen| self.nodes.binary_search(&seen).expect("every matched keypoint is a node"));
        (self.sets.find(a), self.sets.find(b))
    }

    /// How two matched keypoints stand to each other so far.
    pub(super) fn relation(&mut self, a: Observation, b: Observation) -> Relation {
        let (root_a, root_b) = self.roots(a, b);
        if root_a == root_b {
            Relation::Joined
        } else if self.images_of_root[root_a].len() == 1 || self.images_of_root[root_b].len() == 1 {
            Relation::Fresh
        } else if merge_disjoint(&self.images_of_root[root_a], &self.images_of_root[root_b]).is_some() {
            Relation::Open
        } else {
            Relation::Forked
        }
    }

    /// Joins the tracks of two matched keypoints, unless they meet in an image or hold images that are apart.
    pub(super) fn join(&mut self, a: Observation, b: Observation) {
        let (root_a, root_b) = self.roots(a, b);
        let (images_a, images_b) = (&self.images_of_root[root_a], &self.images_of_root[root_b]);
        let apart = |&image: &ImageId| self.apart.from_any(image, images_b.iter().copied());
        if root_a == root_b || images_a.iter().any(apart) {
            return;
        }
        if let Some(joined) = merge_disjoint(&self.images_of_root[root_a], &self.images_of_root[root_b]) {
            self.sets.union(root_a, root_b);
            self.images_of_root[root_a] = Vec::new();
            self.images_of_root[root_b] = Vec::new();
            self.images_of_root[self.sets.find(root_a)] = joined;
        }
    }

    /// The tracks of at least two sightings.
    pub(super) fn finish(mut self) -> Tracks {
        let mut tracks = Tracks::default();
        for set in self.sets.sets().into_iter().filter(|set| set.len() >= 2) {
            let rank = tracks.tracks.len();
            let track: Vec<Observation> = set.into_iter().map(|at| self.nodes[at]).collect();
            for seen in &track {
                tracks.of_image.entry(seen.image).or_default().push((seen.keypoint, rank));
            }
            tracks.tracks.push(track);
        }
        for keypoints in tracks.of_image.values_mut() {
            keypoints.sort_unstable();
        }
        tracks
    }
}

/// The union of two sorted lists, or none when they share an element.
fn merge_disjoint(a: &[ImageId], b: &[ImageId]) -> Option<Vec<ImageId>> {
    let mut merged = Vec::with_capacity(a.len() + b.len());
    let (mut at_a, mut at_b) = (0, 0);
    while at_a < a.len() && at_b < b.len() {
        match a[at_a].cmp(&b[at_b]) {
            std::cmp::Ordering::Equal => return None,
            std::cmp::Ordering::Less => {
                merged.push(a[at_a]);
                at_a += 1;
            }
            std::cmp::Ordering::Greater => {
                merged.push(b[at_b]);
                at_b += 1;
            }
        }
    }
    merged.extend_from_slice(&a[at_a..]);
    merged.extend_from_slice(&b[at_b..]);
    Some(merged)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sorted_lists_merge_unless_they_meet() {
        let ids = |list: &[u32]| list.iter().map(|&id| ImageId(id)).collect::<Vec<_>>();
        assert_eq!(merge_disjoint(&ids(&[1, 4]), &ids(&[2, 9])), Some(ids(&[1, 2, 4, 9])));
        assert_eq!(merge_disjoint(&ids(&[1, 4]), &ids(&[4])), None);
    }
}
