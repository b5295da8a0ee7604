//! The stage `coarse_match`: the selected features of pairs of photographs, matched and verified by units of pairs.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::atomic::{AtomicU64, Ordering};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::features::{ImageFeatures, StoredFeatures};
use super::intake::{Intake, Photograph};
use super::options::CoarseOptions;
use super::runner::{Counts, StageProgress, counts};
use super::units::Units;
use super::{Context, PipelineError, focals};
use crate::add_cameras::MatchCounts;
use crate::camera::{Camera, FocalSource, Pixel};
use crate::coarse::MatchGraph;
use crate::coarse::hybrid_match::{CoarseDescriptors, match_hybrid};
use crate::coarse::pair_selection::{GeoPosition, PairingImage, select_pairs};
use crate::coarse::rotation_cycles;
use crate::coarse::selection::SelectionOptions;
use crate::matching::cells::Codebook;
use crate::matching::standing;
use crate::matching::two_view::{self, TwoViewGeometry};
use crate::math::Rng;
use crate::scene::{CameraId, Descriptor, Features, ImageId, KeypointIdx};

/// The result of `coarse_match`.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct CoarseMatches {
    /// Verified pairs.
    pub(super) graph: MatchGraph,
    /// Matches of every pair.
    pub(super) match_counts: MatchCounts,
    /// Intrinsics as far as the pairs tell them.
    pub(super) cameras: BTreeMap<CameraId, Camera>,
    /// Images that stand before a background of their own: some matches stand still in the frame while others have a geometry.
    pub(super) before_background: BTreeSet<ImageId>,
    /// What the report should say.
    pub(super) notes: Vec<String>,
}

/// Tells the random streams of verification from others.
const STREAM: u64 = 0x7477_6f5f_7669_6577;
/// Images a side of a tile of pairs: with the default selection of 16K features, 64 images are 60 MB. Sets up to this size are
/// one tile.
const TILE_IMAGES: u32 = 64;

/// Images that the codebook is found from at most, evenly spaced among all: enough to know the kinds of things the set shows.
const CODEBOOK_IMAGES: usize = 64;

/// Pairs of a unit of work: what a run that is stopped may have to do again, a few CPU seconds.
const UNIT_PAIRS: usize = 256;

/// Two photographs, the lower id first.
type Pair = (ImageId, ImageId);

/// One run of `coarse_match`.
pub(super) struct Matcher<'a> {
    pub(super) units: Units<'a>,
    pub(super) intake: &'a Intake,
    pub(super) found: &'a BTreeMap<ImageId, ImageFeatures>,
    pub(super) options: &'a CoarseOptions,
    pub(super) selection: &'a SelectionOptions,
    pub(super) features: &'a StoredFeatures<'a>,
    pub(super) context: &'a Context,
}

/// What matching and verification of a pair found.
#[derive(Clone, Debug, Serialize, Deserialize)]
struct Found {
    /// Number of matches.
    num_matches: u32,
    /// What its verification found.
    geometry: Option<TwoViewGeometry>,
    /// What stands still in the frame.
    standing: Standing,
}

/// Which of a pair's matches stand still in the frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
enum Standing {
    /// None to speak of.
    None,
    /// Some, which were left out: the others have a geometry of their own.
    LeftOut,
    /// All that agree with each other.
    All,
}

/// At most so many of the items, evenly spaced.
fn evenly<T>(items: &[T], count: usize) -> Vec<&T> {
    let count = count.min(items.len());
    (0..count).map(|at| &items[at * items.len() / count]).collect()
}

/// A pair and what was found.
type Matched = (Pair, Found);

/// Where the selected features of an image lie.
struct Positions {
    pixels: Vec<Pixel>,
    camera: CameraId,
}

/// The selected features of an image. Only those of a tile of pairs are in memory at a time.
struct Selected {
    descriptors: CoarseDescriptors,
    positions: Positions,
}

impl Positions {
    fn new(features: &Features, camera: CameraId) -> Self {
        let pixels = features.keypoints.iter().map(|at| Pixel::new(f64::from(at.x), f64::from(at.y))).collect();
        Self { pixels, camera }
    }
}

impl Matcher<'_> {
    /// Matches and verifies the selected pairs. Pairs between `settled` images, which one model already holds, keep what an
    /// earlier, narrower round found.
    pub(super) fn run(
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
            let found = self.verify_moved((a, b), (&in_a.positions, &in_b.positions), &matches);
            more(1);
            found
        };
        let codebook = self.codebook();
        let select = |id, camera| {
            let features = self.selected(id);
            let descriptors = CoarseDescriptors::new(&features.descriptors, codebook.as_ref());
            Selected { descriptors, positions: Positions::new(&features, camera) }
        };
        let matched = self.for_pairs(&pairs, select, known, work, |unit, results| self.units.keep(&unit, results))?;
        self.context.check_cancelled()?;

        let mut result = CoarseMatches {
            graph: before.graph.clone(),
            match_counts: before.match_counts.clone(),
            before_background: before.before_background.clone(),
            ..Default::default()
        };
        let left_out = matched.iter().filter(|(_, found)| found.standing == Standing::LeftOut);
        result.before_background.extend(left_out.flat_map(|&((a, b), _)| [a, b]));
        let (mut tentative, mut verified) = (0, 0);
        for (pair, found) in matched {
            tentative += usize::from(found.num_matches > 0);
            result.match_counts.insert(pair, found.num_matches);
            let Some(geometry) = found.geometry else { continue };
            // Of pictures of one spot all matches stand still, too; but none of theirs with others.
            let by_background = [pair.0, pair.1].iter().any(|id| result.before_background.contains(id));
            if !(found.standing == Standing::All && by_background) {
                verified += 1;
                result.graph.pairs.insert(pair, geometry);
            }
        }
        result.cameras = if before.cameras.is_empty() {
            let mut cameras = self.intake.cameras.clone();
            result.notes =
                focals::settle(&result.graph, &mut cameras, &self.intake.camera_of_image(), &self.options.focals);
            cameras
        } else {
            before.cameras.clone()
        };
        self.reverify(&mut result)?;
        self.context.check_cancelled()?;
        let contradicted = {
            let camera_of = self.intake.camera_of_image();
            let camera = |id: ImageId| &result.cameras[&camera_of[&id]];
            rotation_cycles::contradicted(&result.graph, camera, &self.options.mapper.rotation_cycles)
        };
        result.graph.pairs.retain(|pair, _| !contradicted.contains(pair));
        let inliers = result.graph.pairs.values().map(|geometry| geometry.inliers.len()).sum();
        let selected = self.usable().map(|(_, _, count)| self.selection.num_selected(count)).sum();
        let totals = counts([
            ("pairs_tried", pairs.len()),
            ("pairs_reused", reused),
            ("pairs_matched", tentative),
            ("pairs_verified", verified),
            ("pairs_contradicted", contradicted.len()),
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

    /// The pairs to match, by the few features of largest scale that pair selection looks at.
    fn pairs(&self) -> Vec<Pair> {
        let options = &self.options.pairs;
        let usable: Vec<_> = self.usable().collect();
        let all_pairs = usable.len() <= options.exhaustive_up_to;
        let tops: Vec<Features> = usable
            .par_iter()
            .map(|&(id, _, count)| {
                let wanted = if all_pairs { 0 } else { options.preemptive_features };
                self.features.read(id, Some(wanted.min(self.selection.num_selected(count))))
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

    /// The codebook of the selected features; none where they are few, which are compared with all.
    fn codebook(&self) -> Option<Codebook> {
        let options = &self.options.matching;
        let cells = options.cells.as_ref()?;
        let selected: Vec<_> = self.usable().map(|(id, _, count)| (id, self.selection.num_selected(count))).collect();
        let most = selected.iter().map(|&(_, count)| count).max().filter(|&most| most >= options.cells_from)?;
        let num_cells = cells.num_cells(most);
        let of_some = evenly(&selected, CODEBOOK_IMAGES);
        let per_image = (cells.sample_per_cell * num_cells).div_ceil(of_some.len());
        let sample: Vec<Vec<Descriptor>> = of_some
            .par_iter()
            .map(|&&(id, count)| {
                let features = self.features.read(id, Some(count));
                evenly(&features.descriptors, per_image).into_iter().copied().collect()
            })
            .collect();
        Codebook::train(&sample.concat(), num_cells, cells)
    }

    /// Reads the features of largest scale of an image.
    fn selected(&self, id: ImageId) -> Features {
        let count = self.found.get(&id).and_then(|image| image.count.as_ref().ok()).copied().unwrap_or(0);
        self.features.read(id, Some(self.selection.num_selected(count)))
    }

    /// Does `work` for every pair, in parallel, with what is `read` of both images, unless the unit of work that the pair
    /// belongs to is `known`; a unit that is done is `kept`. Pairs are done in tiles of images that share what
    /// was read, so that memory does not grow with the number of images. Once cancelled, what is left is left out.
    fn for_pairs<I: Send + Sync, T: Send>(
        &self,
        pairs: &[Pair],
        read: impl Fn(ImageId, CameraId) -> I + Sync,
        mut known: impl FnMut(&[Pair]) -> Result<Option<Vec<(Pair, T)>>, PipelineError>,
        work: impl Fn(Pair, (&I, &I)) -> T + Sync,
        keep: impl Fn(&[Pair], &[(Pair, T)]) -> Result<(), PipelineError>,
    ) -> Result<Vec<(Pair, T)>, PipelineError> {
        let cameras = self.intake.camera_of_image();
        let mut tiles: BTreeMap<(u32, u32), Vec<Pair>> = BTreeMap::new();
        for &(a, b) in pairs {
            tiles.entry((a.0 / TILE_IMAGES, b.0 / TILE_IMAGES)).or_default().push((a, b));
        }
        let mut images: BTreeMap<ImageId, I> = BTreeMap::new();
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
            let found = missing.into_par_iter().map(|id| (id, read(id, cameras[&id])));
            images.extend(found.collect::<Vec<_>>());
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

    /// Verifies a pair by the matches that moved, if others stand still and these have a geometry of their own; else by all.
    fn verify_moved(
        &self,
        pair: Pair,
        images: (&Positions, &Positions),
        matches: &[(KeypointIdx, KeypointIdx)],
    ) -> Found {
        let num_matches = matches.len() as u32;
        let verify = |matches: &[_]| self.verify(pair, images, matches, &self.intake.cameras);
        let Some(moved) = self.moved(images, matches) else {
            return Found { num_matches, geometry: verify(matches), standing: Standing::None };
        };
        match verify(&moved) {
            Some(geometry) => Found { num_matches, geometry: Some(geometry), standing: Standing::LeftOut },
            None => Found { num_matches, geometry: verify(matches), standing: Standing::All },
        }
    }

    /// The matches that moved; none where none to speak of stand still, or where the pictures differ in size.
    fn moved(
        &self,
        (in_a, in_b): (&Positions, &Positions),
        matches: &[(KeypointIdx, KeypointIdx)],
    ) -> Option<Vec<(KeypointIdx, KeypointIdx)>> {
        let camera = |image: &Positions| &self.intake.cameras[&image.camera];
        if !camera(in_a).has_size_of(camera(in_b)) {
            return None;
        }
        let shift_px =
            |&(a, b): &(KeypointIdx, KeypointIdx)| (in_b.pixels[b.index()].0 - in_a.pixels[a.index()].0).norm();
        standing::moved(matches, shift_px, &self.options.standing)
    }

    fn verify(
        &self,
        (a, b): Pair,
        (in_a, in_b): (&Positions, &Positions),
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
        let camera_of = self.intake.camera_of_image();
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
            |pair, images: (&Positions, &Positions)| self.verify(pair, images, &graph.pairs[&pair].inliers, &cameras);
        let positions = |id, camera| Positions::new(&self.selected(id), camera);
        let verified = self.for_pairs(&pending, positions, |_| Ok(None), again, |_, _| Ok(()))?;
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
