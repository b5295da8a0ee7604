//! Adding points to the model (paper, section 6).
//!
//! The model knows (nearly) all poses, but its points come from the few features of the largest scales. With the poses, all
//! features can be matched cheaply and well:
//!
//! - [`candidate_pairs`](mod@candidate_pairs) (6.1): images that share points are worth matching;
//! - [`epipolar`] (6.2, equations 1 to 3): where the counterpart of a feature must lie;
//! - [`candidate_search`], by [`grid`] (6.2.1, equations 4 to 9) or [`sweep`]: the features near that line, fast;
//! - [`line_groups`] (6.2.2): features that share a line share the search;
//! - [`guided_match`](mod@guided_match) (6.2.2, 6.2.3): best descriptor along the line, ratio test after the geometry;
//! - [`triangulate`] (6.3): each image's matches as tracks, and their points, kept in little room ([`stars`]);
//! - [`merge`] (6.3): the pieces of one point made one;
//! - [`strays`]: points that rest on one match and lie where nothing else is, taken out at the end;
//! - [`completion`]: a third sighting for points of two, where they project to, at the end.
//!
//! A pair is a unit of work ([`PairMatcher`]): a pure function of the model, both images' features, options and seed. Poses
//! are not changed; every pair and every image is independent of the others, and results are put together in id order, so
//! the number of threads does not show.

pub mod candidate_pairs;
pub mod candidate_search;
pub mod completion;
mod components;
pub mod epipolar;
pub mod grid;
pub mod guided_match;
pub mod line_groups;
pub mod merge;
pub mod one_way;
mod options;
pub mod pair_matcher;
pub mod pencil;
pub mod prepared;
pub mod stars;
pub mod strays;
pub mod sweep;
#[cfg(test)]
mod test_scene;
#[cfg(test)]
mod tests;
pub mod triangulate;
pub mod views;

use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use candidate_pairs::{CandidatePair, candidate_pairs};
pub use candidate_search::CandidateSearch;
pub use completion::{Completer, CompletionOptions};
pub use guided_match::{KeypointMatch, guided_match};
pub use options::{
    AddPointsOptions, BlockOptions, CandidatePairOptions, GuidedMatchOptions, PixelScaling, TriangulationOptions,
};
pub use pair_matcher::{PairMatcher, match_pair, tiles};
pub use prepared::PreparedImage;
pub use strays::{StrayOptions, remove_strays};
pub use triangulate::PairMatches;

use crate::scene::{Features, ImageId, Observation, Reconstruction};

/// Why the stage ended without a result.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AddPointsError {
    /// Somebody asked to stop.
    #[error("the addition of points was cancelled")]
    Cancelled,
    /// An image's features are not those its keypoints in the model come from.
    #[error("image {} has {features} features, but {keypoints} keypoints in the model", .image.0)]
    FeaturesDoNotFit {
        /// The image.
        image: ImageId,
        /// Its features.
        features: usize,
        /// Its keypoints in the model.
        keypoints: usize,
    },
    /// An image of a pair has no pose.
    #[error("image {} is not registered", .0.0)]
    NotRegistered(ImageId),
}

/// What the stage did.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddPointsReport {
    /// Pairs that were matched.
    pub pairs_tried: usize,
    /// Pairs with enough matches.
    pub pairs_matched: usize,
    /// New matches of all pairs.
    pub matches: usize,
    /// Points before.
    pub points_before: usize,
    /// Points after.
    pub points_after: usize,
    /// Points with three or more observations, before.
    pub points_3plus_before: usize,
    /// Points with three or more observations, after.
    pub points_3plus_after: usize,
    /// Observations before.
    pub observations_before: usize,
    /// Observations after.
    pub observations_after: usize,
    /// New points.
    pub points_created: usize,
    /// Points of before with a changed track.
    pub points_extended: usize,
    /// Points of before that became part of others.
    pub points_absorbed: usize,
}

/// Loads an image's features.
pub type LoadFeatures<'a> = dyn Fn(ImageId) -> Arc<Features> + Sync + 'a;
/// Whether somebody asked to stop.
pub type Cancelled<'a> = dyn Fn() -> bool + Sync + 'a;

/// Two sightings of what may be one point.
pub type PairOfSightings = [Observation; 2];

/// Brings the matches of all pairs into the model: tracks per image, triangulation, merging (6.3). The order of the pairs does
/// not show. Also returns the matches that nothing but themselves speaks for and that are not distinctive.
///
/// # Errors
/// When cancelled; the model is then unchanged.
pub fn add_matches(
    model: &mut Reconstruction,
    mut matches: Vec<PairMatches>,
    options: &AddPointsOptions,
    cancelled: &Cancelled,
) -> Result<(AddPointsReport, Vec<PairOfSightings>), AddPointsError> {
    matches.sort_by_key(|pair| (pair.first, pair.second));
    let mut report = AddPointsReport {
        pairs_tried: matches.len(),
        pairs_matched: matches.iter().filter(|pair| !pair.matches.is_empty()).count(),
        matches: matches.iter().map(|pair| pair.matches.len()).sum(),
        points_before: model.num_points(),
        points_3plus_before: model.num_points_3plus(),
        observations_before: model.num_observations(),
        ..AddPointsReport::default()
    };
    let updates = {
        let table = views::ViewTable::new(model, &options.triangulation, &options.pixel_scaling);
        let stars = triangulate::star_tracks(model, &table, &matches, cancelled)?;
        drop(matches);
        merge::merge_tracks(model, &table, &stars, &options.triangulation, cancelled)?
    };
    let (tentative, updates): (Vec<_>, Vec<_>) = updates.into_iter().partition(|update| update.tentative);
    let counts = merge::apply_updates(model, updates);
    report.points_created = counts.created;
    report.points_extended = counts.extended;
    report.points_absorbed = counts.absorbed;
    report.points_after = model.num_points();
    report.points_3plus_after = model.num_points_3plus();
    report.observations_after = model.num_observations();
    let unconfirmed = tentative.into_iter().map(|update| [update.track[0], update.track[1]]).collect();
    Ok((report, unconfirmed))
}
