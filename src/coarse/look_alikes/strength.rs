//! How much of what two photographs show a pair matches.

use std::collections::{BTreeMap, BTreeSet};

use super::LookAlikeOptions;
use crate::bundle::KeepGoing;
use crate::coarse::MapperInput;
use crate::scene::{ImageId, KeypointIdx};

/// A cell of an image's grid: column, row.
type Cell = (u32, u32);

/// The strength of every pair, 0 to 1: the intersection over union of the cells of both images that hold matched features. What
/// counts as a feature of an image is one matched with any other image; of the cells that hold one, the pair leaves in
/// each image those without a match of its own over.
///
/// Cells instead of features: a densely textured copy must not outweigh sparse surroundings.
///
/// None once `keep_going`, which is asked for every pair, says no.
pub(super) fn strengths(
    input: &MapperInput,
    options: &LookAlikeOptions,
    keep_going: &KeepGoing,
) -> Option<BTreeMap<(ImageId, ImageId), f64>> {
    let mut known: BTreeMap<ImageId, BTreeSet<Cell>> = BTreeMap::new();
    let cell = |image: ImageId, keypoint: KeypointIdx| -> Cell {
        let image = &input.images[&image];
        let camera = &input.cameras[&image.camera];
        let per_px = f64::from(options.grid_cells) / f64::from(camera.width.max(camera.height));
        let at = image.keypoints[keypoint.index()].0 * per_px;
        (at.x.max(0.0) as u32, at.y.max(0.0) as u32)
    };
    let mut matched: BTreeMap<(ImageId, ImageId), [BTreeSet<Cell>; 2]> = BTreeMap::new();
    for (&(a, b), geometry) in &input.graph.pairs {
        if !keep_going() {
            return None;
        }
        let cells_a: BTreeSet<Cell> = geometry.inliers.iter().map(|&(in_a, _)| cell(a, in_a)).collect();
        let cells_b: BTreeSet<Cell> = geometry.inliers.iter().map(|&(_, in_b)| cell(b, in_b)).collect();
        known.entry(a).or_default().extend(&cells_a);
        known.entry(b).or_default().extend(&cells_b);
        matched.insert((a, b), [cells_a, cells_b]);
    }
    let strengths = matched
        .into_iter()
        .map(|((a, b), [cells_a, cells_b])| {
            let share = |cells: &BTreeSet<Cell>, image: ImageId| cells.len() as f64 / known[&image].len() as f64;
            // With the common part as 1, an image whose share is s shows 1 / s, and both together what follows.
            let union = 1.0 / share(&cells_a, a) + 1.0 / share(&cells_b, b) - 1.0;
            ((a, b), 1.0 / union)
        })
        .collect();
    Some(strengths)
}
