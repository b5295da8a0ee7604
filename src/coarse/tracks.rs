//! Tracks: keypoints of several images that the verified matches say are one point.
//!
//! Connected components of the matches, with the rule that a track sees an image at most once: matches are joined in
//! descending order of their pair's inliers, and one that would bring two keypoints of an image together is refused. Joining
//! the strongest pairs first leaves the conflict, and so the loss, to the weakest.

use std::collections::BTreeMap;

use super::MatchGraph;
use crate::math::UnionFind;
use crate::scene::{ImageId, KeypointIdx, Observation};

/// All tracks of a match graph.
#[derive(Clone, Debug, Default)]
pub struct Tracks {
    /// The sightings of each track, sorted, at least two.
    pub tracks: Vec<Vec<Observation>>,
    /// The track of each matched keypoint, by image, sorted by keypoint.
    pub of_image: BTreeMap<ImageId, Vec<(KeypointIdx, usize)>>,
}

impl Tracks {
    /// Builds the tracks of a graph.
    pub fn build(graph: &MatchGraph) -> Self {
        let mut nodes: Vec<Observation> = Vec::new();
        for (&(a, b), geometry) in &graph.pairs {
            for &(in_a, in_b) in &geometry.inliers {
                nodes.push(Observation { image: a, keypoint: in_a });
                nodes.push(Observation { image: b, keypoint: in_b });
            }
        }
        nodes.sort_unstable();
        nodes.dedup();
        let node = |seen: Observation| nodes.binary_search(&seen).expect("every matched keypoint is a node");

        let mut order: Vec<_> = graph.pairs.iter().collect();
        order.sort_by_key(|(_, geometry)| std::cmp::Reverse(geometry.inliers.len()));
        let mut sets = UnionFind::new(nodes.len());
        let mut images_of_root: Vec<Vec<ImageId>> = nodes.iter().map(|seen| vec![seen.image]).collect();
        for (&(a, b), geometry) in order {
            for &(in_a, in_b) in &geometry.inliers {
                let (root_a, root_b) = (
                    sets.find(node(Observation { image: a, keypoint: in_a })),
                    sets.find(node(Observation { image: b, keypoint: in_b })),
                );
                if root_a == root_b {
                    continue;
                }
                if let Some(joined) = merge_disjoint(&images_of_root[root_a], &images_of_root[root_b]) {
                    sets.union(root_a, root_b);
                    images_of_root[root_a] = Vec::new();
                    images_of_root[root_b] = Vec::new();
                    images_of_root[sets.find(root_a)] = joined;
                }
            }
        }

        let mut tracks = Self::default();
        for set in sets.sets().into_iter().filter(|set| set.len() >= 2) {
            let rank = tracks.tracks.len();
            let track: Vec<Observation> = set.into_iter().map(|at| nodes[at]).collect();
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

    /// The tracked keypoints of an image with their tracks.
    pub fn of(&self, image: ImageId) -> &[(KeypointIdx, usize)] {
        self.of_image.get(&image).map_or(&[], Vec::as_slice)
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
