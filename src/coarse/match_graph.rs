//! The match graph: images joined by their verified pairs.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::matching::two_view::TwoViewGeometry;
use crate::scene::ImageId;

/// Verified pairs by their two images, the smaller id first.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct MatchGraph {
    /// Verified pairs.
    pub pairs: BTreeMap<(ImageId, ImageId), TwoViewGeometry>,
}

impl MatchGraph {
    /// The connected components of at least two images, largest first (ties by smallest image).
    pub fn components(&self) -> Vec<BTreeSet<ImageId>> {
        let images: Vec<ImageId> =
            self.pairs.keys().flat_map(|&(a, b)| [a, b]).collect::<BTreeSet<_>>().into_iter().collect();
        let rank: BTreeMap<ImageId, usize> = images.iter().enumerate().map(|(rank, &id)| (id, rank)).collect();
        let mut sets = crate::math::UnionFind::new(images.len());
        for (a, b) in self.pairs.keys() {
            sets.union(rank[a], rank[b]);
        }
        let mut components: Vec<BTreeSet<ImageId>> =
            sets.sets().into_iter().map(|set| set.into_iter().map(|at| images[at]).collect()).collect();
        components.sort_by_key(|component: &BTreeSet<ImageId>| std::cmp::Reverse(component.len()));
        components
    }

    /// The part of the graph among these images.
    pub fn restricted_to(&self, images: &BTreeSet<ImageId>) -> Self {
        let pairs = self.pairs.iter().filter(|((a, b), _)| images.contains(a) && images.contains(b));
        Self { pairs: pairs.map(|(&key, geometry)| (key, geometry.clone())).collect() }
    }

    /// Whether there are pairs, and each is explained by a homography: nothing but planes and turned cameras.
    pub fn is_flat(&self) -> bool {
        !self.pairs.is_empty() && self.pairs.values().all(|geometry| !geometry.config.has_epipolar_geometry())
    }

    /// Number of verified pairs of every image.
    pub fn degrees(&self) -> BTreeMap<ImageId, usize> {
        let mut degrees = BTreeMap::new();
        for &(a, b) in self.pairs.keys() {
            *degrees.entry(a).or_insert(0) += 1;
            *degrees.entry(b).or_insert(0) += 1;
        }
        degrees
    }
}
