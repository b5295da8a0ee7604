//! Ranked 2D-2D matching, for images that active search can't place (paper, section 5).
//!
//! Coarse matches that were too few or too scattered for the coarse model still tell which localised images look alike. Of
//! the K localised images that share most of them with the new image, the features that have points stand in for these
//! points: each is matched, with the ratio test, against all features of the new image. A point may so be matched through
//! several of its sightings; the feature most of them agree on wins, then the nearest descriptor.

use std::cmp::Reverse;
use std::collections::BTreeMap;

use super::correspondences::{Correspondence, OneToOne};
use super::{LoadFeatures, MatchCounts, RankedMatchOptions};
use crate::matching::RatioTest;
use crate::matching::descriptor::{PackedDescriptors, top2_both};
use crate::scene::{Descriptor, Features, ImageId, KeypointIdx, Point3dId, Reconstruction};

/// The localised images that share most coarse matches with `query`, best first (ties by id); at most `count`.
pub fn ranked_images(model: &Reconstruction, query: ImageId, match_counts: &MatchCounts, count: usize) -> Vec<ImageId> {
    let mut ranked: Vec<(Reverse<u32>, ImageId)> = model
        .images()
        .keys()
        .filter_map(|&other| {
            let matches = *match_counts.get(&(query.min(other), query.max(other)))?;
            (matches > 0).then_some((Reverse(matches), other))
        })
        .collect();
    ranked.sort_unstable();
    ranked.into_iter().take(count).map(|(_, image)| image).collect()
}

/// The correspondences of an image's features with the points seen by `ranked` images.
pub fn ranked_match(
    model: &Reconstruction,
    features: &Features,
    ranked: &[ImageId],
    load: &LoadFeatures,
    options: &RankedMatchOptions,
) -> Vec<Correspondence> {
    if ranked.is_empty() {
        return Vec::new();
    }
    let packed = PackedDescriptors::pack(&features.descriptors);
    let test = RatioTest::new(options.ratio, options.max_distance);
    let (mut of_proxies, mut of_features) = (Vec::new(), Vec::new());
    // Votes and least distance of every claim.
    let mut claims: BTreeMap<(Point3dId, KeypointIdx), (u32, u32)> = BTreeMap::new();
    for &id in ranked {
        let Some(image) = model.image(id) else { continue };
        let lent = load(id);
        let (points, proxies): (Vec<Point3dId>, Vec<Descriptor>) = image
            .points()
            .iter()
            .zip(&lent.descriptors)
            .filter_map(|(point, descriptor)| Some(((*point)?, *descriptor)))
            .unzip();
        top2_both(&proxies, &packed, &mut of_proxies, &mut of_features);
        for ((proxy, found), &point) in (0u32..).zip(&of_proxies).zip(&points) {
            let agreed = !options.cross_check || of_features[found.index as usize].index == proxy;
            if agreed && test.accepts(found) {
                let (votes, distance_sq) =
                    claims.entry((point, KeypointIdx(found.index))).or_insert((0, found.distance_sq));
                *votes += 1;
                *distance_sq = (*distance_sq).min(found.distance_sq);
            }
        }
    }
    // The strongest claims first, so that a weak one never takes a place from two stronger ones.
    let mut ordered: Vec<_> = claims.into_iter().collect();
    ordered.sort_by_key(|&((point, keypoint), (votes, distance_sq))| (Reverse(votes), distance_sq, point, keypoint));
    let mut found = OneToOne::default();
    for ((point, keypoint), (votes, distance_sq)) in ordered {
        found.claim(keypoint, point, votes, distance_sq);
    }
    found.into_sorted()
}
