//! Which images to match with which (paper, section 6.1).
//!
//! The points that two images both see say how much of the scene they share. With `P_cv(I_i, I_j) = Points(C_i) and
//! Points(C_j)` the candidates of an image are those with `|P_cv| > T`, and of these the k most covisible. The pairs of all
//! images' candidate sets, each once, are matched.
//!
//! Two floors, an idea of the authors' own scripts: `k = max(10 %, 10)` (theirs: 20), as a tenth of a small set is nothing;
//! and an image with too few candidates is also paired with the candidates of its candidates, as in a sparse model two images
//! may see one wall through different points.

use std::collections::{BTreeMap, BTreeSet};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::options::CandidatePairOptions;
use crate::scene::{ImageId, Reconstruction};

/// Two images to match.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct CandidatePair {
    /// The image with the smaller id.
    pub first: ImageId,
    /// The other.
    pub second: ImageId,
    /// Points both see; 0 or a few for a pair found through a third image.
    pub shared_points: usize,
}

/// A candidate of an image and how strongly both hang together.
#[derive(Clone, Copy, Debug)]
struct Neighbor {
    /// Rank of the image among the registered ones.
    rank: usize,
    shared: usize,
}

/// The pairs to match, each once, by ascending ids; none of images that are known to be apart. With `new_images`, only
/// pairs with at least one of them (the paper's second iteration).
pub fn candidate_pairs(
    model: &Reconstruction,
    new_images: Option<&BTreeSet<ImageId>>,
    options: &CandidatePairOptions,
) -> Vec<CandidatePair> {
    let ids: Vec<ImageId> = model.images().keys().copied().collect();
    let rank_of: BTreeMap<ImageId, usize> = ids.iter().enumerate().map(|(rank, &id)| (id, rank)).collect();
    let covisible: Vec<Vec<Neighbor>> = ids.par_iter().map(|&id| covisible_images(model, id, &rank_of)).collect();
    let direct: Vec<Vec<Neighbor>> = covisible
        .iter()
        .map(|all| all.iter().copied().filter(|n| n.shared > options.more_shared_points_than).collect())
        .collect();
    let top = options.top_at_least.max((options.top_fraction * ids.len() as f64).ceil() as usize);
    let mut pairs = BTreeMap::new();
    for (rank, neighbors) in direct.iter().enumerate() {
        let mut chosen: Vec<Neighbor> = neighbors.iter().copied().take(top).collect();
        if chosen.len() < options.second_level_below {
            let wanted = options.second_level_below - chosen.len();
            chosen.extend(second_level(rank, &direct).into_iter().take(wanted));
        }
        for neighbor in chosen {
            let (first, second) = (ids[rank.min(neighbor.rank)], ids[rank.max(neighbor.rank)]);
            let wanted = new_images.is_none_or(|new| new.contains(&first) || new.contains(&second));
            if wanted && !model.apart.are_apart(first, second) {
                let shared_points = covisible[rank].iter().find(|n| n.rank == neighbor.rank).map_or(0, |n| n.shared);
                pairs.insert((first, second), shared_points);
            }
        }
    }
    pairs.into_iter().map(|((first, second), shared_points)| CandidatePair { first, second, shared_points }).collect()
}

/// All images that share a point with this one, the most covisible first (ties by id).
fn covisible_images(model: &Reconstruction, id: ImageId, rank_of: &BTreeMap<ImageId, usize>) -> Vec<Neighbor> {
    let mut shared = vec![0usize; rank_of.len()];
    for point in model.images()[&id].points().iter().flatten() {
        let point = model.point(*point).expect("a keypoint's point exists");
        for seen in &point.track {
            shared[rank_of[&seen.image]] += 1;
        }
    }
    shared[rank_of[&id]] = 0;
    let seen = shared.into_iter().enumerate().filter(|&(_, shared)| shared > 0);
    let mut neighbors: Vec<Neighbor> = seen.map(|(rank, shared)| Neighbor { rank, shared }).collect();
    neighbors.sort_by_key(|n| (std::cmp::Reverse(n.shared), n.rank));
    neighbors
}

/// Candidates of the candidates that are none themselves, best first. A chain is as strong as its weaker link, and the
/// strongest chain counts.
fn second_level(rank: usize, direct: &[Vec<Neighbor>]) -> Vec<Neighbor> {
    let mut strength = BTreeMap::new();
    for near in &direct[rank] {
        for far in &direct[near.rank] {
            if far.rank != rank && direct[rank].iter().all(|n| n.rank != far.rank) {
                let chain = near.shared.min(far.shared);
                let best: &mut usize = strength.entry(far.rank).or_default();
                *best = chain.max(*best);
            }
        }
    }
    let mut neighbors: Vec<Neighbor> = strength.into_iter().map(|(rank, shared)| Neighbor { rank, shared }).collect();
    neighbors.sort_by_key(|n| (std::cmp::Reverse(n.shared), n.rank));
    neighbors
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use nalgebra::Vector3;

    use super::*;
    use crate::camera::{Camera, CameraModel, FocalSource, Pixel};
    use crate::geometry::Rigid3;
    use crate::scene::{CameraId, KeypointIdx, Observation};

    /// A chain of images in which neighbours share `shared[i]` points.
    fn chain(shared: &[usize]) -> Reconstruction {
        let camera = Camera::centered(CameraModel::Pinhole, 100, 100, 100.0, FocalSource::Known);
        let mut model = Reconstruction::new(BTreeMap::from([(CameraId(0), camera)]));
        let keypoints: Arc<[Pixel]> = vec![Pixel::new(50.0, 50.0); 200].into();
        for id in 0..=shared.len() as u32 {
            model.register(ImageId(id), CameraId(0), Rigid3::identity(), keypoints.clone());
        }
        let mut used = vec![0u32; shared.len() + 1];
        for (at, &count) in shared.iter().enumerate() {
            for _ in 0..count {
                let mut track = Vec::new();
                for image in [at, at + 1] {
                    track.push(Observation { image: ImageId(image as u32), keypoint: KeypointIdx(used[image]) });
                    used[image] += 1;
                }
                model.add_point(Vector3::new(0.0, 0.0, 1.0), track, [0; 3]);
            }
        }
        model
    }

    fn ids(pairs: &[CandidatePair]) -> Vec<(u32, u32, usize)> {
        pairs.iter().map(|pair| (pair.first.0, pair.second.0, pair.shared_points)).collect()
    }

    #[test]
    fn more_than_eight_shared_points_make_a_pair() {
        let options = CandidatePairOptions { second_level_below: 0, ..Default::default() };
        let pairs = candidate_pairs(&chain(&[9, 8, 30]), None, &options);
        assert_eq!(ids(&pairs), [(0, 1, 9), (2, 3, 30)]);
    }

    #[test]
    fn a_lonely_image_gets_neighbors_of_neighbors() {
        let options = CandidatePairOptions { second_level_below: 2, ..Default::default() };
        let pairs = candidate_pairs(&chain(&[20, 30, 40]), None, &options);
        assert_eq!(ids(&pairs), [(0, 1, 20), (0, 2, 0), (1, 2, 30), (1, 3, 0), (2, 3, 40)]);
    }

    #[test]
    fn only_the_most_covisible_are_kept() {
        let options = CandidatePairOptions { top_at_least: 1, second_level_below: 0, ..Default::default() };
        let pairs = candidate_pairs(&chain(&[20, 30, 40, 10]), None, &options);
        assert_eq!(ids(&pairs), [(0, 1, 20), (1, 2, 30), (2, 3, 40), (3, 4, 10)], "each image's best, each pair once");
    }

    #[test]
    fn later_iterations_take_pairs_of_new_images_only() {
        let options = CandidatePairOptions { second_level_below: 0, ..Default::default() };
        let pairs = candidate_pairs(&chain(&[20, 30, 40]), Some(&BTreeSet::from([ImageId(3)])), &options);
        assert_eq!(ids(&pairs), [(2, 3, 40)]);
    }
}
