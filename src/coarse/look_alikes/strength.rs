//! How much of what two photographs show a pair matches.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Vector2};

use super::LookAlikeOptions;
use crate::bundle::KeepGoing;
use crate::coarse::MapperInput;
use crate::scene::{ImageId, KeypointIdx};

/// Cells of the fine grid along a side of a window, which is odd.
const WINDOW_CELLS: usize = 3;

/// The strength of every pair, 0 to 1: the geometric mean of two intersections over unions of what its photographs show, one
/// with all of it, one with what should be in both by the pair's own matches.
///
/// What a photograph shows are the cells of a fine grid that hold a feature matched with any other photograph; of these
/// the pair leaves over, in each photograph, those without a match of its own in the window of three by three cells
/// around them. Cells instead of features: a densely textured copy must not outweigh sparse surroundings. For the same
/// reason a cell weighs the inverse of the number of cells shown in its window. Windows that overlap instead of a
/// coarse grid of their size: with that, the order of the pairs changed with where its lines happened to fall (below).
///
/// A cell weighs, further, the inverse of the number of pairs that match the commonest feature of its window. What is
/// seen in many photographs tells little of where one was taken: a front that stands three times in a street is matched
/// in the photographs of all three, the bin before one of them in a few neighbours alone. Unweighed, two photographs
/// filled by copies of the front match better than two of one copy taken a step apart. (The weight of words in text
/// retrieval: Sparck Jones 1972.)
///
/// What should be in both: cells that the affine map of the matches takes into the other photograph. A step aside moves
/// some of the scene out of the frame, which says nothing against a pair; surroundings that ought to be there and are not do
/// (Zach, Irschara, Bischof, CVPR 2008).
///
/// Measured on 32 random subsets each (half or six tenths of the photographs) of three sets of look-alikes: a wrong pair was
/// among the strongest that connect them all in 3, 0 and 2. On a plain grid of 9 or 12 cells it was in 5 to 8, 0 or 1, and 1 to
/// 25, as its lines fell.
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
        let at_px = |image: ImageId, keypoint: KeypointIdx| input.images[&image].keypoints[keypoint.index()].0;
        let in_a: Vec<Vector2<f64>> = geometry.inliers.iter().map(|inlier| at_px(a, inlier.0)).collect();
        let in_b: Vec<Vector2<f64>> = geometry.inliers.iter().map(|inlier| at_px(b, inlier.1)).collect();
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

/// The fine grid over an image, whose cells are numbered row by row.
struct Grid {
    cell_px: f64,
    columns: usize,
    rows: usize,
}

impl Grid {
    /// With windows of which so many fit along the longer side.
    fn new(size_px: Vector2<f64>, grid_cells: u32) -> Self {
        let cell_px = size_px.max() / (f64::from(grid_cells) * WINDOW_CELLS as f64);
        let cells = |length_px: f64| (length_px / cell_px).ceil() as usize;
        Self { cell_px, columns: cells(size_px.x), rows: cells(size_px.y) }
    }

    fn len(&self) -> usize {
        self.columns * self.rows
    }

    /// The cell of a pixel; those beyond a border are taken to it.
    fn cell(&self, at_px: Vector2<f64>) -> usize {
        let at = at_px / self.cell_px;
        (at.y as usize).min(self.rows - 1) * self.columns + (at.x as usize).min(self.columns - 1)
    }

    fn middle_px(&self, cell: usize) -> Vector2<f64> {
        Vector2::new((cell % self.columns) as f64 + 0.5, (cell / self.columns) as f64 + 0.5) * self.cell_px
    }

    /// The cells of the window around one.
    fn window(&self, cell: usize) -> impl Iterator<Item = usize> {
        let around = |middle: usize, len: usize| {
            middle.saturating_sub(WINDOW_CELLS / 2)..=(middle + WINDOW_CELLS / 2).min(len - 1)
        };
        let columns = around(cell % self.columns, self.columns);
        around(cell / self.columns, self.rows)
            .flat_map(move |row| columns.clone().map(move |column| row * self.columns + column))
    }
}

/// What an image shows.
struct Shown {
    size_px: Vector2<f64>,
    grid: Grid,
    /// The cells with a matched feature, and what they weigh.
    weights: Vec<(usize, f64)>,
}

/// Shares of an image's cells, by weight, that a pair matches.
struct Shares {
    of_all: f64,
    /// Of those that should be in the other image too.
    of_expected: f64,
}

impl Shown {
    /// From the number of pairs that match each of its keypoints.
    fn new(input: &MapperInput, image: ImageId, pairs_of_keypoint: &[u32], grid_cells: u32) -> Self {
        let image = &input.images[&image];
        let camera = &input.cameras[&image.camera];
        let size_px = Vector2::new(f64::from(camera.width), f64::from(camera.height));
        let grid = Grid::new(size_px, grid_cells);
        let mut commonest = vec![0; grid.len()];
        for (keypoint, &pairs) in image.keypoints.iter().zip(pairs_of_keypoint) {
            let cell = grid.cell(keypoint.0);
            commonest[cell] = pairs.max(commonest[cell]);
        }
        let weight = |cell: usize| {
            let shown: Vec<u32> = grid.window(cell).map(|near| commonest[near]).filter(|&pairs| pairs > 0).collect();
            let pairs = shown.iter().fold(1, |most, &pairs| pairs.max(most));
            1.0 / (f64::from(pairs) * shown.len() as f64)
        };
        let weights = (0..grid.len()).filter(|&cell| commonest[cell] > 0).map(|cell| (cell, weight(cell))).collect();
        Self { size_px, grid, weights }
    }

    /// The shares of a pair whose matches lie at the pixels `own` and, in the other image, `others`.
    fn shares(&self, own: &[Vector2<f64>], other: &Shown, others: &[Vector2<f64>]) -> Shares {
        let mut is_matched = vec![false; self.grid.len()];
        for near in own.iter().flat_map(|&at_px| self.grid.window(self.grid.cell(at_px))) {
            is_matched[near] = true;
        }
        let other_from_own = affine(own, others);
        let is_expected = |cell: usize| {
            // Matches on a line tell no map; nothing is excused then.
            other_from_own.is_none_or(|(linear, offset)| {
                let in_other = linear * self.grid.middle_px(cell) + offset;
                (0.0..other.size_px.x).contains(&in_other.x) && (0.0..other.size_px.y).contains(&in_other.y)
            })
        };
        let (mut in_pair, mut expected, mut all) = (0.0, 0.0, 0.0);
        for &(cell, weight) in &self.weights {
            all += weight;
            in_pair += if is_matched[cell] { weight } else { 0.0 };
            expected += if is_matched[cell] || is_expected(cell) { weight } else { 0.0 };
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
    use crate::camera::Pixel;
    use crate::coarse::look_alikes::tests::matched_input;

    const SIZE_PX: (u32, u32) = (1000, 800);

    /// A rectangle full of features: left, top, width, height.
    type Patch = (f64, f64, f64, f64);

    /// What a feature looks like: its patch, and its column and row there.
    type Look = (usize, u32, u32);

    /// The strengths of pairs of photographs, which show patches; those of one number look alike in all of them.
    fn rated(photographs: &[&[(usize, Patch)]]) -> BTreeMap<(ImageId, ImageId), f64> {
        let features = |patches: &[(usize, Patch)]| -> Vec<(Look, Pixel)> {
            let of_patch = |&(number, (left, top, width, height)): &(usize, Patch)| {
                let places = (0..(height / 20.0) as u32).flat_map(move |row| {
                    (0..(width / 20.0) as u32)
                        .map(move |column| (column, row, left + 20.0 * f64::from(column), top + 20.0 * f64::from(row)))
                });
                places
                    .filter(|&(_, _, x, y)| (0.0..f64::from(SIZE_PX.0)).contains(&x) && y < f64::from(SIZE_PX.1))
                    .map(move |(column, row, x, y)| ((number, column, row), Pixel::new(x, y)))
                    .collect::<Vec<_>>()
            };
            patches.iter().flat_map(of_patch).collect()
        };
        let shown: Vec<Vec<(Look, Pixel)>> = photographs.iter().map(|patches| features(patches)).collect();
        let mut pairs = Vec::new();
        for (a, in_a) in shown.iter().enumerate() {
            for (b, in_b) in shown.iter().enumerate().skip(a + 1) {
                let same = |(at, (feature, _)): (usize, &(Look, Pixel))| {
                    let other = in_b.iter().position(|(other, _)| other == feature)?;
                    Some((KeypointIdx(at as u32), KeypointIdx(other as u32)))
                };
                let inliers: Vec<_> = in_a.iter().enumerate().filter_map(same).collect();
                if !inliers.is_empty() {
                    pairs.push(((ImageId(a as u32), ImageId(b as u32)), inliers));
                }
            }
        }
        let keypoints = shown.iter().map(|features| features.iter().map(|(_, at)| *at).collect()).collect();
        let input = matched_input(SIZE_PX, keypoints, pairs);
        strengths(&input, &LookAlikeOptions::default(), &|| true).unwrap()
    }

    /// Where the lines of the grid fall must not matter: everything is moved by as much as this.
    const MOVES_PX: [f64; 4] = [0.0, 7.0, 14.0, 21.0];

    /// Photographs 0 and 1 are of one place, 2 is of a copy.
    fn assert_first_is_stronger(found: &BTreeMap<(ImageId, ImageId), f64>, moved_px: f64) {
        let (true_one, wrong) = (found[&(ImageId(0), ImageId(1))], found[&(ImageId(0), ImageId(2))]);
        assert!(true_one > 1.05 * wrong, "moved by {moved_px}: {true_one} and {wrong}");
    }

    #[test]
    fn what_few_photographs_show_outweighs_a_copied_front_that_fills_the_picture() {
        for at in MOVES_PX {
            let front = (0, (100.0 + at, 100.0, 800.0, 400.0));
            let (bin, bush) = ((1, (100.0 + at, 600.0, 300.0, 150.0)), (2, (500.0 + at, 600.0, 300.0, 150.0)));
            // Two photographs of one front, half of which something hides in the second; three of a copy elsewhere.
            let half_front = (0, (100.0 + at, 100.0, 400.0, 400.0));
            let found = rated(&[&[front, bin], &[half_front, bin], &[front, bush], &[front, bush], &[front, bush]]);
            assert_first_is_stronger(&found, at);
        }
    }

    #[test]
    fn what_left_the_frame_counts_little_against_a_pair() {
        for at in MOVES_PX {
            let front = (0, (100.0 + at, 100.0, 800.0, 400.0));
            let (bin, bush) = ((1, (100.0 + at, 600.0, 250.0, 100.0)), (2, (500.0 + at, 600.0, 250.0, 100.0)));
            // The second photograph was taken a step to the left.
            let aside =
                |(number, (left, top, width, height)): (usize, Patch)| (number, (left + 500.0, top, width, height));
            let found = rated(&[&[front, bin], &[aside(front), aside(bin)], &[front, bush], &[front, bush]]);
            assert_first_is_stronger(&found, at);
        }
    }

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
