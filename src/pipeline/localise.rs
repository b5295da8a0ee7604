//! The stage `add_cameras`: every photograph without a pose is localised against each model in turn, the largest first.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::coarse::PairMatchCounts;
use super::features::{FeatureCache, ImageFeatures};
use super::intake::Intake;
use super::options::ReconstructionOptions;
use super::runner::{Counts, StageProgress, counts};
use super::state::PipelineState;
use super::units::Units;
use super::{Context, PipelineError, Stage};
use crate::add_cameras::{LocalizeFailure, ModelSnapshot, Outcome, QueryImage, add_localized, localize_all};
use crate::camera::Camera;
use crate::coarse::Unregistered;
use crate::coarse::rotation_cycles::RotationForest;
use crate::scene::{CameraId, Features, ImageId, Reconstruction};

/// Images of a unit of work: a stop costs what a few images take, and storing a unit little next to that.
const UNIT_IMAGES: usize = 8;

/// What localisation is given besides the models.
pub struct Localiser<'a> {
    /// The photographs.
    pub intake: &'a Intake,
    /// Which of them have features.
    pub found: &'a BTreeMap<ImageId, ImageFeatures>,
    /// What is known of cameras no model has.
    pub cameras: &'a BTreeMap<CameraId, Camera>,
    /// Coarse matches of every pair.
    pub match_counts: &'a PairMatchCounts,
    /// How the pairs say that images are turned.
    pub rotations: &'a RotationForest,
    /// The features.
    pub cache: &'a FeatureCache<'a>,
    /// Where finished units are kept.
    pub units: &'a Units<'a>,
    /// All options.
    pub options: &'a ReconstructionOptions,
    /// Seed and cancel.
    pub context: &'a Context,
}

impl Localiser<'_> {
    /// Adds every photograph that can be localised.
    ///
    /// # Errors
    /// Cancellation, or features that were lost.
    pub fn run(
        &self,
        mut state: PipelineState,
        progress: &StageProgress<'_>,
    ) -> Result<(PipelineState, Counts), PipelineError> {
        let (mut tried, mut added, mut sightings, mut reused) = (0, 0, 0, 0);
        for rank in 0..state.models.len() {
            let queries = self.queries(&state);
            tried = tried.max(queries.len());
            if queries.is_empty() {
                continue;
            }
            let load = |id: ImageId| -> Arc<Features> { self.cache.get(id) };
            let model = &mut state.models[rank].model;
            let (options, seed) = (&self.options.add_cameras, self.context.seed);
            let snapshot = ModelSnapshot::build(model, &load, options);
            let (found, known) = self.localize(rank, model, &snapshot, &queries, progress)?;
            reused += known;
            let held = self.held_against_pairs(model, found);
            let account = add_localized(model, &snapshot, held, &load, options, seed);
            self.cache.check(Stage::AddCameras)?;
            added += account.added.len();
            sightings += account.observations_added;
            for id in account.added.keys() {
                state.unregistered.remove(id);
            }
            for (id, failure) in account.failed {
                if let Some(why) = reason(&failure) {
                    let before = state.unregistered.entry(id).or_insert(Unregistered::NoPairs);
                    if progress_of(&why) > progress_of(before) {
                        *before = why;
                    }
                }
            }
        }
        let totals = [
            ("images_tried", tried),
            ("images_reused", reused),
            ("images_added", added),
            ("observations_added", sightings),
        ];
        Ok((state, counts(totals)))
    }

    /// What localising each of `queries` against the model of this rank gives, and for how many an earlier run had found that.
    fn localize(
        &self,
        rank: usize,
        model: &Reconstruction,
        snapshot: &ModelSnapshot,
        queries: &[QueryImage],
        progress: &StageProgress<'_>,
    ) -> Result<(BTreeMap<ImageId, Outcome>, usize), PipelineError> {
        let done = AtomicUsize::new(0);
        let more = |count: usize| {
            progress.set((done.fetch_add(count, Ordering::Relaxed) + count) as u64, queries.len() as u64);
        };
        let cancelled = || self.context.cancel.is_cancelled();
        let load = |id: ImageId| -> Arc<Features> { self.cache.get(id) };
        let (options, seed) = (&self.options.add_cameras, self.context.seed);
        let (known, waiting) = self.units.split(rank, queries.chunks(UNIT_IMAGES))?;
        let mut found: BTreeMap<ImageId, Outcome> = known.into_iter().flat_map(BTreeMap::into_iter).collect();
        let reused = found.len();
        more(reused);
        let localized = waiting.into_par_iter().map(|unit| {
            let told = |_, _| more(1);
            let outcomes =
                localize_all(snapshot, model, unit, &load, self.match_counts, options, seed, &told, &cancelled);
            let outcomes = outcomes.map_err(|_| PipelineError::Cancelled)?;
            self.cache.check(Stage::AddCameras)?;
            self.units.keep(&(rank, unit), &outcomes)?;
            Ok(outcomes)
        });
        let localized: Vec<BTreeMap<ImageId, Outcome>> = localized.collect::<Result<_, PipelineError>>()?;
        found.extend(localized.into_iter().flatten());
        Ok((found, reused))
    }

    /// What was found, without the poses that are turned another way than pairs with the image say.
    fn held_against_pairs(
        &self,
        model: &Reconstruction,
        found: BTreeMap<ImageId, Outcome>,
    ) -> BTreeMap<ImageId, Outcome> {
        let options = &self.options.coarse.mapper.rotation_cycles;
        let held = found.into_iter().map(|(id, outcome)| {
            let checked = outcome.and_then(|localized| {
                let (pose, inliers) = (&localized.cam_from_world, localized.inliers.len());
                if self.rotations.contradicts_pose(model, id, pose, inliers, options) {
                    let correspondences = localized.num_correspondences;
                    return Err(LocalizeFailure::TurnedOtherwise { inliers, correspondences });
                }
                Ok(localized)
            });
            (id, checked)
        });
        held.collect()
    }

    /// The photographs that have features and no pose.
    fn queries(&self, state: &PipelineState) -> Vec<QueryImage> {
        let located = state.located();
        let waiting = self.intake.photographs().filter(|(id, _, _)| {
            !located.contains_key(id)
                && self.found.get(id).is_some_and(|image| matches!(image.count, Ok(count) if count > 0))
        });
        waiting
            .map(|(image, _, photograph)| QueryImage {
                image,
                camera_id: photograph.camera,
                camera: self.cameras[&photograph.camera].clone(),
            })
            .collect()
    }
}

/// Share of the inliers a pose needs from which on it nearly worked. Fewer agree by chance, in any picture, and say nothing.
const NEARLY: f64 = 0.5;

/// The verdict a failure amounts to; none where it says no more than is known already.
fn reason(failure: &LocalizeFailure) -> Option<Unregistered> {
    match *failure {
        LocalizeFailure::NoFeatures | LocalizeFailure::EmptyModel => None,
        LocalizeFailure::TooFewInliers { inliers, needed, .. } if (inliers as f64) < NEARLY * needed as f64 => None,
        LocalizeFailure::TooFewCorrespondences { found: visible, .. } => Some(Unregistered::TooFewPoints { visible }),
        LocalizeFailure::TooFewInliers { inliers, correspondences: visible, .. } => {
            Some(Unregistered::PoseFailed { visible, inliers })
        }
        LocalizeFailure::TurnedOtherwise { inliers, correspondences: visible } => {
            Some(Unregistered::TurnedOtherwise { visible, inliers })
        }
    }
}

/// How far an attempt came: the verdict is that of the one that came farthest. A photograph without any verified pair stays
/// one that matches nothing, unless a pose nearly worked.
fn progress_of(why: &Unregistered) -> usize {
    match *why {
        Unregistered::TooFewPoints { .. } => 0,
        Unregistered::NoPairs | Unregistered::TooFewTogether { .. } | Unregistered::NoInitialPair => 1,
        Unregistered::PoseFailed { inliers, .. } | Unregistered::TurnedOtherwise { inliers, .. } => 1 + inliers,
    }
}
