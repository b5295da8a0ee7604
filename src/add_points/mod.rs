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
//! - [`triangulate`] (6.3): each image's matches as tracks, and their points;
//! - [`merge`] (6.3): the pieces of one point made one;
//! - [`strays`]: points that rest on one match and lie where nothing else is, taken out at the end.
//!
//! A pair is a unit of work ([`match_pair`]): a pure function of the model, both images' features, options and seed. Poses
//! are not changed; every pair and every image is independent of the others, and results are put together in id order, so
//! the number of threads does not show.

pub mod candidate_pairs;
pub mod candidate_search;
pub mod epipolar;
pub mod grid;
pub mod guided_match;
pub mod line_groups;
pub mod merge;
pub mod one_way;
mod options;
pub mod pencil;
pub mod prepared;
pub mod strays;
pub mod sweep;
#[cfg(test)]
mod test_scene;
#[cfg(test)]
mod tests;
pub mod triangulate;
pub mod views;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use candidate_pairs::{CandidatePair, candidate_pairs};
pub use candidate_search::CandidateSearch;
pub use guided_match::{KeypointMatch, guided_match};
pub use options::{
    AddPointsOptions, BlockOptions, CandidatePairOptions, GuidedMatchOptions, PixelScaling, TriangulationOptions,
};
pub use prepared::PreparedImage;
pub use strays::{StrayOptions, remove_strays};
pub use triangulate::PairMatches;

use crate::scene::{Features, ImageId, KeypointIdx, Reconstruction};

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
/// Hears of units done and of all units.
pub type Progress<'a> = dyn Fn(usize, usize) + Sync + 'a;
/// Whether somebody asked to stop.
pub type Cancelled<'a> = dyn Fn() -> bool + Sync + 'a;

/// The whole stage: chooses pairs, matches them, and adds what they show to the model. With `new_images`, only pairs with
/// one of them are matched (the paper's later iterations).
///
/// # Errors
/// When cancelled (the model is then unchanged), or when features are not those of the model's keypoints.
pub fn add_points(
    model: &mut Reconstruction,
    features: &LoadFeatures,
    new_images: Option<&BTreeSet<ImageId>>,
    options: &AddPointsOptions,
    seed: u64,
    progress: &Progress,
    cancelled: &Cancelled,
) -> Result<AddPointsReport, AddPointsError> {
    let pairs = candidate_pairs(model, new_images, &options.candidate_pairs);
    let matches = match_pairs(model, &pairs, features, options, seed, progress, cancelled)?;
    if cancelled() {
        return Err(AddPointsError::Cancelled);
    }
    Ok(add_matches(model, &matches, options))
}

/// The matches of one pair: the unit of work of this stage.
///
/// # Errors
/// When an image is not registered or the features are not those of the model's keypoints.
pub fn match_pair(
    model: &Reconstruction,
    (first, second): (ImageId, ImageId),
    (first_features, second_features): (Arc<Features>, Arc<Features>),
    options: &AddPointsOptions,
    seed: u64,
) -> Result<PairMatches, AddPointsError> {
    let a = prepare(model, first, first_features, options)?;
    let b = prepare(model, second, second_features, options)?;
    Ok(match_prepared(model, (first, &a), (second, &b), options, seed))
}

/// The matches of many pairs, in their order. Images are prepared once per tile of pairs ([`BlockOptions`]), and pairs are
/// matched in parallel.
///
/// # Errors
/// When cancelled, when an image is not registered or features are not those of the model's keypoints.
pub fn match_pairs(
    model: &Reconstruction,
    pairs: &[CandidatePair],
    features: &LoadFeatures,
    options: &AddPointsOptions,
    seed: u64,
    progress: &Progress,
    cancelled: &Cancelled,
) -> Result<Vec<PairMatches>, AddPointsError> {
    let done = AtomicUsize::new(0);
    let mut matches: Vec<PairMatches> = Vec::with_capacity(pairs.len());
    let mut prepared: BTreeMap<ImageId, PreparedImage> = BTreeMap::new();
    for tile in tiles(model, pairs, options.blocks.images_per_block) {
        let needed: BTreeSet<ImageId> = tile.iter().flat_map(|pair| [pair.first, pair.second]).collect();
        prepared.retain(|id, _| needed.contains(id));
        let missing: Vec<ImageId> = needed.into_iter().filter(|id| !prepared.contains_key(id)).collect();
        let fresh: Vec<(ImageId, PreparedImage)> = missing
            .into_par_iter()
            .map(|id| {
                if cancelled() {
                    return Err(AddPointsError::Cancelled);
                }
                Ok((id, prepare(model, id, features(id), options)?))
            })
            .collect::<Result<_, _>>()?;
        prepared.extend(fresh);
        let of_tile: Vec<PairMatches> = tile
            .par_iter()
            .map(|pair| {
                if cancelled() {
                    return Err(AddPointsError::Cancelled);
                }
                let (a, b) = ((pair.first, &prepared[&pair.first]), (pair.second, &prepared[&pair.second]));
                let found = match_prepared(model, a, b, options, seed);
                progress(done.fetch_add(1, Ordering::Relaxed) + 1, pairs.len());
                Ok(found)
            })
            .collect::<Result<_, _>>()?;
        matches.extend(of_tile);
    }
    matches.sort_by_key(|pair| (pair.first, pair.second));
    Ok(matches)
}

/// Brings matches into the model: tracks per image, triangulation, merging (6.3).
pub fn add_matches(model: &mut Reconstruction, matches: &[PairMatches], options: &AddPointsOptions) -> AddPointsReport {
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
        let stars = triangulate::star_tracks(model, &table, matches);
        merge::merge_tracks(model, &table, &stars, &options.triangulation)
    };
    let counts = merge::apply_updates(model, &updates);
    report.points_created = counts.created;
    report.points_extended = counts.extended;
    report.points_absorbed = counts.absorbed;
    report.points_after = model.num_points();
    report.points_3plus_after = model.num_points_3plus();
    report.observations_after = model.num_observations();
    report
}

/// An image of the model, prepared for matching.
fn prepare(
    model: &Reconstruction,
    id: ImageId,
    features: Arc<Features>,
    options: &AddPointsOptions,
) -> Result<PreparedImage, AddPointsError> {
    let image = model.image(id).ok_or(AddPointsError::NotRegistered(id))?;
    let (features_len, keypoints) = (features.len(), image.keypoints.len());
    if features_len != keypoints || features.descriptors.len() != keypoints {
        return Err(AddPointsError::FeaturesDoNotFit { image: id, features: features_len, keypoints });
    }
    Ok(PreparedImage::new(image, model.camera_of(id), features, &options.guided_match, &options.pixel_scaling))
}

fn match_prepared(
    model: &Reconstruction,
    first: (ImageId, &PreparedImage),
    second: (ImageId, &PreparedImage),
    options: &AddPointsOptions,
    seed: u64,
) -> PairMatches {
    let settled = shared_observations(model, first.0, second.0);
    let matches = guided_match(first, second, &settled, &options.guided_match, seed);
    PairMatches { first: first.0, second: second.0, matches }
}

/// Keypoints of two registered images that see one point.
fn shared_observations(model: &Reconstruction, first: ImageId, second: ImageId) -> Vec<(KeypointIdx, KeypointIdx)> {
    let seen = (0u32..).map(KeypointIdx).zip(model.images()[&first].points());
    seen.filter_map(|(keypoint, &point)| {
        let track = &model.point(point?)?.track;
        let at = track.binary_search_by_key(&second, |observation| observation.image).ok()?;
        Some((keypoint, track[at].keypoint))
    })
    .collect()
}

/// The pairs in tiles of `side` by `side` images, each tile in one piece.
fn tiles(model: &Reconstruction, pairs: &[CandidatePair], side: usize) -> Vec<Vec<CandidatePair>> {
    let rank_of: BTreeMap<ImageId, usize> = model.images().keys().enumerate().map(|(rank, &id)| (id, rank)).collect();
    let tile = |id: &ImageId| rank_of.get(id).map(|rank| rank / side);
    let mut tiles: BTreeMap<_, Vec<CandidatePair>> = BTreeMap::new();
    for pair in pairs {
        tiles.entry((tile(&pair.first), tile(&pair.second))).or_default().push(*pair);
    }
    tiles.into_values().collect()
}
