//! Matching two images with known poses along epipolar lines (paper, sections 6.2.1 to 6.2.3).
//!
//! Each query is compared with all candidates near its epipolar line ([`super::one_way`]): with about 80 candidates a packed
//! scan of exact distances costs less than the building of the paper's small k-d trees alone (the authors' program spends a
//! quarter of its time on that).
//!
//! The ratio test comes *after* the geometric restriction: look-alikes elsewhere on a facade are not among the candidates,
//! so they can't reject a match, which is where the method's density comes from. A small candidate set would make the
//! test meaningless (one candidate has no rival), so it is filled up with random features of the target that compete for
//! the second place only, as the authors' code does and the print does not say. A rival at the place of the best candidate
//! is no rival: SIFT describes one place several times.
//!
//! The result is a pure function of its arguments: the random features depend on the seed and on the pair.

use std::f64::consts::{PI, TAU};

use serde::{Deserialize, Serialize};

use super::candidate_search::CandidateSearch;
use super::epipolar::EpipolarGeometry;
use super::one_way::{Found, OneWay};
use super::options::GuidedMatchOptions;
use super::prepared::PreparedImage;
use crate::matching::standing;
use crate::math::Rng;
use crate::scene::{ImageId, KeypointIdx};

/// Keypoints of the two images of a pair that belong together.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct KeypointMatch {
    /// The keypoint of the first image.
    pub first: KeypointIdx,
    /// The keypoint of the second image.
    pub second: KeypointIdx,
    /// Whether it passes the stricter ratio test of matches that nothing else confirms.
    pub distinctive: bool,
}

/// Separates this stage's random streams from others'.
const RANDOM_STREAM: u64 = 0x6164_6470_6f69_6e74;

/// The matches of two images along their epipolar lines, by the first image's keypoints; each keypoint at most once.
/// `settled` lists keypoint pairs already known to belong together (they see one point of the model): they are not matched
/// again, nor matched with others, but they compete. No matches when there are fewer than the options' minimum.
pub fn guided_match(
    (first_id, first): (ImageId, &PreparedImage),
    (second_id, second): (ImageId, &PreparedImage),
    settled: &[(KeypointIdx, KeypointIdx)],
    options: &GuidedMatchOptions,
    seed: u64,
) -> Vec<KeypointMatch> {
    let pose = |image: &PreparedImage| (image.camera.clone(), image.cam_from_world);
    let ((first_camera, first_pose), (second_camera, second_pose)) = (pose(first), pose(second));
    let geometry = EpipolarGeometry::new((&first_camera, &first_pose), (&second_camera, &second_pose));
    let backward = EpipolarGeometry::new((&second_camera, &second_pose), (&first_camera, &first_pose));
    let (Some(geometry), Some(backward)) = (geometry, backward) else { return Vec::new() };
    let stream =
        |from: ImageId, to: ImageId| Rng::from_parts(&[seed, RANDOM_STREAM, u64::from(from.0), u64::from(to.0)]);

    let mut first_settled = vec![false; first.features.len()];
    let mut second_settled = vec![false; second.features.len()];
    for (a, b) in settled {
        first_settled[a.index()] = true;
        second_settled[b.index()] = true;
    }
    let open = |query: u32| !first_settled[query as usize];
    let mut search = OneWay { query: first, target: second, geometry: &geometry, options, check_ratio: true };
    // One sweep tells both ways; but the way back's ratio test needs a way back.
    let at_once = options.mutual && options.search == CandidateSearch::Sweep && !options.ratio_both_ways;
    let rng = stream(first_id, second_id);
    let mut matches = if at_once {
        search.run_mutual(open, rng)
    } else {
        search.run(first.finder.members().iter().copied().filter(|&query| open(query)), rng)
    };
    matches.retain(|found| !second_settled[found.target as usize]);
    if options.mutual && !at_once {
        let mut asked: Vec<u32> = matches.iter().map(|found| found.target).collect();
        asked.sort_unstable();
        asked.dedup();
        search =
            OneWay { query: second, target: first, geometry: &backward, options, check_ratio: options.ratio_both_ways };
        let back = search.run(asked.into_iter(), stream(second_id, first_id));
        matches.retain(|found| {
            let at = back.binary_search_by_key(&found.target, |returned| returned.query);
            at.is_ok_and(|at| back[at].target == found.query)
        });
    } else if !options.mutual {
        keep_best_per_target(&mut matches);
    }
    gate_by_geometry(&mut matches, first, second, &geometry, options);
    gate_by_orientation(&mut matches, first, second, options);
    leave_out_standing(&mut matches, first, second, options);
    if matches.len() < options.min_pair_matches {
        return Vec::new();
    }
    let keypoints = |found: Found| KeypointMatch {
        first: KeypointIdx(found.query),
        second: KeypointIdx(found.target),
        distinctive: found.distinctive,
    };
    matches.into_iter().map(keypoints).collect()
}

/// Of the matches to one target the one with the nearest descriptor (ties: the first query).
fn keep_best_per_target(matches: &mut Vec<Found>) {
    matches.sort_unstable_by_key(|found| (found.target, found.distance_sq, found.query));
    matches.dedup_by_key(|found| found.target);
    matches.sort_unstable_by_key(|found| found.query);
}

/// Drops matches that would be behind a camera, or whose keypoints differ in scale in a way their depths do not explain: an
/// object of size s at depth z shows with size `f s / z`.
fn gate_by_geometry(
    matches: &mut Vec<Found>,
    first: &PreparedImage,
    second: &PreparedImage,
    geometry: &EpipolarGeometry,
    options: &GuidedMatchOptions,
) {
    if !options.cheirality && options.max_scale_discrepancy.is_none() {
        return;
    }
    let focal_ratio = second.camera.mean_focal_px() / first.camera.mean_focal_px();
    matches.retain(|found| {
        let (a, b) = (found.query as usize, found.target as usize);
        let Some((depth_a, depth_b)) = geometry.depths(&first.normalized[a], &second.normalized[b]) else {
            return false;
        };
        if depth_a <= 0.0 || depth_b <= 0.0 {
            // Without positive depths scales foretell nothing.
            return !options.cheirality;
        }
        let expected = focal_ratio * depth_a / depth_b;
        let actual = f64::from(second.features.keypoints[b].scale) / f64::from(first.features.keypoints[a].scale);
        options.max_scale_discrepancy.is_none_or(|factor| (actual / expected).ln().abs() <= factor.ln())
    });
}

/// Drops matches that stand still in the frame where they are no part of the scene.
fn leave_out_standing(
    matches: &mut Vec<Found>,
    first: &PreparedImage,
    second: &PreparedImage,
    options: &GuidedMatchOptions,
) {
    if !first.camera.has_size_of(&second.camera) {
        return;
    }
    let shift_px = |found: &Found| {
        let (a, b) =
            (&first.features.keypoints[found.query as usize], &second.features.keypoints[found.target as usize]);
        f64::from(b.x - a.x).hypot(f64::from(b.y - a.y))
    };
    if let Some(moved) = standing::moved(matches, shift_px, &options.standing) {
        *matches = moved;
    }
}

/// Bins of the histogram of orientation changes: 10 degrees each.
const ORIENTATION_BINS: usize = 36;

/// Drops matches whose keypoints turn otherwise than most of the pair's.
fn gate_by_orientation(
    matches: &mut Vec<Found>,
    first: &PreparedImage,
    second: &PreparedImage,
    options: &GuidedMatchOptions,
) {
    let Some(limit_deg) = options.max_orientation_discrepancy_deg else { return };
    let turn = |found: &Found| {
        let from = f64::from(first.features.keypoints[found.query as usize].orientation);
        (f64::from(second.features.keypoints[found.target as usize].orientation) - from).rem_euclid(TAU)
    };
    let bin_width = TAU / ORIENTATION_BINS as f64;
    let mut histogram = [0usize; ORIENTATION_BINS];
    for found in matches.iter() {
        histogram[((turn(found) / bin_width) as usize).min(ORIENTATION_BINS - 1)] += 1;
    }
    let around =
        |bin: usize| (0..3).map(|k| histogram[(bin + ORIENTATION_BINS + k - 1) % ORIENTATION_BINS]).sum::<usize>();
    let Some(mode) = (0..ORIENTATION_BINS).rev().max_by_key(|&bin| around(bin)) else { return };
    let commonest = (mode as f64 + 0.5) * bin_width;
    matches.retain(|found| {
        let off = (turn(found) - commonest + PI).rem_euclid(TAU) - PI;
        off.abs() <= limit_deg.to_radians()
    });
}
