//! Whether the matches of suspected pairs join one place or two, by a model built without them.

use nalgebra::Vector3;

use super::LookAlikeOptions;
use super::skeleton::Suspect;
use crate::coarse::{CoarseModels, MapperInput};
use crate::scene::{ImageId, KeypointIdx, Reconstruction};

/// What the model says of a pair.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Verdict {
    /// Its matches join places that coincide.
    Together,
    /// They join places that lie apart.
    Apart {
        /// Median distance of the places in units of their distance from the camera.
        displacement: f64,
        /// Matches whose places coincide nevertheless ...
        coinciding: usize,
        /// ... of so many with a place for both keypoints.
        judged: usize,
    },
    /// No model holds both images with enough points.
    Unknown,
}

/// Judges every suspect.
pub(super) fn judge(
    models: &CoarseModels,
    input: &MapperInput,
    suspects: &[Suspect],
    options: &LookAlikeOptions,
) -> Vec<Verdict> {
    suspects
        .iter()
        .map(|suspect| {
            let (a, b) = suspect.images;
            let holds = |model: &&Reconstruction| model.image(a).is_some() && model.image(b).is_some();
            let Some(model) = models.models.iter().find(holds) else { return Verdict::Unknown };
            let matches = &input.graph.pairs[&(a, b)].inliers;
            let mut displacements: Vec<f64> =
                matches.iter().filter_map(|&(in_a, in_b)| displacement(model, (a, in_a), (b, in_b))).collect();
            if displacements.len() < options.min_judged_matches {
                return Verdict::Unknown;
            }
            let middle = displacements.len() / 2;
            let displacement = *displacements.select_nth_unstable_by(middle, f64::total_cmp).1;
            if displacement <= options.max_displacement {
                return Verdict::Together;
            }
            let coinciding =
                displacements.iter().filter(|&&displacement| displacement <= options.max_displacement).count();
            Verdict::Apart { displacement, coinciding, judged: displacements.len() }
        })
        .collect()
}

/// How far apart the points of two keypoints lie, in units of the larger distance from the camera that sees one.
fn displacement(model: &Reconstruction, a: (ImageId, KeypointIdx), b: (ImageId, KeypointIdx)) -> Option<f64> {
    let place = |(image, keypoint): (ImageId, KeypointIdx)| -> Option<(Vector3<f64>, f64)> {
        let image = model.image(image)?;
        let xyz = model.point(image.points()[keypoint.index()]?)?.xyz;
        Some((xyz, (xyz - image.center_in_world()).norm()))
    };
    let ((xyz_a, distance_a), (xyz_b, distance_b)) = (place(a)?, place(b)?);
    Some((xyz_a - xyz_b).norm() / distance_a.max(distance_b))
}
