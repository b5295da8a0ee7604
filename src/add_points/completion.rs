//! A third sighting for points of two.
//!
//! Guided matching looks along a line, and where a fine pattern repeats along it the ratio test rejects right matches with the
//! wrong ones. Of a point made from two images a third one shows a *place*, a few pixels wide, where most often there is one
//! keypoint or none, and what it must look like is known. So points of two sightings are looked for in the images that are
//! most covisible with theirs, as it is done in tracking (Klein and Murray, "Parallel tracking and mapping for small AR workspaces",
//! ISMAR 2007, section 5), with an absolute limit on the descriptor's distance in place of the ratio test. What is found makes
//! more points that three images see; and matches that are not distinctive, which on their own mean nothing, become points
//! where a third image sees them.
//!
//! This is done when poses are final. Sightings that are looked for where the poses put them agree with these poses, right or
//! wrong: adjusted with the others, they cost the poses of ten photographs from the web 0.7 of AUC@3 (mean of eight seeds).
//!
//! The keypoints asked are those that see no point yet. Points are taken in blocks, as the descriptors that are compared are held
//! for all of a block; images are independent of one another, and what they found is put together in id order.

use std::collections::BTreeMap;

use nalgebra::{Vector2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::merge::{TrackUpdate, apply_updates};
use super::options::{AddPointsOptions, CandidatePairOptions};
use super::pair_matcher::image_of_features;
use super::triangulate::{crossing, fixes_point, refit};
use super::views::{Sighting, ViewTable};
use super::{AddPointsError, Cancelled, LoadFeatures, PairOfSightings, candidate_pairs};
use crate::camera::{Camera, Pixel};
use crate::matching::descriptor::distance_sq;
use crate::math::Grouped;
use crate::scene::{Descriptor, ImageId, KeypointIdx, Observation, Point3d, Point3dId, Reconstruction};

/// Points of a block: the descriptors of a tenth to a half of them are compared, half a kilobyte each.
const POINTS_PER_BLOCK: usize = 1 << 17;

/// The images that an image is most covisible with.
type Partners = BTreeMap<ImageId, Vec<ImageId>>;

/// How points of two sightings are looked for in further images.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CompletionOptions {
    /// Points of an image are looked for in this many others, the most covisible ones, or in those it is matched with if
    /// these are more. Raising it finds more for more time.
    pub images_at_least: usize,
    /// How far a keypoint may be from where the point projects to: scaled pixels (`add_points.pixel_scaling`). Origin:
    /// measured; 3 finds half as many more, of which every fifth is there by chance.
    pub radius_px: f64,
    /// Largest distance of a keypoint's descriptor from one of those that see the point (descriptors are 512 long). Origin:
    /// measured, as the radius is, by searching beside the projections; at 300 chance finds twice as large a share.
    pub max_descriptor_distance: f64,
    /// Largest factor between the sizes that their scales and depths give the two features in the scene.
    pub max_scale_discrepancy: f64,
}

impl Default for CompletionOptions {
    fn default() -> Self {
        Self { images_at_least: 20, radius_px: 2.0, max_descriptor_distance: 260.0, max_scale_discrepancy: 1.3 }
    }
}

impl CompletionOptions {
    /// Adds a sentence for every value that can't work.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(format!("refine.completion.{message}"));
            }
        };
        check(self.radius_px > 0.0, "radius_px must be positive");
        check(self.max_descriptor_distance > 0.0, "max_descriptor_distance must be positive");
        check(self.max_scale_discrepancy >= 1.0, "max_scale_discrepancy must be at least 1");
    }
}

/// Completes tracks of two sightings.
#[derive(Clone, Copy)]
pub struct Completer<'a> {
    /// The features of every registered image.
    pub features: &'a LoadFeatures<'a>,
    /// How further sightings are looked for.
    pub completion: &'a CompletionOptions,
    /// What makes a point.
    pub options: &'a AddPointsOptions,
    /// Whether somebody asked to stop.
    pub cancelled: &'a Cancelled<'a>,
}

impl Completer<'_> {
    /// Gives points of two sightings those that further images have of them, makes points of unconfirmed matches that further
    /// images see, and returns the ids of all these.
    ///
    /// # Errors
    /// When cancelled, or when features are not those of the model's keypoints; the model is then of no use.
    pub fn run(
        &self,
        model: &mut Reconstruction,
        unconfirmed: &[PairOfSightings],
    ) -> Result<Vec<Point3dId>, AddPointsError> {
        let mut partners = Partners::new();
        let pairs = &self.options.candidate_pairs;
        let top_at_least = pairs.top_at_least.max(self.completion.images_at_least);
        for pair in candidate_pairs(model, None, &CandidatePairOptions { top_at_least, ..pairs.clone() }) {
            partners.entry(pair.first).or_default().push(pair.second);
            partners.entry(pair.second).or_default().push(pair.first);
        }
        let tentative = self.add_unconfirmed(model, unconfirmed);
        let of_two = model.points().filter(|(_, point)| point.track.len() == 2);
        let points: Vec<Point3dId> = of_two.map(|(id, _)| id).collect();
        let mut completed = Vec::new();
        for points in points.chunks(POINTS_PER_BLOCK) {
            let updates = Block::new(*self, model, &partners, points).run()?;
            completed.extend(updates.iter().filter_map(|update| update.extends));
            apply_updates(model, updates);
        }
        for id in tentative {
            if completed.binary_search(&id).is_err() {
                model.remove_point(id);
            }
        }
        Ok(completed)
    }

    /// Makes points of the matches whose keypoints are still free, as far as the poses allow, and returns their ids.
    fn add_unconfirmed(&self, model: &mut Reconstruction, unconfirmed: &[PairOfSightings]) -> Vec<Point3dId> {
        let triangulation = &self.options.triangulation;
        let table = ViewTable::new(model, triangulation, &self.options.pixel_scaling);
        let position = |pair: &PairOfSightings| {
            if pair.iter().any(|seen| model.image(seen.image).is_none()) {
                return None;
            }
            let track = [table.sighting(&pair[0]), table.sighting(&pair[1])];
            let (xyz, _) = refit(&table, crossing(&table, track)?, |xyz| table.agreeing(&track, xyz))?;
            fixes_point(&table, &xyz, &track, triangulation).then_some(xyz)
        };
        let positions: Vec<Option<Vector3<f64>>> = unconfirmed.par_iter().map(position).collect();
        let mut added = Vec::new();
        for (pair, xyz) in unconfirmed.iter().zip(positions) {
            let Some(xyz) = xyz else { continue };
            let is_free = |seen: &Observation| model.images()[&seen.image].points()[seen.keypoint.index()].is_none();
            if pair.iter().all(is_free) && !model.apart.are_apart(pair[0].image, pair[1].image) {
                added.push(model.add_point(xyz, pair.to_vec(), [0; 3]));
            }
        }
        added
    }
}

/// A keypoint where a point projects to.
#[derive(Clone, Copy)]
struct Candidate {
    /// The point's number in the block.
    slot: u32,
    seen: Observation,
}

/// A candidate that looks like the point.
struct Likeness {
    candidate: Candidate,
    /// Of the descriptors.
    distance_sq: u32,
}

/// What a keypoint looks like.
struct Look {
    keypoint: KeypointIdx,
    descriptor: Descriptor,
    /// In pixels.
    scale: f32,
}

/// Some points of two sightings, looked for in all images at once.
struct Block<'a> {
    by: Completer<'a>,
    model: &'a Reconstruction,
    partners: &'a Partners,
    points: &'a [Point3dId],
    /// The place among the points, by id.
    slot_of: Vec<Option<u32>>,
}

impl<'a> Block<'a> {
    fn new(by: Completer<'a>, model: &'a Reconstruction, partners: &'a Partners, points: &'a [Point3dId]) -> Self {
        let mut slot_of = vec![None; model.point_id_bound()];
        for (slot, point) in (0u32..).zip(points) {
            slot_of[point.index()] = Some(slot);
        }
        Self { by, model, partners, points, slot_of }
    }

    /// Where, then what: features are read once, and only the descriptors that are compared are held.
    fn run(&self) -> Result<Vec<TrackUpdate>, AddPointsError> {
        let images: Vec<ImageId> = self.partners.keys().copied().collect();
        let candidates: Vec<Vec<Candidate>> = images.par_iter().map(|&id| self.candidates_in(id)).collect();
        let looks = self.looks(&candidates)?;
        let mut alike: Vec<Likeness> =
            candidates.par_iter().flat_map_iter(|of_image| self.likenesses(of_image, &looks)).collect();
        alike.sort_unstable_by_key(|found| (found.candidate.slot, found.distance_sq, found.candidate.seen));
        let table = ViewTable::new(self.model, &self.by.options.triangulation, &self.by.options.pixel_scaling);
        let of_points: Vec<&[Likeness]> = alike.chunk_by(|a, b| a.candidate.slot == b.candidate.slot).collect();
        Ok(of_points.into_par_iter().filter_map(|alike| self.complete(&table, alike)).collect())
    }

    /// The keypoints of an image where points of its partners project to.
    fn candidates_in(&self, id: ImageId) -> Vec<Candidate> {
        let (image, camera) = (&self.model.images()[&id], self.model.camera_of(id));
        let radius_px = self.by.completion.radius_px * self.by.options.pixel_scaling.factor(camera);
        let free = FreeKeypoints::new(self.model, id, radius_px);
        let mut candidates = Vec::new();
        for slot in self.points_seen_near(id) {
            let x_in_cam = image.cam_from_world.apply(&self.point(slot).xyz);
            let Some(pixel) = camera.project(&x_in_cam) else { continue };
            let seen = |keypoint| Observation { image: id, keypoint: KeypointIdx(keypoint) };
            candidates.extend(free.within(&pixel.0).map(|keypoint| Candidate { slot, seen: seen(keypoint) }));
        }
        candidates
    }

    /// The block's points that partners of an image see, without those that it sees itself or is apart from.
    fn points_seen_near(&self, id: ImageId) -> Vec<u32> {
        let near = self.partners[&id].iter().flat_map(|partner| self.model.images()[partner].points().iter().flatten());
        let mut slots: Vec<u32> = near.filter_map(|point| self.slot_of[point.index()]).collect();
        slots.sort_unstable();
        slots.dedup();
        slots.retain(|&slot| {
            let seen_by = self.point(slot).track.iter().map(|seen| seen.image);
            seen_by.clone().all(|image| image != id) && !self.model.apart.from_any(id, seen_by)
        });
        slots
    }

    /// A point of the block.
    fn point(&self, slot: u32) -> &'a Point3d {
        self.model.point(self.points[slot as usize]).expect("a point of the block exists")
    }

    /// The looks of the candidates and of the sightings they are compared with, by keypoint.
    fn looks(&self, candidates: &[Vec<Candidate>]) -> Result<BTreeMap<ImageId, Vec<Look>>, AddPointsError> {
        let mut wanted: BTreeMap<ImageId, Vec<KeypointIdx>> = BTreeMap::new();
        for candidate in candidates.iter().flatten() {
            for seen in self.point(candidate.slot).track.iter().chain([&candidate.seen]) {
                wanted.entry(seen.image).or_default().push(seen.keypoint);
            }
        }
        let looks_in = |(id, mut keypoints): (ImageId, Vec<KeypointIdx>)| {
            if (self.by.cancelled)() {
                return Err(AddPointsError::Cancelled);
            }
            let features = (self.by.features)(id);
            image_of_features(self.model, id, &features)?;
            keypoints.sort_unstable();
            keypoints.dedup();
            let look = |keypoint: KeypointIdx| {
                let at = keypoint.index();
                Look { keypoint, descriptor: features.descriptors[at], scale: features.keypoints[at].scale }
            };
            Ok((id, keypoints.into_iter().map(look).collect()))
        };
        wanted.into_par_iter().map(looks_in).collect()
    }

    /// Which candidates of an image look like their points; of several for one keypoint the one that does most.
    fn likenesses(&self, candidates: &[Candidate], looks: &BTreeMap<ImageId, Vec<Look>>) -> Vec<Likeness> {
        let options = self.by.completion;
        let max_distance_sq = options.max_descriptor_distance.powi(2);
        let look = |seen: &Observation| {
            let looks = &looks[&seen.image];
            let at = looks.binary_search_by_key(&seen.keypoint, |look| look.keypoint);
            &looks[at.expect("the looks of all candidates and their points were read")]
        };
        let size = |seen: &Observation, xyz: &Vector3<f64>| {
            let depth = self.model.images()[&seen.image].cam_from_world.apply(xyz).z;
            f64::from(look(seen).scale) * depth / self.model.camera_of(seen.image).mean_focal_px()
        };
        let likeness = |&candidate: &Candidate| {
            let point = self.point(candidate.slot);
            let (own, own_size) = (look(&candidate.seen), size(&candidate.seen, &point.xyz));
            let alike = point.track.iter().filter(|seen| {
                let ratio = own_size / size(seen, &point.xyz);
                ratio.max(1.0 / ratio) <= options.max_scale_discrepancy
            });
            let distance_sq = alike.map(|seen| distance_sq(&look(seen).descriptor, &own.descriptor)).min()?;
            (f64::from(distance_sq) <= max_distance_sq).then_some(Likeness { candidate, distance_sq })
        };
        let mut alike: Vec<Likeness> = candidates.iter().filter_map(likeness).collect();
        alike.sort_unstable_by_key(|found| (found.candidate.seen, found.distance_sq, found.candidate.slot));
        alike.dedup_by_key(|found| found.candidate.seen);
        alike
    }

    /// A point with the keypoints that look like it, the likest of each image first, as far as they agree with its own two
    /// sightings.
    fn complete(&self, table: &ViewTable, alike: &[Likeness]) -> Option<TrackUpdate> {
        let slot = alike[0].candidate.slot;
        let (id, point) = (self.points[slot as usize], self.point(slot));
        let mut track = point.track.clone();
        for Likeness { candidate: Candidate { seen, .. }, .. } in alike {
            let images = track.iter().map(|other| other.image);
            if images.clone().all(|image| image != seen.image) && !self.model.apart.from_any(seen.image, images) {
                track.push(*seen);
            }
        }
        track.sort_unstable();
        let sightings: Vec<Sighting> = track.iter().map(|seen| table.sighting(seen)).collect();
        let (xyz, seen) = refit(table, point.xyz, |xyz| table.agreeing(&sightings, xyz))?;
        let track: Vec<Observation> = seen.into_iter().map(|seen| table.observation(seen)).collect();
        let keeps_its_own = point.track.iter().all(|own| track.binary_search(own).is_ok());
        (keeps_its_own && track.len() > 2).then_some(TrackUpdate {
            extends: Some(id),
            absorbs: Vec::new(),
            xyz,
            track,
            tentative: false,
        })
    }
}

/// The keypoints of an image that see no point, by the cells of a grid.
struct FreeKeypoints<'a> {
    keypoints: &'a [Pixel],
    radius_px: f64,
    cell_px: f64,
    columns: usize,
    rows: usize,
    cells: Grouped<u32>,
}

/// Side of a cell in radii: a disc touches one to four cells.
const CELL_RADII: f64 = 4.0;

impl<'a> FreeKeypoints<'a> {
    fn new(model: &'a Reconstruction, id: ImageId, radius_px: f64) -> Self {
        let (image, camera): (_, &Camera) = (&model.images()[&id], model.camera_of(id));
        let cell_px = CELL_RADII * radius_px;
        let cells_along = |size: u32| (f64::from(size) / cell_px) as usize + 1;
        let (columns, rows) = (cells_along(camera.width), cells_along(camera.height));
        let cell_of = |at: &Vector2<f64>| {
            let (column, row) = ((at.x / cell_px) as usize, (at.y / cell_px) as usize);
            (row.min(rows - 1) * columns + column.min(columns - 1)) as u32
        };
        let free = (0u32..).zip(image.points()).filter(|(_, point)| point.is_none()).map(|(keypoint, _)| keypoint);
        let free: Vec<(u32, u32)> =
            free.map(|keypoint| (cell_of(&image.keypoints[keypoint as usize].0), keypoint)).collect();
        let cells = Grouped::new(columns * rows, free.into_iter());
        Self { keypoints: &image.keypoints, radius_px, cell_px, columns, rows, cells }
    }

    /// Those within the radius of a place.
    fn within(&self, at: &Vector2<f64>) -> impl Iterator<Item = u32> {
        let cells_of = |at: f64, count: usize| {
            let first = ((at - self.radius_px) / self.cell_px).max(0.0) as usize;
            let end = ((at + self.radius_px) / self.cell_px + 1.0).max(0.0) as usize;
            first..end.min(count)
        };
        let (columns, at) = (cells_of(at.x, self.columns), *at);
        let cells = cells_of(at.y, self.rows).flat_map(move |row| columns.clone().map(move |column| (row, column)));
        let near = cells.flat_map(|(row, column)| self.cells.group(row * self.columns + column));
        near.copied().filter(move |&keypoint| (self.keypoints[keypoint as usize].0 - at).norm() <= self.radius_px)
    }
}
