//! Adding cameras to the model (paper, section 5).
//!
//! The coarse model is global, so every image it lacks can be localised against it on its own: find which of the image's
//! features see which points of the model, and place the camera by them. No image waits for another; all are added at once.
//!
//! - [`snapshot`]: the model as localisation needs it (positions, mean descriptors, visual words), built once a round;
//! - [`set_cover`]: a part of a large model that still covers every camera;
//! - [`vocabulary`]: the visual words, trained on the model itself;
//! - [`active_search`], [`ranked_match`], [`direct_match`]: three ways to find correspondences, tried in this order;
//! - [`pose`]: the pose, its acceptance, and why it was not accepted;
//! - [`localize`]: the unit of work, one image; and all images in parallel;
//! - [`apply`]: the localised images into the model, and their sightings into its tracks.
//!
//! An image is a pure function of snapshot, model, its own features, those of a few localised images, options and seed.

pub mod active_search;
pub mod apply;
pub mod correspondences;
pub mod direct_match;
pub mod localize;
mod options;
pub mod pose;
pub mod ranked_match;
pub mod set_cover;
pub mod snapshot;
#[cfg(test)]
mod tests;
pub mod vocabulary;

use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

pub use apply::{AppliedReport, apply};
pub use correspondences::Correspondence;
pub use localize::{Localized, QueryImage, localize_all, localize_image};
pub use options::{
    ActiveSearchOptions, AddCamerasOptions, DirectMatchOptions, LocalizationMethod, PoseOptions, RankedMatchOptions,
    SetCoverOptions, VocabularyOptions,
};
pub use pose::LocalizeFailure;
pub use snapshot::ModelSnapshot;

use crate::scene::{Features, ImageId, Reconstruction};

/// Loads an image's features.
pub type LoadFeatures<'a> = dyn Fn(ImageId) -> Arc<Features> + Sync + 'a;
/// Number of coarse matches of every pair that was matched, the smaller id first.
pub type MatchCounts = BTreeMap<(ImageId, ImageId), u32>;
/// Hears of images done and of all images.
pub type Progress<'a> = dyn Fn(usize, usize) + Sync + 'a;
/// Whether somebody asked to stop.
pub type Cancelled<'a> = dyn Fn() -> bool + Sync + 'a;

/// Somebody asked to stop; the model is unchanged.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
#[error("the addition of cameras was cancelled")]
pub struct AddCamerasCancelled;

/// What the stage did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct AddCamerasReport {
    /// Images tried.
    pub images_tried: usize,
    /// How each image that was added was found, and with how many inliers.
    pub added: BTreeMap<ImageId, AddedImage>,
    /// Why each of the others was not.
    pub failed: BTreeMap<ImageId, LocalizeFailure>,
    /// Points of the model that were searched: all, or a cover of a large model.
    pub points_searched: usize,
    /// Visual words.
    pub words: usize,
    /// Sightings added to tracks.
    pub observations_added: usize,
}

/// An image that was added.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AddedImage {
    /// What found its correspondences.
    pub method: LocalizationMethod,
    /// Correspondences found.
    pub correspondences: usize,
    /// Those that agree with its pose.
    pub inliers: usize,
}

/// What localising an image gave.
pub type Outcome = Result<Localized, LocalizeFailure>;

/// Adds to the model the images that could be localised against a snapshot of it.
pub fn add_localized(
    model: &mut Reconstruction,
    snapshot: &ModelSnapshot,
    found: BTreeMap<ImageId, Outcome>,
    features: &LoadFeatures,
    options: &AddCamerasOptions,
    seed: u64,
) -> AddCamerasReport {
    let images_tried = found.len();
    let mut localized = BTreeMap::new();
    let mut failed = BTreeMap::new();
    for (id, outcome) in found {
        match outcome {
            Ok(found) => {
                localized.insert(id, found);
            }
            Err(failure) => {
                failed.insert(id, failure);
            }
        }
    }
    let applied = apply(model, &localized, features, &options.pose, seed);
    failed.extend(applied.rejected);
    let added = localized
        .iter()
        .filter(|(id, _)| model.image(**id).is_some())
        .map(|(&id, found)| {
            let inliers = found.inliers.len();
            (id, AddedImage { method: found.method, correspondences: found.num_correspondences, inliers })
        })
        .collect();
    AddCamerasReport {
        images_tried,
        added,
        failed,
        points_searched: snapshot.len(),
        words: snapshot.vocabulary.num_words(),
        observations_added: applied.observations_added,
    }
}
