//! Settles focal lengths before poses are sought: those nothing was known of by the votes of their pairs, and those from
//! EXIF where the pairs say clearly that the tag lies (a crop keeps the tag of its original).

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::camera::{Camera, FocalSource};
use crate::coarse::MatchGraph;
use crate::geometry::focal_voting::{FocalGroup, FocalVote, FocalVotingOptions, vote_focals};
use crate::scene::{CameraId, ImageId};

/// When votes decide.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FocalOptions {
    /// How pairs vote.
    pub voting: FocalVotingOptions,
    /// Confidence, from 0 to 1, above which votes replace a guess.
    pub min_confidence: f64,
    /// Confidence above which votes are believed over EXIF.
    pub min_confidence_over_exif: f64,
    /// Factor by which an EXIF focal length must be off for the votes to replace it; smaller errors are left to adjustment.
    pub exif_tolerance: f64,
    /// Pairs that must have voted.
    pub min_pairs: usize,
    /// Share of a pair's matches that the geometry by untrusted focal lengths must keep; where it keeps fewer, the matches of
    /// the uncalibrated geometry stay.
    pub min_calibrated_share: f64,
}

impl Default for FocalOptions {
    fn default() -> Self {
        Self {
            voting: FocalVotingOptions::default(),
            min_confidence: 0.15,
            min_confidence_over_exif: 0.3,
            exif_tolerance: 1.4,
            min_pairs: 3,
            min_calibrated_share: 0.7,
        }
    }
}

impl FocalOptions {
    /// Adds every violation to `errors`.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.voting.validate(errors);
        if self.exif_tolerance <= 1.0 {
            errors.push("coarse.focals.exif_tolerance must be above 1".to_owned());
        }
    }
}

/// Replaces guesses, and EXIF focal lengths that clearly lie, by what the verified pairs vote for. Returns notes for the
/// report.
pub fn settle(
    graph: &MatchGraph,
    cameras: &mut BTreeMap<CameraId, Camera>,
    camera_of: &BTreeMap<ImageId, CameraId>,
    options: &FocalOptions,
) -> Vec<String> {
    let rank: BTreeMap<CameraId, usize> = cameras.keys().enumerate().map(|(rank, &id)| (id, rank)).collect();
    let groups: Vec<FocalGroup> = cameras
        .values()
        .map(|camera| FocalGroup {
            long_side_px: f64::from(camera.width.max(camera.height)),
            focal_px: camera.mean_focal_px(),
            fixed: camera.focal_source == FocalSource::Known,
        })
        .collect();
    let center = |id: CameraId| {
        let center = cameras[&id].principal_point().0;
        (center.x, center.y)
    };
    let votes: Vec<FocalVote> = graph
        .pairs
        .iter()
        .filter_map(|(&(a, b), geometry)| {
            let (camera_a, camera_b) = (camera_of[&a], camera_of[&b]);
            Some(FocalVote {
                fundamental: geometry.fundamental?,
                principal_point_a_px: center(camera_a),
                principal_point_b_px: center(camera_b),
                group_a: rank[&camera_a],
                group_b: rank[&camera_b],
                weight: (geometry.inliers.len() as f64).sqrt(),
            })
        })
        .collect();
    let estimates = vote_focals(&votes, &groups, &options.voting);
    let mut notes = Vec::new();
    for (camera, estimate) in cameras.values_mut().zip(estimates) {
        let before_px = camera.mean_focal_px();
        let off = (estimate.focal_px / before_px).max(before_px / estimate.focal_px);
        let believed = estimate.num_pairs >= options.min_pairs
            && match camera.focal_source {
                FocalSource::Guess => estimate.confidence >= options.min_confidence,
                FocalSource::Exif => {
                    estimate.confidence >= options.min_confidence_over_exif && off > options.exif_tolerance
                }
                FocalSource::Estimated | FocalSource::Known => false,
            };
        if !believed {
            continue;
        }
        if camera.focal_source == FocalSource::Exif {
            notes.push(format!(
                "The EXIF focal length of a camera ({before_px:.0} px) contradicts its photographs, which say {:.0} px; \
                 cropped pictures keep the tag of the original.",
                estimate.focal_px
            ));
        }
        camera.set_focal(estimate.focal_px, estimate.focal_px);
        camera.focal_source = FocalSource::Estimated;
    }
    notes
}
