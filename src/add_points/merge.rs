//! Joining the tracks of all images with one another and with the model's points (paper, section 6.3).
//!
//! Every feature is triangulated once from each image it was matched in, so most points arrive several times and in pieces.
//! The pieces that share a sighting are one connected component (union-find in a fixed order; the paper's depth-first search
//! gives the same components). One wrong match can join two things in a component, so a component is not simply a point:
//! starting from the best supported position (first the model's own points, then the longest tracks), all sightings that
//! agree with it form a point, it is triangulated anew from all of them, and what is left over may form further points.
//! Where two keypoints of one image agree, the one with the smaller error is kept (the authors' code throws such a view
//! away, the print is silent).

use std::ops::Range;

use nalgebra::Vector3;
use rayon::prelude::*;

use super::components::Components;
use super::options::TriangulationOptions;
use super::stars::{Star, StarTracks};
use super::triangulate::{fixes_point, refit};
use super::views::{Sighting, ViewTable};
use super::{AddPointsError, Cancelled};
use crate::scene::{ImageId, Observation, Point3dId, Reconstruction};

/// What merging makes of a component: a new point, or a point of the model with a new position and track.
#[derive(Clone, Debug, PartialEq)]
pub struct TrackUpdate {
    /// The point of the model that is extended; none for a new point.
    pub extends: Option<Point3dId>,
    /// Points of the model that become one with it.
    pub absorbs: Vec<Point3dId>,
    /// The position.
    pub xyz: Vector3<f64>,
    /// All sightings, sorted, one an image.
    pub track: Vec<Observation>,
    /// A new point of two sightings whose match is not distinctive: no point unless a third image sees it.
    pub tentative: bool,
}

/// Merges tracks with one another and with the model's points. The order of the result is fixed.
///
/// # Errors
/// When cancelled; asked for every component.
pub fn merge_tracks(
    model: &Reconstruction,
    table: &ViewTable,
    stars: &StarTracks,
    options: &TriangulationOptions,
    cancelled: &Cancelled,
) -> Result<Vec<TrackUpdate>, AddPointsError> {
    let components = Components::new(model, table, stars);
    let resolve = |some: Range<usize>| {
        let mut updates = Vec::new();
        for component in some {
            if cancelled() {
                return Err(AddPointsError::Cancelled);
            }
            let (of_stars, points) = components.get(component);
            updates.extend(Resolver::new(model, table, (stars, of_stars), points, options).run());
        }
        Ok(updates)
    };
    let starts: Vec<usize> = (0..components.len()).step_by(COMPONENTS_AT_ONCE).collect();
    let runs = starts.into_par_iter().map(|start| start..components.len().min(start + COMPONENTS_AT_ONCE));
    let resolved: Vec<Vec<TrackUpdate>> = runs.map(resolve).collect::<Result<_, _>>()?;
    let mut updates = Vec::with_capacity(resolved.iter().map(Vec::len).sum());
    updates.extend(resolved.into_iter().flatten());
    Ok(updates)
}

/// Components a thread takes at a time.
const COMPONENTS_AT_ONCE: usize = 256;

/// A sighting of a component and who holds it.
#[derive(Clone, Copy, Debug)]
struct Claim {
    seen: Sighting,
    /// The model's point that sees it.
    owner: Option<Point3dId>,
    /// Whether it is part of a result already.
    taken: bool,
}

/// Splits one component into points.
struct Resolver<'a> {
    model: &'a Reconstruction,
    table: &'a ViewTable<'a>,
    options: &'a TriangulationOptions,
    /// The best supported first.
    stars: Vec<Star<'a>>,
    /// The longest track first.
    points: Vec<Point3dId>,
    /// All sightings, sorted.
    claims: Vec<Claim>,
}

impl<'a> Resolver<'a> {
    fn new(
        model: &'a Reconstruction,
        table: &'a ViewTable<'a>,
        (stars, of_component): (&'a StarTracks, &[u32]),
        points: &[Point3dId],
        options: &'a TriangulationOptions,
    ) -> Self {
        let mut stars: Vec<Star<'_>> = of_component.iter().map(|&at| stars.get(at as usize)).collect();
        let mut seen: Vec<Sighting> = stars.iter().flat_map(|star| star.sightings.iter().copied()).collect();
        stars.sort_by(|a, b| {
            let by_length = b.sightings.len().cmp(&a.sightings.len());
            by_length
                .then(b.distinctive.cmp(&a.distinctive))
                .then(a.mean_relative_error_sq.total_cmp(&b.mean_relative_error_sq))
        });
        let mut points = points.to_vec();
        points.sort_by_key(|&id| (std::cmp::Reverse(track_of(model, id).len()), id));
        seen.extend(points.iter().flat_map(|&id| track_of(model, id)).map(|observation| table.sighting(observation)));
        seen.sort_unstable();
        seen.dedup();
        let owner = |seen: &Sighting| table.image(seen.rank).points()[seen.keypoint.index()];
        let claims = seen.into_iter().map(|seen| Claim { seen, owner: owner(&seen), taken: false }).collect();
        Self { model, table, options, stars, points, claims }
    }

    fn run(mut self) -> Vec<TrackUpdate> {
        let mut updates = Vec::new();
        for at in 0..self.points.len() {
            updates.extend(self.extend_point(self.points[at]));
        }
        let mut tentative = Vec::new();
        for at in 0..self.stars.len() {
            match self.find_point(self.stars[at]) {
                Some(update) if update.tentative => tentative.push(update),
                found => updates.extend(found.map(|update| self.settle(update))),
            }
        }
        // What nothing else confirms may have the sightings that are left.
        for update in tentative {
            if !update.track.iter().any(|seen| self.is_taken(self.table.sighting(seen))) {
                updates.push(self.settle(update));
            }
        }
        updates
    }

    /// Gives a point of the model the free sightings that agree with it, and the other points that do so as a whole.
    fn extend_point(&mut self, id: Point3dId) -> Option<TrackUpdate> {
        let point = self.model.point(id)?;
        let own: Vec<Sighting> = point.track.iter().map(|observation| self.table.sighting(observation)).collect();
        if own.iter().any(|&seen| self.is_taken(seen)) {
            return None;
        }
        let mut owners = vec![id];
        let mut images: Vec<u32> = own.iter().map(|seen| seen.rank).collect();
        for &other in &self.points {
            let track = track_of(self.model, other).iter().map(|observation| self.table.sighting(observation));
            let apart = |seen: &Observation| owners.iter().any(|&owner| self.model.apart_from_track(seen.image, owner));
            let joins = other != id
                && !track_of(self.model, other).iter().any(apart)
                && track.clone().all(|seen| {
                    !images.contains(&seen.rank)
                        && !self.is_taken(seen)
                        && self.table.relative_error_sq(seen, &point.xyz) <= 1.0
                });
            if joins {
                owners.push(other);
                images.extend(track.map(|seen| seen.rank));
            }
        }
        let grant = |xyz: &Vector3<f64>| {
            self.best_per_image(xyz, Some(id), |claim| claim.owner.is_none_or(|owner| owners.contains(&owner)))
        };
        let granted = refit(self.table, point.xyz, grant);
        let kept = |track: &[Sighting]| own.iter().filter(|seen| track.binary_search(seen).is_ok()).count();
        // An old point must not be turned into another one: two of its own sightings, at least, stay.
        let (xyz, track) = granted.filter(|(_, track)| kept(track) >= 2)?;
        owners.remove(0);
        if track == own {
            self.take(&own);
            return None;
        }
        self.take(&track);
        let absorbed_whole = |other: &Point3dId| {
            track_of(self.model, *other).iter().any(|seen| track.binary_search(&self.table.sighting(seen)).is_ok())
        };
        let absorbs: Vec<Point3dId> = owners.into_iter().filter(absorbed_whole).collect();
        Some(self.update(Some(id), absorbs, xyz, &track))
    }

    /// The point of the free sightings that agree with a track's position.
    fn find_point(&self, star: Star<'_>) -> Option<TrackUpdate> {
        let free = |seen: &&Sighting| self.claim(**seen).is_some_and(|claim| !claim.taken && claim.owner.is_none());
        if star.sightings.iter().filter(free).count() < 2 {
            return None;
        }
        let grant = |xyz: &Vector3<f64>| self.best_per_image(xyz, None, |claim| claim.owner.is_none());
        let (xyz, track) = refit(self.table, star.xyz, grant)?;
        let tentative = track.len() == 2 && !star.distinctive;
        fixes_point(self.table, &xyz, &track, self.options)
            .then(|| TrackUpdate { tentative, ..self.update(None, Vec::new(), xyz, &track) })
    }

    /// Takes the sightings of a new point.
    fn settle(&mut self, update: TrackUpdate) -> TrackUpdate {
        let sightings: Vec<Sighting> = update.track.iter().map(|seen| self.table.sighting(seen)).collect();
        self.take(&sightings);
        update
    }

    /// The free sightings that agree with a position, of each image the one with the smallest error, sorted. Where images are
    /// apart, those of `point` stay, then those with the smaller error.
    fn best_per_image(
        &self,
        xyz: &Vector3<f64>,
        point: Option<Point3dId>,
        allowed: impl Fn(&Claim) -> bool,
    ) -> Vec<Sighting> {
        let mut best: Vec<(Sighting, f64)> = Vec::new();
        for claim in self.claims.iter().filter(|claim| !claim.taken && allowed(claim)) {
            let error = self.table.relative_error_sq(claim.seen, xyz);
            if error.is_nan() || error > 1.0 {
                continue;
            }
            match best.last_mut() {
                Some(last) if last.0.rank == claim.seen.rank => {
                    if error < last.1 {
                        *last = (claim.seen, error);
                    }
                }
                _ => best.push((claim.seen, error)),
            }
        }
        if !self.model.apart.is_empty() {
            best = self.of_one_place(best, point);
        }
        best.into_iter().map(|(seen, _)| seen).collect()
    }

    /// What stays of sightings with their errors when no two may be of images apart.
    fn of_one_place(&self, mut sightings: Vec<(Sighting, f64)>, point: Option<Point3dId>) -> Vec<(Sighting, f64)> {
        let foreign = |seen: Sighting| point.is_none() || self.claim(seen).is_none_or(|claim| claim.owner != point);
        sightings.sort_by(|a, b| foreign(a.0).cmp(&foreign(b.0)).then(a.1.total_cmp(&b.1)).then(a.0.cmp(&b.0)));
        let mut images: Vec<ImageId> = Vec::new();
        sightings.retain(|&(seen, _)| {
            let image = self.table.observation(seen).image;
            let stays = !self.model.apart.from_any(image, images.iter().copied());
            if stays {
                images.push(image);
            }
            stays
        });
        sightings.sort_by_key(|&(seen, _)| seen);
        sightings
    }

    fn update(
        &self,
        extends: Option<Point3dId>,
        absorbs: Vec<Point3dId>,
        xyz: Vector3<f64>,
        track: &[Sighting],
    ) -> TrackUpdate {
        let track = track.iter().map(|&seen| self.table.observation(seen)).collect();
        TrackUpdate { extends, absorbs, xyz, track, tentative: false }
    }

    fn claim(&self, seen: Sighting) -> Option<&Claim> {
        self.claims.binary_search_by_key(&seen, |claim| claim.seen).ok().map(|at| &self.claims[at])
    }

    fn is_taken(&self, seen: Sighting) -> bool {
        self.claim(seen).is_some_and(|claim| claim.taken)
    }

    fn take(&mut self, track: &[Sighting]) {
        for &seen in track {
            if let Ok(at) = self.claims.binary_search_by_key(&seen, |claim| claim.seen) {
                self.claims[at].taken = true;
            }
        }
    }
}

fn track_of(model: &Reconstruction, id: Point3dId) -> &[Observation] {
    model.point(id).map_or(&[], |point| &point.track)
}

/// What applying updates changed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MergeCounts {
    /// New points.
    pub created: usize,
    /// Points of the model with a changed track.
    pub extended: usize,
    /// Points of the model that became part of others.
    pub absorbed: usize,
}

/// Brings the updates into the model, in their order. New points are black until somebody colours them.
pub fn apply_updates(model: &mut Reconstruction, updates: Vec<TrackUpdate>) -> MergeCounts {
    let mut counts = MergeCounts::default();
    for update in updates {
        let Some(id) = update.extends else {
            model.add_point(update.xyz, update.track, [0; 3]);
            counts.created += 1;
            continue;
        };
        for &absorbed in &update.absorbs {
            model.remove_point(absorbed);
            counts.absorbed += 1;
        }
        let old: Vec<Observation> = track_of(model, id).to_vec();
        // Two of the old sightings stay (the merge sees to that), so the point outlives the removals.
        for &seen in old.iter().filter(|seen| update.track.binary_search(seen).is_err()) {
            model.remove_observation(id, seen);
        }
        for &seen in update.track.iter().filter(|seen| old.binary_search(seen).is_err()) {
            model.add_observation(id, seen);
        }
        model.set_xyz(id, update.xyz);
        counts.extended += 1;
    }
    counts
}
