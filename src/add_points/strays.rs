//! Points of two sightings at depths where nothing else is.
//!
//! A point that a third image sees is confirmed by it; one of two sightings rests on a single match, and a wrong match on an
//! epipolar line gives a point somewhere along a ray that fits both images perfectly. What tells such strays is where they lie:
//! far behind or in front of everything confirmed that the same image sees.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::scene::{ImageId, Point3dId, Reconstruction};

/// Which points of two sightings are strays.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StrayOptions {
    /// A point of two sightings must lie, in both images, no farther than this many times the greatest depth of confirmed
    /// points and no nearer than the least over this. Lowering it removes more. Origin: measured; 2 removes half to all of the
    /// points far outside the scenes of six sets, and 0.7 to 7 % of those of two sightings.
    pub max_depth_factor: f64,
    /// The least and the greatest depth leave out this share of an image's confirmed points at either end.
    pub left_out_share: f64,
    /// Images with fewer confirmed points tell nothing about depths.
    pub min_confirmed: usize,
}

impl Default for StrayOptions {
    fn default() -> Self {
        Self { max_depth_factor: 2.0, left_out_share: 0.01, min_confirmed: 50 }
    }
}

impl StrayOptions {
    /// Adds a sentence for every value that can't work.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(format!("refine.strays.{message}"));
            }
        };
        check(self.max_depth_factor >= 1.0, "max_depth_factor must be at least 1");
        check((0.0..0.5).contains(&self.left_out_share), "left_out_share must lie in [0, 0.5)");
    }
}

/// Removes the strays; returns how many there were.
pub fn remove_strays(model: &mut Reconstruction, options: &StrayOptions) -> usize {
    let depth = |image: ImageId, point: Point3dId| -> Option<f64> {
        Some(model.image(image)?.cam_from_world.apply(&model.point(point)?.xyz).z)
    };
    let mut confirmed: BTreeMap<ImageId, Vec<f64>> = BTreeMap::new();
    for (id, point) in model.points().filter(|(_, point)| point.track.len() >= 3) {
        for seen in &point.track {
            confirmed.entry(seen.image).or_default().extend(depth(seen.image, id));
        }
    }
    let allowed: BTreeMap<ImageId, (f64, f64)> = confirmed
        .into_iter()
        .filter(|(_, depths)| depths.len() >= options.min_confirmed.max(1))
        .map(|(image, mut depths)| {
            depths.sort_by(f64::total_cmp);
            let left_out = (options.left_out_share * depths.len() as f64) as usize;
            let (least, greatest) = (depths[left_out], depths[depths.len() - 1 - left_out]);
            (image, (least / options.max_depth_factor, greatest * options.max_depth_factor))
        })
        .collect();
    let is_stray = |id: Point3dId, image: ImageId| {
        let (Some((least, greatest)), Some(depth)) = (allowed.get(&image), depth(image, id)) else { return false };
        depth < *least || depth > *greatest
    };
    let strays: Vec<Point3dId> = model
        .points()
        .filter(|(id, point)| point.track.len() == 2 && point.track.iter().any(|seen| is_stray(*id, seen.image)))
        .map(|(id, _)| id)
        .collect();
    for &id in &strays {
        model.remove_point(id);
    }
    strays.len()
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::add_points::test_scene::{SceneSpec, build};
    use crate::scene::{KeypointIdx, Observation};

    #[test]
    fn only_lonely_points_out_of_range_go() {
        let scene = build(&SceneSpec::default());
        let mut model = scene.coarse(0.5);
        let before = model.num_points();
        assert_eq!(remove_strays(&mut model, &StrayOptions::default()), 0, "the scene's own points stay");
        let camera = model.images()[&ImageId(0)].cam_from_world.inverse();
        let free = |image: u32, model: &Reconstruction, nth: usize| {
            let points = model.images()[&ImageId(image)].points();
            let keypoint = (0u32..).zip(points).filter(|(_, point)| point.is_none()).nth(nth).unwrap().0;
            Observation { image: ImageId(image), keypoint: KeypointIdx(keypoint) }
        };
        let depths: Vec<f64> =
            model.points().map(|(_, point)| model.images()[&ImageId(0)].cam_from_world.apply(&point.xyz).z).collect();
        let farthest = depths.iter().copied().fold(0.0, f64::max);
        // Two sightings: far behind and just behind everything; three sightings far behind.
        for (nth, (factor, images)) in [(5.0, 2), (1.1, 2), (5.0, 3)].into_iter().enumerate() {
            let track = (0..images).map(|image| free(image, &model, nth)).collect();
            model.add_point(camera.apply(&Vector3::new(0.0, 0.0, factor * farthest)), track, [0; 3]);
        }
        assert_eq!(remove_strays(&mut model, &StrayOptions::default()), 1);
        assert_eq!(model.num_points(), before + 2);
        model.assert_consistent();
    }
}
