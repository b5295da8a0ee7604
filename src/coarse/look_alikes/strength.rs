//! How much of what two photographs show a pair matches.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix2, Vector2};

use super::LookAlikeOptions;
use crate::bundle::KeepGoing;
use crate::coarse::{MapperImage, MapperInput};
use crate::scene::{ImageId, KeypointIdx};

/// A cell of an image's grid: column, row.
type Cell = (u32, u32);

/// The strength of every pair, 0 to 1: the geometric mean of two intersections over unions of what its photographs show, one
/// with all of it, one with what should be in both by the pair's own matches.
///
/// What a photograph shows are the cells of a grid that hold a feature matched with any other photograph; of these the pair
/// leaves over, in each photograph, those without a match of its own. Cells instead of features: a densely textured copy must
/// not outweigh sparse surroundings.
///
/// A cell weighs the inverse of the number of pairs that match its commonest feature. What is seen in many photographs tells
/// little of where one was taken: a front that stands three times in a street is matched in the photographs of all three, the
/// bin before one of them in a few neighbours alone. Unweighed, two photographs filled by copies of the front match better than
/// two of one copy taken a step apart. (The weight of words in text retrieval: Sparck Jones 1972.)
///
/// What should be in both: cells that the affine map of the matches takes into the other photograph. A step aside moves
/// some of the scene out of the frame, which says nothing against a pair; surroundings that ought to be there and are not do
/// (Zach, Irschara, Bischof, CVPR 2008).
///
/// Measured on random subsets (six tenths of the photographs) of two sets of look-alikes: a wrong pair was among the
/// strongest that connect them all in 9 and 4 of 16 with neither the weights nor the second part, in 3 and 1 with both.
///
/// None once `keep_going`, which is asked for every pair, says no.
pub(super) fn strengths(
    input: &MapperInput,
    options: &LookAlikeOptions,
    keep_going: &KeepGoing,
) -> Option<BTreeMap<(ImageId, ImageId), f64>> {
    let pairs_of_keypoints = pairs_of_keypoints(input, keep_going)?;
    let shown: BTreeMap<ImageId, Shown> = pairs_of_keypoints
        .into_iter()
        .map(|(image, pairs)| (image, Shown::new(input, image, &pairs, options.grid_cells)))
        .collect();
    let mut strengths = BTreeMap::new();
    for (&(a, b), geometry) in &input.graph.pairs {
        if !keep_going() {
            return None;
        }
        let in_a: Vec<KeypointIdx> = geometry.inliers.iter().map(|inlier| inlier.0).collect();
        let in_b: Vec<KeypointIdx> = geometry.inliers.iter().map(|inlier| inlier.1).collect();
        let (of_a, of_b) = (shown[&a].shares(&in_a, &shown[&b], &in_b), shown[&b].shares(&in_b, &shown[&a], &in_a));
        let of_all = intersection_over_union(of_a.of_all, of_b.of_all);
        let of_expected = intersection_over_union(of_a.of_expected, of_b.of_expected);
        strengths.insert((a, b), (of_all * of_expected).sqrt());
    }
    Some(strengths)
}

/// With the common part as 1, an image whose share is s shows 1 / s, and both together what follows.
fn intersection_over_union(share_of_a: f64, share_of_b: f64) -> f64 {
    1.0 / (1.0 / share_of_a + 1.0 / share_of_b - 1.0)
}

/// What an image shows.
struct Shown<'a> {
    image: &'a MapperImage,
    size_px: Vector2<f64>,
    cell_px: f64,
    /// The cells with a matched feature, and what they weigh.
    weights: BTreeMap<Cell, f64>,
}

/// Shares of an image's cells, by weight, that a pair matches.
struct Shares {
    of_all: f64,
    /// Of those that should be in the other image too.
    of_expected: f64,
}

impl<'a> Shown<'a> {
    /// From the number of pairs that match each of its keypoints.
    fn new(input: &'a MapperInput, image: ImageId, pairs_of_keypoint: &[u32], grid_cells: u32) -> Self {
        let image = &input.images[&image];
        let camera = &input.cameras[&image.camera];
        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
        let cell_px = width.max(height) / f64::from(grid_cells);
        let mut shown = Self { image, size_px: Vector2::new(width, height), cell_px, weights: BTreeMap::new() };
        for (keypoint, &pairs) in (0u32..).map(KeypointIdx).zip(pairs_of_keypoint).filter(|(_, pairs)| **pairs > 0) {
            let weight = 1.0 / f64::from(pairs);
            let commonest = shown.weights.entry(shown.cell(keypoint)).or_insert(weight);
            *commonest = weight.min(*commonest);
        }
        shown
    }

    fn at(&self, keypoint: KeypointIdx) -> Vector2<f64> {
        self.image.keypoints[keypoint.index()].0
    }

    fn cell(&self, keypoint: KeypointIdx) -> Cell {
        let at = self.at(keypoint) / self.cell_px;
        (at.x.max(0.0) as u32, at.y.max(0.0) as u32)
    }

    /// The shares of a pair whose matches are the keypoints `own` with `others` of the other image.
    fn shares(&self, own: &[KeypointIdx], other: &Shown<'_>, others: &[KeypointIdx]) -> Shares {
        let matched: BTreeSet<Cell> = own.iter().map(|&keypoint| self.cell(keypoint)).collect();
        let own: Vec<Vector2<f64>> = own.iter().map(|&keypoint| self.at(keypoint)).collect();
        let others: Vec<Vector2<f64>> = others.iter().map(|&keypoint| other.at(keypoint)).collect();
        let other_from_own = affine(&own, &others);
        let is_expected = |&(column, row): &Cell| {
            let middle_px = Vector2::new(f64::from(column) + 0.5, f64::from(row) + 0.5) * self.cell_px;
            // Matches on a line tell no map; nothing is excused then.
            other_from_own.is_none_or(|(linear, offset)| {
                let in_other = linear * middle_px + offset;
                (0.0..other.size_px.x).contains(&in_other.x) && (0.0..other.size_px.y).contains(&in_other.y)
            })
        };
        let (mut in_pair, mut expected, mut all) = (0.0, 0.0, 0.0);
        for (cell, weight) in &self.weights {
            let is_matched = matched.contains(cell);
            all += weight;
            in_pair += if is_matched { *weight } else { 0.0 };
            expected += if is_matched || is_expected(cell) { *weight } else { 0.0 };
        }
        Shares { of_all: in_pair / all, of_expected: in_pair / expected }
    }
}

/// The affine map, a matrix and an offset, that takes points nearest to others, by least squares; none where the points lie on
/// a line.
///
/// With p and q the points less their means, the sum of |q - M p|² is least where M Σ p pᵀ = Σ q pᵀ.
fn affine(from: &[Vector2<f64>], to: &[Vector2<f64>]) -> Option<(Matrix2<f64>, Vector2<f64>)> {
    let mean = |points: &[Vector2<f64>]| points.iter().sum::<Vector2<f64>>() / points.len() as f64;
    let (mean_from, mean_to) = (mean(from), mean(to));
    let (mut spread, mut joint) = (Matrix2::zeros(), Matrix2::zeros());
    for (from, to) in from.iter().zip(to) {
        let (p, q) = (from - mean_from, to - mean_to);
        spread += p * p.transpose();
        joint += q * p.transpose();
    }
    let linear = joint * spread.try_inverse()?;
    Some((linear, mean_to - linear * mean_from))
}

/// In how many pairs every keypoint of every matched image is. None once `keep_going` says no.
fn pairs_of_keypoints(input: &MapperInput, keep_going: &KeepGoing) -> Option<BTreeMap<ImageId, Vec<u32>>> {
    let mut pairs: BTreeMap<ImageId, Vec<u32>> = BTreeMap::new();
    for (&(a, b), geometry) in &input.graph.pairs {
        if !keep_going() {
            return None;
        }
        for &(in_a, in_b) in &geometry.inliers {
            for (image, keypoint) in [(a, in_a), (b, in_b)] {
                let of_image = pairs.entry(image).or_insert_with(|| vec![0; input.images[&image].keypoints.len()]);
                of_image[keypoint.index()] += 1;
            }
        }
    }
    Some(pairs)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_affine_map_is_found_and_a_line_tells_none() {
        let from = [(0.0, 0.0), (3.0, 1.0), (1.0, 4.0), (7.0, 2.0)].map(|(x, y)| Vector2::new(x, y));
        let truth = |p: Vector2<f64>| Vector2::new(0.5 * p.x - p.y + 7.0, 2.0 * p.x + 0.3 * p.y - 1.0);
        let (linear, offset) = affine(&from, &from.map(truth)).unwrap();
        let at = Vector2::new(-5.0, 11.0);
        assert!((linear * at + offset - truth(at)).norm() < 1e-12);
        let line = [0.0, 1.0, 2.0].map(|x| Vector2::new(x, 0.0));
        assert!(affine(&line, &line).is_none());
    }
}
