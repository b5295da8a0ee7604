//! The initial pair: many inliers, a wide baseline, and a two-view model that survives its own adjustment.

use std::collections::BTreeSet;

use super::{Mapper, empty_model};
use crate::geometry::Rigid3;
use crate::scene::ImageId;

/// A pair with the score it is tried by.
struct Candidate {
    pair: (ImageId, ImageId),
    inliers: usize,
    angle_deg: f64,
}

impl Mapper<'_> {
    /// Starts the model from the best pair not started from before; false when there is none. Requirements are relaxed step
    /// by step, so that a component with any usable pair gives a model.
    pub(super) fn start(&mut self, used: &mut BTreeSet<(ImageId, ImageId)>) -> bool {
        let candidates = self.candidates();
        let mut min_inliers = self.options.initial_min_inliers as f64;
        let mut min_angle_deg = self.options.initial_min_angle_deg;
        for _ in 0..=self.options.initial_relaxations {
            let fitting = candidates.iter().filter(|candidate| {
                candidate.inliers as f64 >= min_inliers
                    && candidate.angle_deg >= min_angle_deg
                    && !used.contains(&candidate.pair)
            });
            let pairs: Vec<(ImageId, ImageId)> =
                fitting.take(self.options.initial_trials).map(|candidate| candidate.pair).collect();
            for pair in pairs {
                if !self.goes_on() {
                    return false;
                }
                used.insert(pair);
                if self.try_pair(pair) {
                    return true;
                }
                self.reset();
            }
            min_inliers /= 2.0;
            min_angle_deg /= 2.0;
        }
        false
    }

    /// All pairs with a relative pose, best first: by inliers, as long as the angle is reasonable; both images should have
    /// further neighbours to grow to.
    fn candidates(&self) -> Vec<Candidate> {
        let degrees = self.graph.degrees();
        let mut scored: Vec<(f64, Candidate)> = self
            .graph
            .pairs
            .iter()
            .filter(|(_, geometry)| geometry.b_from_a.is_some())
            .map(|(&pair, geometry)| {
                let angle_deg = geometry.median_triangulation_angle_rad.unwrap_or(0.0).to_degrees();
                let inliers = geometry.inliers.len();
                let full_angle = (angle_deg / self.options.initial_min_angle_deg).min(1.0);
                let neighbours = degrees[&pair.0].min(degrees[&pair.1]) as f64;
                let score = inliers as f64 * full_angle * (1.0 + neighbours).ln();
                (score, Candidate { pair, inliers, angle_deg })
            })
            .collect();
        scored.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.pair.cmp(&b.1.pair)));
        scored.into_iter().map(|(_, candidate)| candidate).collect()
    }

    fn reset(&mut self) {
        self.model = empty_model(self.input);
        self.point_of_track.fill(None);
    }

    /// Registers both images, triangulates and adjusts; whether enough points survive.
    fn try_pair(&mut self, (a, b): (ImageId, ImageId)) -> bool {
        let geometry = &self.graph.pairs[&(a, b)];
        let Some(b_from_a) = geometry.b_from_a else { return false };
        for (id, cam_from_world) in [(a, Rigid3::identity()), (b, b_from_a)] {
            let image = &self.input.images[&id];
            self.model.register(id, image.camera, cam_from_world, image.keypoints.clone());
        }
        self.triangulate_image(a);
        self.adjust_pair();
        self.model.num_points() as f64 >= self.options.initial_min_survivors * geometry.inliers.len() as f64
    }
}
