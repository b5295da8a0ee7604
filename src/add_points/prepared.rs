//! What matching needs of an image, computed once and used for all its pairs.

use std::sync::Arc;

use nalgebra::Vector2;

use super::candidate_search::CandidateFinder;
use super::options::{GuidedMatchOptions, PixelScaling};
use crate::camera::{Camera, Normalized};
use crate::geometry::Rigid3;
use crate::scene::{Features, RegisteredImage};

/// A registered image ready for guided matching.
pub struct PreparedImage {
    /// Its intrinsics.
    pub camera: Camera,
    /// Its pose.
    pub cam_from_world: Rigid3,
    /// Its features.
    pub features: Arc<Features>,
    /// Undistorted, normalised position of every keypoint.
    pub normalized: Vec<Normalized>,
    /// Finds keypoints near lines, in undistorted pixels.
    pub finder: CandidateFinder,
    /// Which keypoints are at one place.
    pub same_place: SamePlace,
    /// Pixels to a scaled pixel.
    pub px_scale: f64,
}

impl PreparedImage {
    /// Prepares an image. Keypoints whose distortion can't be undone take no part.
    ///
    /// # Panics
    /// When the model's keypoints are not those of the features.
    pub fn new(
        image: &RegisteredImage,
        camera: &Camera,
        features: Arc<Features>,
        options: &GuidedMatchOptions,
        scaling: &PixelScaling,
    ) -> Self {
        assert_eq!(image.keypoints.len(), features.len(), "an image's keypoints are those of its features");
        let normalized: Vec<Normalized> = image.keypoints.iter().map(|at| camera.unproject(at)).collect();
        let ((fx, fy), center) = (camera.focal(), camera.principal_point().0);
        let positions: Vec<Vector2<f64>> =
            normalized.iter().map(|at| Vector2::new(fx * at.0.x + center.x, fy * at.0.y + center.y)).collect();
        let size = Vector2::new(f64::from(camera.width), f64::from(camera.height));
        let usable = |k: usize| {
            let inside = (0..2).all(|axis| positions[k][axis] >= -size[axis] && positions[k][axis] <= 2.0 * size[axis]);
            inside && (camera.project_normalized(&normalized[k]).0 - image.keypoints[k].0).norm() < MAX_ROUND_TRIP_PX
        };
        let members: Vec<u32> = (0..normalized.len()).filter(|&k| usable(k)).map(|k| k as u32).collect();
        let px_scale = scaling.factor(camera);
        let same_place = SamePlace::new(&positions, &members, options.same_place_px * px_scale);
        // A group's candidates are within the band of its first line; its other lines are up to the tolerance away.
        let band_px = (options.band_px + options.group_tolerance_px) * px_scale;
        let cell_half_size_px = options.cell_half_size_bands * band_px;
        let finder = CandidateFinder::new(positions, members, band_px, cell_half_size_px, options.search);
        Self {
            camera: camera.clone(),
            cam_from_world: image.cam_from_world,
            features,
            normalized,
            finder,
            same_place,
            px_scale,
        }
    }
}

/// Positions whose undistortion, distorted again, misses by more than this were not undistorted: the Newton iteration
/// leaves errors far below a pixel where it converges and of many pixels where the distortion has no inverse. Together
/// with the limit of one image size around the image this also bounds the grid.
const MAX_ROUND_TRIP_PX: f64 = 0.1;

/// Which features are at one place: SIFT gives a place one feature per dominant orientation, and sometimes one per scale.
pub struct SamePlace {
    starts: Vec<u32>,
    others: Vec<u32>,
}

impl SamePlace {
    /// Features `members` of `positions` within a radius of one another.
    fn new(positions: &[Vector2<f64>], members: &[u32], radius_px: f64) -> Self {
        let mut by_x = members.to_vec();
        by_x.sort_by(|&a, &b| positions[a as usize].x.total_cmp(&positions[b as usize].x).then(a.cmp(&b)));
        let mut pairs = Vec::new();
        for (rank, &a) in by_x.iter().enumerate() {
            let at = positions[a as usize];
            for &b in &by_x[rank + 1..] {
                let offset = positions[b as usize] - at;
                if offset.x > radius_px {
                    break;
                }
                if offset.norm() <= radius_px {
                    pairs.extend([(a, b), (b, a)]);
                }
            }
        }
        pairs.sort_unstable();
        let mut starts = vec![0u32; positions.len() + 1];
        for &(a, _) in &pairs {
            starts[a as usize + 1] += 1;
        }
        for at in 0..positions.len() {
            starts[at + 1] += starts[at];
        }
        Self { starts, others: pairs.into_iter().map(|(_, b)| b).collect() }
    }

    /// The other features at the place of a feature, ascending.
    #[inline]
    pub fn others(&self, feature: u32) -> &[u32] {
        &self.others[self.starts[feature as usize] as usize..self.starts[feature as usize + 1] as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn places_are_shared_within_the_radius() {
        let positions: Vec<_> =
            [(5.0, 5.0), (6.0, 5.0), (5.0, 5.0), (6.9, 5.0), (5.0, 40.0)].map(|(x, y)| Vector2::new(x, y)).to_vec();
        let places = SamePlace::new(&positions, &[0, 1, 2, 3, 4], 1.0);
        let all: Vec<&[u32]> = (0..5).map(|feature| places.others(feature)).collect();
        assert_eq!(all, [&[1, 2][..], &[0, 2, 3], &[0, 1], &[1], &[]]);
        assert!(SamePlace::new(&positions, &[0, 4], 1.0).others(0).is_empty(), "members only");
    }
}
