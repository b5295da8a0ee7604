//! Takes sightings that do not fit and points that are badly determined out of a model.

use nalgebra::Vector3;
use rayon::prelude::*;

use crate::camera::Camera;
use crate::geometry::triangulation::triangulation_angle_rad;
use crate::scene::{Observation, Point3dId, Reconstruction};

/// What a sighting and a point must keep to stay.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct KeepLimits {
    /// Largest reprojection error, in pixels, in an image of `reference_long_side_px`.
    pub max_reprojection_error_px: f64,
    /// Long side, in pixels, the error limit is meant for.
    pub reference_long_side_px: f64,
    /// Smallest factor by which a small image shrinks it.
    pub min_threshold_scale: f64,
    /// Smallest angle, in radians, between two rays of a point.
    pub min_triangulation_angle_rad: f64,
}

impl KeepLimits {
    /// The factor of pixel thresholds for images of a camera.
    pub fn threshold_scale(&self, camera: &Camera) -> f64 {
        (f64::from(camera.width.max(camera.height)) / self.reference_long_side_px).max(self.min_threshold_scale)
    }

    /// The largest reprojection error in images of a camera.
    pub fn max_error_px(&self, camera: &Camera) -> f64 {
        self.max_reprojection_error_px * self.threshold_scale(camera)
    }

    /// Whether two of the sightings' rays to `xyz` meet at the smallest allowed angle or more.
    pub fn wide_enough(&self, model: &Reconstruction, track: &[Observation], xyz: &Vector3<f64>) -> bool {
        let centers: Vec<Vector3<f64>> =
            track.iter().map(|seen| model.images()[&seen.image].center_in_world()).collect();
        let wide = |a: usize, b: usize| {
            triangulation_angle_rad(&centers[a], &centers[b], xyz) >= self.min_triangulation_angle_rad
        };
        (1..centers.len()).any(|b| (0..b).any(|a| wide(a, b)))
    }
}

/// Removes the sightings of these points that are too far off and the points whose rays are too narrow. Returns the number
/// of sightings removed.
pub fn filter(model: &mut Reconstruction, points: &[Point3dId], limits: &KeepLimits) -> usize {
    let judged: Vec<Option<Vec<Observation>>> = points.par_iter().map(|&id| misfits(model, id, limits)).collect();
    let mut removed = 0;
    for (&id, misfits) in points.iter().zip(judged) {
        let Some(before) = model.point(id).map(|point| point.track.len()) else { continue };
        match misfits {
            None => model.remove_point(id),
            Some(misfits) => {
                for seen in misfits {
                    if model.point(id).is_some() {
                        model.remove_observation(id, seen);
                    }
                }
            }
        }
        removed += before - model.point(id).map_or(0, |point| point.track.len());
    }
    removed
}

/// The sightings of a point to remove; none when the whole point must go.
fn misfits(model: &Reconstruction, id: Point3dId, limits: &KeepLimits) -> Option<Vec<Observation>> {
    let point = model.point(id)?;
    let (fits, misfits): (Vec<Observation>, Vec<Observation>) = point
        .track
        .iter()
        .partition(|&&seen| model.reprojection_error_px(id, seen) <= limits.max_error_px(model.camera_of(seen.image)));
    (fits.len() >= 2 && limits.wide_enough(model, &fits, &point.xyz)).then_some(misfits)
}
