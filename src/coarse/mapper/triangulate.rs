//! Triangulation of tracks in a growing model, tolerant of wrong sightings.

use nalgebra::Vector3;
use rayon::prelude::*;

use super::Mapper;
use crate::camera::Normalized;
use crate::geometry::Rigid3;
use crate::geometry::triangulation::{refine_point, triangulate_dlt, triangulation_angle_rad};
use crate::scene::{Observation, Point3dId};

/// Pairs of sightings tried as the seed of a point: the widest few suffice, since a track's wrong sightings are few.
const MAX_SEED_PAIRS: usize = 12;

/// A sighting of a registered image, ready for triangulation.
struct View {
    seen: Observation,
    cam_from_world: Rigid3,
    normalized: Normalized,
    center: Vector3<f64>,
    max_error_px: f64,
}

impl Mapper<'_> {
    /// Triangulates a track that has no point yet from its sightings in registered images. The best-supported two-view
    /// hypothesis among the widest pairs picks the inliers, which are then triangulated together.
    fn find_point(&self, track: usize) -> Option<(Vector3<f64>, Vec<Observation>)> {
        let views = self.views_of(track);
        if views.len() < 2 {
            return None;
        }
        let min_angle = self.options.min_triangulation_angle_deg.to_radians();
        let mut pairs: Vec<(f64, usize, usize)> = Vec::new();
        for b in 1..views.len() {
            for a in 0..b {
                let (ray_a, ray_b) = (views[a].ray_in_world(), views[b].ray_in_world());
                pairs.push((ray_a.cross(&ray_b).norm_squared(), a, b));
            }
        }
        pairs.sort_by(|x, y| y.0.total_cmp(&x.0).then((x.1, x.2).cmp(&(y.1, y.2))));
        let mut best: Vec<usize> = Vec::new();
        for &(_, a, b) in pairs.iter().take(MAX_SEED_PAIRS) {
            let Some(xyz) = triangulate_dlt(&[views[a].sighting(), views[b].sighting()]) else { continue };
            if triangulation_angle_rad(&views[a].center, &views[b].center, &xyz) < min_angle {
                continue;
            }
            let inliers: Vec<usize> =
                (0..views.len()).filter(|&at| self.error_px(&views[at], &xyz) <= views[at].max_error_px).collect();
            if inliers.contains(&a) && inliers.contains(&b) && inliers.len() > best.len() {
                best = inliers;
                if best.len() == views.len() {
                    break;
                }
            }
        }
        if best.len() < 2 {
            return None;
        }
        let sightings: Vec<(Rigid3, Normalized)> = best.iter().map(|&at| views[at].sighting()).collect();
        let xyz = refine_point(&sightings, &triangulate_dlt(&sightings)?);
        let kept: Vec<Observation> = best
            .iter()
            .filter(|&&at| self.error_px(&views[at], &xyz) <= views[at].max_error_px)
            .map(|&at| views[at].seen)
            .collect();
        if kept.len() < 2 || !self.options.keep_limits().wide_enough(&self.model, &kept, &xyz) {
            return None;
        }
        Some((xyz, kept))
    }

    /// Triangulates those of these tracks (in ascending order) that have no point, and completes those that have one with
    /// the sightings that agree. Returns how many sightings were added.
    pub(super) fn triangulate_tracks(&mut self, tracks: &[usize]) -> usize {
        let this = &*self;
        let found: Vec<Option<(Vector3<f64>, Vec<Observation>)>> = tracks
            .par_iter()
            .map(|&track| {
                let is_missing = this.live_point(track).is_none() && this.goes_on();
                is_missing.then(|| this.find_point(track)).flatten()
            })
            .collect();
        let mut added = 0;
        for (&track, found) in tracks.iter().zip(found) {
            if let Some((xyz, kept)) = found {
                added += kept.len();
                self.point_of_track[track] = Some(self.model.add_point(xyz, kept, [0; 3]));
            } else {
                added += self.complete_track(track);
            }
        }
        added
    }

    /// Adds the sightings of a track to its point that agree with it; returns how many.
    fn complete_track(&mut self, track: usize) -> usize {
        let Some(id) = self.live_point(track) else { return 0 };
        let Some(xyz) = self.model.point(id).map(|point| point.xyz) else { return 0 };
        let views = self.views_of(track);
        let mut added = 0;
        for view in views {
            if self.error_px(&view, &xyz) <= view.max_error_px && self.model.add_observation(id, view.seen) {
                added += 1;
            }
        }
        added
    }

    /// The point of a track that is still in the model.
    pub(super) fn live_point(&self, track: usize) -> Option<Point3dId> {
        self.point_of_track[track].filter(|&id| self.model.point(id).is_some())
    }

    /// The sightings of a track in registered images that see no point yet.
    fn views_of(&self, track: usize) -> Vec<View> {
        let mut views = Vec::new();
        for &seen in &self.tracks.tracks[track] {
            let Some(image) = self.model.image(seen.image) else { continue };
            if image.points()[seen.keypoint.index()].is_some() {
                continue;
            }
            let camera = &self.model.cameras[&image.camera];
            views.push(View {
                seen,
                cam_from_world: image.cam_from_world,
                normalized: camera.unproject(&image.keypoints[seen.keypoint.index()]),
                center: image.center_in_world(),
                max_error_px: self.max_error_px(camera),
            });
        }
        views
    }

    fn error_px(&self, view: &View, xyz: &Vector3<f64>) -> f64 {
        let image = &self.model.images()[&view.seen.image];
        match self.model.cameras[&image.camera].project(&view.cam_from_world.apply(xyz)) {
            Some(pixel) => (pixel.0 - image.keypoints[view.seen.keypoint.index()].0).norm(),
            None => f64::INFINITY,
        }
    }
}

impl View {
    fn sighting(&self) -> (Rigid3, Normalized) {
        (self.cam_from_world, self.normalized)
    }

    fn ray_in_world(&self) -> Vector3<f64> {
        self.cam_from_world.rotation.inverse() * self.normalized.ray()
    }
}
