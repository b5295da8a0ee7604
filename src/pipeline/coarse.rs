//! The stages `coarse_match` and `coarse_model`, widened when the largest scales alone do not connect enough images.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use super::coarse_match::{CoarseMatches, Matcher};
use super::features::{ImageFeatures, StoredFeatures};
use super::growing::GrowingModels;
use super::intake::Intake;
use super::options::ReconstructionOptions;
use super::run::key;
use super::runner::{ArtifactKey, Runner, counts};
use super::state::{ModelState, PipelineState};
use super::units::Units;
use super::{PipelineError, Stage, StageKey};
use crate::add_cameras::MatchCounts;
use crate::camera::{Camera, Pixel};
use crate::coarse::look_alikes::{self, CutPair, LookAlikeAccount};
use crate::coarse::rotation_cycles::RotationForest;
use crate::coarse::selection::SelectionOptions;
use crate::coarse::{CoarseModels, MapperImage, MapperInput, MapperRun, MatchGraph};
use crate::scene::{ApartImages, CameraId, ImageId, Reconstruction, RegisteredImage};

/// Number of coarse matches of every pair that was matched, verified or not: what ranked matching goes by.
pub type PairMatchCounts = MatchCounts;

/// What the coarse stages leave.
pub struct Coarse {
    /// The models and the images without one.
    pub state: PipelineState,
    /// Coarse matches of every pair.
    pub match_counts: PairMatchCounts,
    /// How the pairs that were not cut say that images are turned.
    pub rotations: RotationForest,
    /// Intrinsics as far as the pairs tell them.
    pub cameras: BTreeMap<CameraId, Camera>,
    /// Pairs that were cut as look-alikes.
    pub cut: Vec<CutPair>,
}

/// Matches and reconstructs the largest scales; widens the selection while too few images are registered and keeps the best.
///
/// A selection takes over the pairs among those images that the largest model so far holds firmly. Not so after the
/// trial: where its few features leave images out, they hold the others together but weakly, too, and a street of 29
/// photographs went astray at such joins. And where the trial finds look-alikes, it isn't trusted to tell them apart.
/// So a trial is taken or forgotten.
pub fn run(
    runner: &mut Runner<'_>,
    intake: &Intake,
    found: &BTreeMap<ImageId, ImageFeatures>,
    options: &ReconstructionOptions,
    base_key: &ArtifactKey,
    notes: &mut Vec<String>,
) -> Result<Coarse, PipelineError> {
    let context = runner.context;
    let usable = found.values().filter(|image| matches!(image.count, Ok(count) if count > 0)).count();
    let mut best: Option<(CoarseModels, LookAlikeAccount)> = None;
    let mut before = CoarseMatches::default();
    let full = &options.coarse.selection;
    let trial = full.trial(usable).map(|selection| (selection, true));
    let selections = std::iter::successors(Some(full.clone()), SelectionOptions::widened);
    let tries = trial.into_iter().chain(selections.map(|selection| (selection, false)));
    for (round, (selection, is_trial)) in (1u32..).zip(tries) {
        let iteration = (round > 1).then_some(round);
        let settled = best.as_ref().and_then(|(models, _)| models.models.first());
        let settled = settled.map(|model| firmly_held(model, full.settled_from_points)).unwrap_or_default();
        let match_key = ArtifactKey::of("coarse_match", &[&base_key.0, &selection]);
        let matches: CoarseMatches = runner.stage(
            StageKey { stage: Stage::CoarseMatch, iteration },
            Some(&match_key),
            0,
            |store, progress| {
                let features = StoredFeatures::new(store, found);
                let matcher = Matcher {
                    units: Units::new(store, Stage::CoarseMatch, &match_key),
                    intake,
                    found,
                    options: &options.coarse,
                    selection: &selection,
                    features: &features,
                    context,
                };
                let result = matcher.run(&before, &settled, progress)?;
                features.check(Stage::CoarseMatch)?;
                Ok(result)
            },
        )?;
        let model_key = ArtifactKey::of("coarse_model", &[&match_key.0]);
        let stage = StageKey { stage: Stage::CoarseModel, iteration };
        let (models, account): (CoarseModels, LookAlikeAccount) =
            runner.stage(stage, Some(&model_key), usable as u64, |store, progress| {
                let features = StoredFeatures::new(store, found);
                let input = mapper_input(intake, &features, &matches);
                features.check(Stage::CoarseModel)?;
                let growing = GrowingModels::new(Units::new(store, Stage::CoarseModel, &model_key));
                let run = MapperRun {
                    seed: context.seed,
                    keep_going: &|| !context.cancel.is_cancelled() && !growing.has_failed(),
                    progress: &|registered| progress.set(registered as u64, usable as u64),
                    checkpoints: &growing,
                };
                let coarse = &options.coarse;
                let (models, account) = look_alikes::reconstruct(&input, &coarse.look_alikes, &coarse.mapper, &run);
                let images_reused = growing.finish()?;
                context.check_cancelled()?;
                let points = models.models.iter().map(|model| model.num_points()).sum();
                let totals = counts([
                    ("images", registered(&models)),
                    ("images_reused", images_reused),
                    ("models", models.models.len()),
                    ("points", points),
                    ("pairs_doubted", account.suspected),
                    ("pairs_cut", account.cut.len()),
                ]);
                Ok(((models, account), totals))
            })?;
        if is_trial && account.apart_share() > full.trial_max_apart_share {
            notes.push(
                "Some photographs show different places that look alike: more features were matched to tell them apart."
                    .to_owned(),
            );
            continue;
        }
        let largest = |models: &CoarseModels| models.models.first().map_or(0, |model| model.images().len());
        let reached = largest(&models);
        let is_enough = reached as f64 >= options.coarse.enough_registered * usable as f64;
        let is_flat = reached == 0 && matches.graph.degrees().len() == usable && matches.graph.is_flat();
        let fell_short = format!(
            "{} brought {reached} of {usable} photographs into the largest coarse model{}.",
            selection.described(),
            if selection.widened().is_some() { "; more were tried after that" } else { "" }
        );
        if is_trial && !is_enough && !is_flat {
            notes.push(fell_short);
            continue;
        }
        for note in &matches.notes {
            if !notes.contains(note) {
                notes.push(note.clone());
            }
        }
        if best.as_ref().is_none_or(|(best, _)| (reached, registered(&models)) > (largest(best), registered(best))) {
            best = Some((models, account));
        }
        before = matches;
        if is_enough {
            break;
        }
        if is_flat {
            notes.push(
                "All photographs match others, but as if the camera had only been turned: no two show depth. Where an object \
                 of little texture was turned in front of a still background, mask the background (masks/<name>.png, 0 \
                 where a picture is to be left out)."
                    .to_owned(),
            );
            break;
        }
        notes.push(fell_short);
    }
    let (models, account) = best.unwrap_or_default();
    notes.extend(background_note(&before));
    notes.extend(look_alike_note(&account, intake));
    let mut state = PipelineState {
        models: models.models.into_iter().map(ModelState::new).collect(),
        unregistered: models.unregistered,
        most_alike: most_alike(&before.graph),
    };
    state.record(key(Stage::CoarseModel));
    for cut in &account.cut {
        before.graph.pairs.remove(&cut.images);
    }
    let camera_of = intake.camera_of_image();
    let rotations = RotationForest::of(&before.graph, |id| &before.cameras[&camera_of[&id]]);
    Ok(Coarse { state, match_counts: before.match_counts, rotations, cameras: before.cameras, cut: account.cut })
}

/// The images that a model sees at least so many points of.
fn firmly_held(model: &Reconstruction, from_points: usize) -> BTreeSet<ImageId> {
    let sees_enough = |image: &RegisteredImage| image.num_observations() >= from_points;
    model.images().iter().filter(|(_, image)| sees_enough(image)).map(|(&id, _)| id).collect()
}

/// What was left out because it stands still in the frame, if anything was.
fn background_note(matches: &CoarseMatches) -> Option<String> {
    let count = matches.before_background.len();
    (count > 0).then(|| {
        format!(
            "In {count} photographs something stands still in the frame while the rest has moved, such as the background of a \
             turntable or a stamp. It was left out."
        )
    })
}

/// Pairs a note names; the report lists them all.
const NAMED_PAIRS: usize = 5;

/// What was cut, strongest first, and why.
fn look_alike_note(account: &LookAlikeAccount, intake: &Intake) -> Option<String> {
    if account.cut.is_empty() {
        return None;
    }
    let mut strongest: Vec<&CutPair> = account.cut.iter().collect();
    strongest.sort_by_key(|cut| (std::cmp::Reverse(cut.matches), cut.images));
    let named: Vec<String> = strongest
        .iter()
        .take(NAMED_PAIRS)
        .map(|cut| {
            let why = cut.displacement.map_or_else(
                || "no stronger pairs confirm them".to_owned(),
                |displacement| format!("the places lie {displacement:.2} camera distances apart"),
            );
            let (a, b) = (intake.name(cut.images.0), intake.name(cut.images.1));
            format!("{a} and {b} ({} matches; {why})", cut.matches)
        })
        .collect();
    Some(format!(
        "{} pairs of photographs match although stronger chains of pairs say that they show different places that look \
         alike. They were left out: {}{}.",
        account.cut.len(),
        named.join(", "),
        if account.cut.len() > NAMED_PAIRS { " and others" } else { "" }
    ))
}

/// The image that each image shares most verified matches with; of equals the first.
fn most_alike(graph: &MatchGraph) -> BTreeMap<ImageId, ImageId> {
    let mut best: BTreeMap<ImageId, (usize, ImageId)> = BTreeMap::new();
    for (&(a, b), geometry) in &graph.pairs {
        for (image, other) in [(a, b), (b, a)] {
            let inliers = geometry.inliers.len();
            if best.get(&image).is_none_or(|(most, _)| inliers > *most) {
                best.insert(image, (inliers, other));
            }
        }
    }
    best.into_iter().map(|(image, (_, other))| (image, other)).collect()
}

fn registered(models: &CoarseModels) -> usize {
    models.models.iter().map(|model| model.images().len()).sum()
}

fn mapper_input(intake: &Intake, features: &StoredFeatures<'_>, matches: &CoarseMatches) -> MapperInput {
    let images = intake.photographs().map(|(id, _, photograph)| {
        let camera = photograph.camera;
        (id, MapperImage { camera, keypoints: positions(features, id) })
    });
    MapperInput {
        images: images.collect(),
        cameras: matches.cameras.clone(),
        graph: matches.graph.clone(),
        apart: ApartImages::default(),
    }
}

/// The position of every keypoint of an image.
fn positions(stored: &StoredFeatures<'_>, id: ImageId) -> Arc<[Pixel]> {
    let features = stored.read(id, None);
    features.keypoints.iter().map(|keypoint| Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{KeypointIdx, Observation};
    use crate::synthetic::{SceneOptions, generate};

    #[test]
    fn an_image_is_held_firmly_by_enough_points() {
        let mut model = generate(&SceneOptions { num_images: 5, num_points: 300, ..SceneOptions::default() }).truth;
        let all: BTreeSet<ImageId> = model.images().keys().copied().collect();
        let weak = *all.first().unwrap();
        let seen = (0u32..).map(KeypointIdx).zip(model.images()[&weak].points().to_vec());
        let seen: Vec<_> = seen.filter_map(|(keypoint, point)| Some((point?, keypoint))).collect();
        assert!(seen.len() > 20);
        for &(point, keypoint) in &seen[20..] {
            model.remove_observation(point, Observation { image: weak, keypoint });
        }
        assert_eq!(firmly_held(&model, 20), all);
        assert_eq!(firmly_held(&model, 21), &all - &BTreeSet::from([weak]));
    }
}
