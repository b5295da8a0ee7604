//! A part of a large model that still covers every camera (Li, Snavely, Huttenlocher, "Location recognition using
//! prioritized feature matching", ECCV 2010, section 3; the paper's section 5).
//!
//! Greedily the point that is seen by most cameras that lack points, until every camera has k of them or no more to give.
//! The gain of a point only falls as others are chosen, so points wait in a heap with the gain they last had, and only the
//! one on top is counted anew: about as much work as reading all tracks a few times.

use std::collections::{BTreeMap, BinaryHeap};

use crate::scene::{ImageId, Point3dId, Reconstruction};

/// The points of a cover of which every image sees at least `points_per_camera`, or all it sees. In id order.
pub fn set_cover(model: &Reconstruction, points_per_camera: usize) -> Vec<Point3dId> {
    let mut lacking: BTreeMap<ImageId, usize> = model.images().keys().map(|&id| (id, points_per_camera)).collect();
    let mut waiting: BinaryHeap<(usize, std::cmp::Reverse<Point3dId>)> =
        model.points().map(|(id, point)| (point.track.len(), std::cmp::Reverse(id))).collect();
    let mut chosen = Vec::new();
    while let Some((gain_before, std::cmp::Reverse(id))) = waiting.pop() {
        let track = &model.point(id).expect("the points of the heap are the model's").track;
        let gain = track.iter().filter(|seen| lacking.get(&seen.image).is_some_and(|&lacks| lacks > 0)).count();
        if gain == 0 {
            continue;
        }
        if gain < gain_before {
            waiting.push((gain, std::cmp::Reverse(id)));
            continue;
        }
        for seen in track {
            if let Some(lacks) = lacking.get_mut(&seen.image) {
                *lacks = lacks.saturating_sub(1);
            }
        }
        chosen.push(id);
    }
    chosen.sort_unstable();
    chosen
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::synthetic::{SceneOptions, generate};

    #[test]
    fn every_camera_is_covered_and_few_points_are_kept() {
        let scene = generate(&SceneOptions { num_images: 12, num_points: 3000, ..SceneOptions::default() });
        let k = 60;
        let cover = set_cover(&scene.truth, k);
        assert!(cover.windows(2).all(|pair| pair[0] < pair[1]));
        let mut covered: BTreeMap<ImageId, usize> = BTreeMap::new();
        for &id in &cover {
            for seen in &scene.truth.point(id).unwrap().track {
                *covered.entry(seen.image).or_default() += 1;
            }
        }
        for (&id, image) in scene.truth.images() {
            assert!(covered[&id] >= k.min(image.num_observations()), "{id:?}: {}", covered[&id]);
        }
        // Tracks are several images long, so a greedy cover needs far fewer than k points a camera.
        assert!(cover.len() < 12 * k / 2, "{}", cover.len());
        assert_eq!(cover, set_cover(&scene.truth, k));
    }

    #[test]
    fn a_camera_of_few_points_keeps_them_all() {
        let scene = generate(&SceneOptions { num_images: 3, num_points: 100, ..SceneOptions::default() });
        assert_eq!(set_cover(&scene.truth, 1000).len(), scene.truth.num_points());
    }
}
