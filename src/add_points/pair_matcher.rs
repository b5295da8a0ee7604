//! Guided matching of many pairs: the units of work of this stage, and the images they share, prepared once.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use rayon::prelude::*;

use super::guided_match::guided_match;
use super::options::{AddPointsOptions, BlockOptions};
use super::prepared::PreparedImage;
use super::triangulate::PairMatches;
use super::{AddPointsError, Cancelled, CandidatePair, LoadFeatures};
use crate::scene::{Features, ImageId, KeypointIdx, Reconstruction, RegisteredImage};

/// The pairs in tiles of so many images by as many, each tile in one piece, so that images are prepared once a tile and memory
/// does not grow with their number. A side is never shorter than there are threads, or some would often be without work.
pub fn tiles(model: &Reconstruction, pairs: &[CandidatePair], blocks: &BlockOptions) -> Vec<Vec<CandidatePair>> {
    let rank_of: BTreeMap<ImageId, usize> = model.images().keys().enumerate().map(|(rank, &id)| (id, rank)).collect();
    let side = blocks.images_per_block.max(rayon::current_num_threads());
    let tile = |id: &ImageId| rank_of.get(id).map(|rank| rank / side);
    let mut tiles: BTreeMap<_, Vec<CandidatePair>> = BTreeMap::new();
    for pair in pairs {
        tiles.entry((tile(&pair.first), tile(&pair.second))).or_default().push(*pair);
    }
    tiles.into_values().collect()
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

/// Matches pairs of images that it was told to prepare.
pub struct PairMatcher<'a> {
    model: &'a Reconstruction,
    features: &'a LoadFeatures<'a>,
    options: &'a AddPointsOptions,
    seed: u64,
    prepared: BTreeMap<ImageId, PreparedImage>,
}

impl<'a> PairMatcher<'a> {
    /// A matcher with no image prepared.
    pub fn new(
        model: &'a Reconstruction,
        features: &'a LoadFeatures<'a>,
        options: &'a AddPointsOptions,
        seed: u64,
    ) -> Self {
        Self { model, features, options, seed, prepared: BTreeMap::new() }
    }

    /// Prepares the images of these pairs, in parallel, and lets go of all others.
    ///
    /// # Errors
    /// When cancelled, when an image is not registered or features are not those of the model's keypoints.
    pub fn prepare<'p>(
        &mut self,
        pairs: impl IntoIterator<Item = &'p CandidatePair>,
        cancelled: &Cancelled,
    ) -> Result<(), AddPointsError> {
        let needed: BTreeSet<ImageId> = pairs.into_iter().flat_map(|pair| [pair.first, pair.second]).collect();
        self.prepared.retain(|id, _| needed.contains(id));
        let missing: Vec<ImageId> = needed.into_iter().filter(|id| !self.prepared.contains_key(id)).collect();
        let fresh: Vec<(ImageId, PreparedImage)> = missing
            .into_par_iter()
            .map(|id| {
                if cancelled() {
                    return Err(AddPointsError::Cancelled);
                }
                Ok((id, prepare(self.model, id, (self.features)(id), self.options)?))
            })
            .collect::<Result<_, _>>()?;
        self.prepared.extend(fresh);
        Ok(())
    }

    /// The matches of these pairs, in their order, matched in parallel; `one_more` hears of each pair that is done.
    ///
    /// # Errors
    /// When cancelled.
    ///
    /// # Panics
    /// When an image of them was not prepared.
    pub fn match_pairs(
        &self,
        pairs: &[CandidatePair],
        one_more: &(dyn Fn() + Sync),
        cancelled: &Cancelled,
    ) -> Result<Vec<PairMatches>, AddPointsError> {
        let prepared = |id: ImageId| (id, &self.prepared[&id]);
        let matched = pairs.par_iter().map(|pair| {
            if cancelled() {
                return Err(AddPointsError::Cancelled);
            }
            let (first, second) = (prepared(pair.first), prepared(pair.second));
            let found = match_prepared(self.model, first, second, self.options, self.seed);
            one_more();
            Ok(found)
        });
        matched.collect()
    }
}

/// An image of the model, prepared for matching.
pub(super) fn prepare(
    model: &Reconstruction,
    id: ImageId,
    features: Arc<Features>,
    options: &AddPointsOptions,
) -> Result<PreparedImage, AddPointsError> {
    let image = image_of_features(model, id, &features)?;
    Ok(PreparedImage::new(image, model.camera_of(id), features, &options.guided_match, &options.pixel_scaling))
}

/// The registered image that features are of.
pub(super) fn image_of_features<'a>(
    model: &'a Reconstruction,
    id: ImageId,
    features: &Features,
) -> Result<&'a RegisteredImage, AddPointsError> {
    let image = model.image(id).ok_or(AddPointsError::NotRegistered(id))?;
    let (features_len, keypoints) = (features.len(), image.keypoints.len());
    if features_len != keypoints || features.descriptors.len() != keypoints {
        return Err(AddPointsError::FeaturesDoNotFit { image: id, features: features_len, keypoints });
    }
    Ok(image)
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
pub(super) fn shared_observations(
    model: &Reconstruction,
    first: ImageId,
    second: ImageId,
) -> Vec<(KeypointIdx, KeypointIdx)> {
    let seen = (0u32..).map(KeypointIdx).zip(model.images()[&first].points());
    seen.filter_map(|(keypoint, &point)| {
        let track = &model.point(point?)?.track;
        let at = track.binary_search_by_key(&second, |observation| observation.image).ok()?;
        Some((keypoint, track[at].keypoint))
    })
    .collect()
}
