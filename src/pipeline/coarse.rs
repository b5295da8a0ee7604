//! The stages `coarse_match` and `coarse_model`, widened when the largest scales alone do not connect enough images.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::features::{FeatureCache, ImageFeatures};
use super::intake::{Intake, Photograph};
use super::options::{CoarseOptions, ReconstructionOptions};
use super::run::key;
use super::runner::{ArtifactKey, Counts, Runner, StageProgress, counts};
use super::state::{ModelState, PipelineState};
use super::units::Units;
use super::{Context, PipelineError, Stage, StageKey, focals};
use crate::add_cameras::MatchCounts;
use crate::camera::{Camera, FocalSource, Pixel};
use crate::coarse::hybrid_match::{CoarseDescriptors, match_hybrid};
use crate::coarse::look_alikes::{self, CutPair, LookAlikeAccount};
use crate::coarse::pair_selection::{GeoPosition, PairingImage, select_pairs};
use crate::coarse::selection::SelectionOptions;
use crate::coarse::{CoarseModels, MapperImage, MapperInput, MatchGraph};
use crate::matching::two_view::{self, TwoViewGeometry};
use crate::math::Rng;
use crate::scene::{ApartImages, CameraId, Features, ImageId, KeypointIdx};

/// Number of coarse matches of every pair that was matched, verified or not: what ranked matching goes by.
pub type PairMatchCounts = MatchCounts;

/// What the coarse stages leave.
pub struct Coarse {
    /// The models and the images without one.
    pub state: PipelineState,
    /// Coarse matches of every pair.
    pub match_counts: PairMatchCounts,
    /// Intrinsics as far as the pairs tell them.
    pub cameras: BTreeMap<CameraId, Camera>,
    /// Pairs that were cut as look-alikes.
    pub cut: Vec<CutPair>,
}

/// The result of `coarse_match`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
struct CoarseMatches {
    graph: MatchGraph,
    match_counts: PairMatchCounts,
    cameras: BTreeMap<CameraId, Camera>,
    notes: Vec<String>,
}

/// Tells the random streams of verification from others.
const STREAM: u64 = 0x7477_6f5f_7669_6577;
/// Memory for features read for their positions; they are read once here, so little is kept.
const POSITION_CACHE_BYTES: usize = 64 << 20;
/// Images a side of a tile of pairs: with the default selection of 16K features, 64 images are 60 MB. Sets up to this size are
/// one tile.
const TILE_IMAGES: u32 = 64;

/// Matches and reconstructs the largest scales; widens the selection while too few images are registered and keeps the best.
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
    let selections = std::iter::successors(Some(options.coarse.selection.clone()), SelectionOptions::widened);
    for (round, selection) in (1u32..).zip(selections) {
        let iteration = (round > 1).then_some(round);
        let settled = best
            .as_ref()
            .and_then(|(models, _)| models.models.first())
            .map(|model| model.images().keys().copied().collect());
        let match_key = ArtifactKey::of("coarse_match", &[&base_key.0, &selection]);
        let matches: CoarseMatches = runner.stage(
            StageKey { stage: Stage::CoarseMatch, iteration },
            Some(&match_key),
            0,
            |store, progress| {
                let cache = FeatureCache::new(store, found, POSITION_CACHE_BYTES);
                let matcher = Matcher {
                    units: Units::new(store, Stage::CoarseMatch, &match_key),
                    intake,
                    found,
                    options: &options.coarse,
                    selection: &selection,
                    cache: &cache,
                    context,
                };
                let result = matcher.run(&before, &settled.unwrap_or_default(), progress)?;
                cache.check(Stage::CoarseMatch)?;
                Ok(result)
            },
        )?;
        let model_key = ArtifactKey::of("coarse_model", &[&match_key.0]);
        let stage = StageKey { stage: Stage::CoarseModel, iteration };
        let (models, account): (CoarseModels, LookAlikeAccount) =
            runner.stage(stage, Some(&model_key), usable as u64, |store, progress| {
                let cache = FeatureCache::new(store, found, POSITION_CACHE_BYTES);
                let input = mapper_input(intake, &cache, &matches);
                cache.check(Stage::CoarseModel)?;
                let keep_going = || !context.cancel.is_cancelled();
                let told = |registered: usize| progress.set(registered as u64, usable as u64);
                let coarse = &options.coarse;
                let (models, account) = look_alikes::reconstruct(
                    &input,
                    &coarse.look_alikes,
                    &coarse.mapper,
                    context.seed,
                    &keep_going,
                    &told,
                );
                context.check_cancelled()?;
                let points = models.models.iter().map(|model| model.num_points()).sum();
                let totals = counts([
                    ("images", registered(&models)),
                    ("models", models.models.len()),
                    ("points", points),
                    ("pairs_doubted", account.suspected),
                    ("pairs_cut", account.cut.len()),
                ]);
                Ok(((models, account), totals))
            })?;
        for note in &matches.notes {
            if !notes.contains(note) {
                notes.push(note.clone());
            }
        }
        let largest = |models: &CoarseModels| models.models.first().map_or(0, |model| model.images().len());
        let reached = largest(&models);
        if best.as_ref().is_none_or(|(best, _)| (reached, registered(&models)) > (largest(best), registered(best))) {
            best = Some((models, account));
        }
        before = matches;
        if reached as f64 >= options.coarse.enough_registered * usable as f64 {
            break;
        }
        if reached == 0 && before.graph.degrees().len() == usable && before.graph.is_flat() {
            notes.push(
                "All photographs match others, but as if the camera had only been turned: no two show depth. Where an object \
                 was turned in front of a still background, mask the background (masks/<name>.png, 0 where a picture is to \
                 be left out)."
                    .to_owned(),
            );
            break;
        }
        notes.push(format!(
            "The {:.0} % of the features of largest scale brought {reached} of {usable} photographs into the largest coarse \
             model{}.",
            selection.eta_percent,
            if selection.widened().is_some() { "; a larger share was tried after that" } else { ", and these are all features" }
        ));
    }
    let (models, account) = best.unwrap_or_default();
    notes.extend(look_alike_note(&account, intake));
    let mut state = PipelineState {
        models: models
            .models
            .into_iter()
            .map(|model| ModelState { model, registered_in: BTreeMap::new(), history: Vec::new() })
            .collect(),
        unregistered: models.unregistered,
        most_alike: most_alike(&before.graph),
    };
    state.record(key(Stage::CoarseModel));
    Ok(Coarse { state, match_counts: before.match_counts, cameras: before.cameras, cut: account.cut })
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

fn mapper_input(intake: &Intake, cache: &FeatureCache<'_>, matches: &CoarseMatches) -> MapperInput {
    let images = intake.photographs().map(|(id, _, photograph)| {
        let camera = photograph.camera;
        (id, MapperImage { camera, keypoints: positions(cache, id) })
    });
    MapperInput {
        images: images.collect(),
        cameras: matches.cameras.clone(),
        graph: matches.graph.clone(),
        apart: ApartImages::default(),
    }
}

/// The position of every keypoint of an image.
fn positions(cache: &FeatureCache<'_>, id: ImageId) -> Arc<[Pixel]> {
    let features = cache.read(id, None);
    features.keypoints.iter().map(|keypoint| Pixel::new(f64::from(keypoint.x), f64::from(keypoint.y))).collect()
}

/// Pairs of a unit of work: what a run that is stopped may have to do again, a few CPU seconds.
const UNIT_PAIRS: usize = 256;

/// Two photographs, the lower id first.
type Pair = (ImageId, ImageId);

/// One run of `coarse_match`.
struct Matcher<'a> {
    units: Units<'a>,
    intake: &'a Intake,
    found: &'a BTreeMap<ImageId, ImageFeatures>,
    options: &'a CoarseOptions,
    selection: &'a SelectionOptions,
    cache: &'a FeatureCache<'a>,
    context: &'a Context,
}

/// Number of matches of a pair, and what its verification found.
type Matched = (Pair, (u32, Option<TwoViewGeometry>));

/// The selected features of an image. Only those of a tile of pairs are in memory at a time.
struct Selected {
    descriptors: CoarseDescriptors,
    pixels: Vec<Pixel>,
    camera: CameraId,
}

impl Matcher<'_> {
    /// Matches and verifies the selected pairs. Pairs between `settled` images, which one model already holds, keep what an
    /// earlier, narrower round found.
    fn run(
        &self,
        before: &CoarseMatches,
        settled: &BTreeSet<ImageId>,
        progress: &StageProgress<'_>,
    ) -> Result<(CoarseMatches, Counts), PipelineError> {
        let pairs: Vec<Pair> =
            self.pairs().into_iter().filter(|(a, b)| !(settled.contains(a) && settled.contains(b))).collect();
        let done = AtomicU64::new(0);
        let more = |count: usize| {
            let count = count as u64;
            progress.set(done.fetch_add(count, Ordering::Relaxed) + count, pairs.len() as u64);
        };
        let mut reused = 0;
        let known = |unit: &[Pair]| {
            let stored: Option<Vec<Matched>> = self.units.known(&unit)?;
            if stored.is_some() {
                reused += unit.len();
                more(unit.len());
            }
            Ok(stored)
        };
        let work = |(a, b): Pair, (in_a, in_b): (&Selected, &Selected)| {
            let matches = match_hybrid(&in_a.descriptors, &in_b.descriptors, &self.options.matching).matches;
            let geometry = self.verify((a, b), (in_a, in_b), &matches, &self.intake.cameras);
            more(1);
            (matches.len() as u32, geometry)
        };
        let matched = self.for_pairs(&pairs, known, work, |unit, results| self.units.keep(&unit, results))?;
        self.context.check_cancelled()?;

        let mut result = CoarseMatches {
            graph: before.graph.clone(),
            match_counts: before.match_counts.clone(),
            ..Default::default()
        };
        let (mut tentative, mut verified) = (0, 0);
        for (pair, (count, geometry)) in matched {
            tentative += usize::from(count > 0);
            result.match_counts.insert(pair, count);
            if let Some(geometry) = geometry {
                verified += 1;
                result.graph.pairs.insert(pair, geometry);
            }
        }
        result.cameras = if before.cameras.is_empty() {
            let mut cameras = self.intake.cameras.clone();
            result.notes = focals::settle(&result.graph, &mut cameras, &self.camera_of_image(), &self.options.focals);
            cameras
        } else {
            before.cameras.clone()
        };
        self.reverify(&mut result)?;
        self.context.check_cancelled()?;
        let inliers = result.graph.pairs.values().map(|geometry| geometry.inliers.len()).sum();
        let selected = self.usable().map(|(_, _, count)| self.selection.num_selected(count)).sum();
        let totals = counts([
            ("pairs_tried", pairs.len()),
            ("pairs_reused", reused),
            ("pairs_matched", tentative),
            ("pairs_verified", verified),
            ("features_selected", selected),
            ("inlier_matches", inliers),
        ]);
        Ok((result, totals))
    }

    /// The images that have features, with their number.
    fn usable(&self) -> impl Iterator<Item = (ImageId, &Photograph, usize)> {
        self.intake
            .photographs()
            .filter_map(|(id, _, photograph)| Some((id, photograph, *self.found.get(&id)?.count.as_ref().ok()?)))
    }

    fn camera_of_image(&self) -> BTreeMap<ImageId, CameraId> {
        self.usable().map(|(id, photograph, _)| (id, photograph.camera)).collect()
    }

    /// The pairs to match, by the few features of largest scale that pair selection looks at.
    fn pairs(&self) -> Vec<Pair> {
        let options = &self.options.pairs;
        let usable: Vec<_> = self.usable().collect();
        let all_pairs = usable.len() <= options.exhaustive_up_to;
        let tops: Vec<Features> = usable
            .par_iter()
            .map(|&(id, _, count)| {
                let wanted = if all_pairs { 0 } else { options.preemptive_features };
                self.cache.read(id, Some(wanted.min(self.selection.num_selected(count))))
            })
            .collect();
        let position = |photograph: &Photograph| {
            let gps = photograph.exif.gps.as_ref()?;
            Some(GeoPosition { latitude_deg: gps.latitude_deg, longitude_deg: gps.longitude_deg })
        };
        let pairing: Vec<PairingImage<'_>> = usable
            .iter()
            .zip(&tops)
            .map(|(&(id, photograph, _), top)| PairingImage {
                id,
                descriptors: &top.descriptors,
                position: position(photograph),
            })
            .collect();
        select_pairs(&pairing, options).into_keys().collect()
    }

    /// Reads the features of largest scale of an image.
    fn select(&self, id: ImageId, camera: CameraId) -> Selected {
        let count = self.found.get(&id).and_then(|image| image.count.as_ref().ok()).copied().unwrap_or(0);
        let features = self.cache.read(id, Some(self.selection.num_selected(count)));
        let pixels = features.keypoints.iter().map(|at| Pixel::new(f64::from(at.x), f64::from(at.y))).collect();
        Selected { pixels, descriptors: CoarseDescriptors::new(&features.descriptors), camera }
    }

    /// Does `work` for every pair, in parallel, with the selected features of both images, unless the unit of work that the pair
    /// belongs to is `known`; a unit that is done is `kept`. Pairs are done in tiles of images that share what was read, so that
    /// memory does not grow with the number of images. Once cancelled, what is left is left out.
    fn for_pairs<T: Send>(
        &self,
        pairs: &[Pair],
        mut known: impl FnMut(&[Pair]) -> Result<Option<Vec<(Pair, T)>>, PipelineError>,
        work: impl Fn(Pair, (&Selected, &Selected)) -> T + Sync,
        keep: impl Fn(&[Pair], &[(Pair, T)]) -> Result<(), PipelineError>,
    ) -> Result<Vec<(Pair, T)>, PipelineError> {
        let cameras = self.camera_of_image();
        let mut tiles: BTreeMap<(u32, u32), Vec<Pair>> = BTreeMap::new();
        for &(a, b) in pairs {
            tiles.entry((a.0 / TILE_IMAGES, b.0 / TILE_IMAGES)).or_default().push((a, b));
        }
        let mut images: BTreeMap<ImageId, Selected> = BTreeMap::new();
        let mut results = Vec::with_capacity(pairs.len());
        for unit in tiles.values().flat_map(|tile| tile.chunks(UNIT_PAIRS)) {
            if self.context.cancel.is_cancelled() {
                break;
            }
            if let Some(stored) = known(unit)? {
                results.extend(stored);
                continue;
            }
            let needed: BTreeSet<ImageId> = unit.iter().flat_map(|&(a, b)| [a, b]).collect();
            // Units of one tile share images; whatever is of another goes.
            let same_tile = |id: &ImageId| needed.iter().any(|other| other.0 / TILE_IMAGES == id.0 / TILE_IMAGES);
            images.retain(|id, _| same_tile(id));
            let missing: Vec<ImageId> = needed.into_iter().filter(|id| !images.contains_key(id)).collect();
            let read = missing.into_par_iter().map(|id| (id, self.select(id, cameras[&id])));
            images.extend(read.collect::<Vec<_>>());
            let of_unit = unit.par_iter().filter_map(|&(a, b)| {
                let done = (!self.context.cancel.is_cancelled()).then(|| work((a, b), (&images[&a], &images[&b])));
                Some(((a, b), done?))
            });
            let of_unit: Vec<_> = of_unit.collect();
            if of_unit.len() == unit.len() {
                keep(unit, &of_unit)?;
            }
            results.extend(of_unit);
        }
        Ok(results)
    }

    fn verify(
        &self,
        (a, b): Pair,
        (in_a, in_b): (&Selected, &Selected),
        matches: &[(KeypointIdx, KeypointIdx)],
        cameras: &BTreeMap<CameraId, Camera>,
    ) -> Option<TwoViewGeometry> {
        let mut rng = Rng::from_parts(&[self.context.seed, STREAM, u64::from(a.0), u64::from(b.0)]);
        let (camera_a, camera_b) = (&cameras[&in_a.camera], &cameras[&in_b.camera]);
        two_view::verify(&in_a.pixels, &in_b.pixels, matches, camera_a, camera_b, &self.options.two_view, &mut rng)
    }

    /// Verifies those pairs again, as calibrated, whose focal lengths were not trusted the first time, so that they have
    /// relative poses. A focal length that is still a guess is taken for the moment: poses from it are rough but can start a
    /// model, which then refines it.
    fn reverify(&self, result: &mut CoarseMatches) -> Result<(), PipelineError> {
        let camera_of = self.camera_of_image();
        let mut cameras = result.cameras.clone();
        for camera in cameras.values_mut() {
            camera.focal_source = camera.focal_source.max(FocalSource::Estimated);
        }
        let trusted = |id: &ImageId| {
            let camera = &camera_of[id];
            let before = &self.intake.cameras[camera];
            before.focal_source >= FocalSource::Exif && before == &result.cameras[camera]
        };
        let graph = &mut result.graph;
        let pending: Vec<Pair> = graph.pairs.keys().filter(|(a, b)| !(trusted(a) && trusted(b))).copied().collect();
        let again =
            |pair, images: (&Selected, &Selected)| self.verify(pair, images, &graph.pairs[&pair].inliers, &cameras);
        let verified = self.for_pairs(&pending, |_| Ok(None), again, |_, _| Ok(()))?;
        for (pair, geometry) in verified {
            let Some(mut geometry) = geometry else { continue };
            let before = graph.pairs.remove(&pair).map(|before| before.inliers).unwrap_or_default();
            // A wrong focal length (one of both was zoomed) costs matches that the uncalibrated geometry explains.
            if (geometry.inliers.len() as f64) < self.options.focals.min_calibrated_share * before.len() as f64 {
                geometry.inliers = before;
            }
            graph.pairs.insert(pair, geometry);
        }
        Ok(())
    }
}
