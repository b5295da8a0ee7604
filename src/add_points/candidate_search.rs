//! The features within a band around a line (paper, section 6.2.1): four ways, one result.
//!
//! - *sweep*: features in the order in which a line about the epipole meets them ([`super::sweep`]), exact without sampling
//!   and without a search for each line; made for a pair of images, so it is not among the finders of this file;
//! - *grid*: four overlapping grids ([`super::grid`]), `O(K + C')` for K samples and C' features in their cells;
//! - *radial*: a k-d tree over positions, asked for the neighbourhood of every sample. Discs of the print's radius d at a
//!   spacing of d miss 4 % of the band (half-way between samples they reach only 0.866 d); of radius `sqrt(5)/2 d` nothing;
//! - *linear*: all features, `O(F)`; the oracle of the others.
//!
//! Each is followed by the exact test of equation 3.

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use nalgebra::Vector2;
use serde::{Deserialize, Serialize};

use super::epipolar::{BoundingBox, EpipolarLine};
use super::grid::OverlappingGrids;

/// How features near an epipolar line are found.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum CandidateSearch {
    /// A sweep about the epipole: the fastest.
    #[default]
    Sweep,
    /// Overlapping grids: the paper's choice.
    Grid,
    /// A k-d tree over positions.
    Radial,
    /// A scan of all features.
    Linear,
}

/// Finds the features near lines in one image.
pub struct CandidateFinder {
    positions: Vec<Vector2<f64>>,
    members: Vec<u32>,
    bounds: Option<BoundingBox>,
    band_px: f64,
    index: Index,
}

enum Index {
    Grid(OverlappingGrids),
    Radial(Box<ImmutableKdTree<f64, 2>>),
    Linear,
}

/// Marks of the features already found, re-used from line to line.
#[derive(Clone, Debug, Default)]
pub struct SeenMarks {
    round_of: Vec<u32>,
    round: u32,
}

impl SeenMarks {
    /// Forgets all marks and makes room for `n` features.
    pub fn restart(&mut self, n: usize) {
        if self.round_of.len() < n || self.round == u32::MAX {
            self.round_of = vec![0; n];
            self.round = 0;
        }
        self.round += 1;
    }

    /// Marks a feature; whether it had no mark.
    #[inline]
    pub fn mark(&mut self, feature: u32) -> bool {
        let round = &mut self.round_of[feature as usize];
        let new = *round != self.round;
        *round = self.round;
        new
    }

    /// Whether a feature is marked.
    #[inline]
    pub fn is_marked(&self, feature: u32) -> bool {
        self.round_of[feature as usize] == self.round
    }
}

impl CandidateFinder {
    /// For the features `members` (ascending) of `positions`, in undistorted pixels, and bands of half-width `band_px`.
    pub fn new(
        positions: Vec<Vector2<f64>>,
        members: Vec<u32>,
        band_px: f64,
        cell_half_size_px: f64,
        search: CandidateSearch,
    ) -> Self {
        let bounds = BoundingBox::around(members.iter().map(|&member| &positions[member as usize]));
        let index = match (search, bounds) {
            (CandidateSearch::Grid, Some(bounds)) => {
                Index::Grid(OverlappingGrids::new(&positions, &members, bounds, cell_half_size_px))
            }
            (CandidateSearch::Radial, Some(_)) => {
                let points: Vec<[f64; 2]> = members.iter().map(|&member| positions[member as usize].into()).collect();
                // A tree that can't be built (positions are finite, so none is known) costs speed, not candidates.
                ImmutableKdTree::new_from_slice(&points).map_or(Index::Linear, |tree| Index::Radial(Box::new(tree)))
            }
            _ => Index::Linear,
        };
        Self { positions, members, bounds, band_px, index }
    }

    /// Undistorted position of every feature, members or not.
    pub fn positions(&self) -> &[Vector2<f64>] {
        &self.positions
    }

    /// The features that can be found, ascending.
    pub fn members(&self) -> &[u32] {
        &self.members
    }

    /// The smallest box around all members; none when there is none.
    pub fn bounds(&self) -> Option<BoundingBox> {
        self.bounds
    }

    /// The members within the band around a line, ascending, into `found` (cleared first); they stay marked in `marks`.
    pub fn near_line(&self, line: &EpipolarLine, marks: &mut SeenMarks, found: &mut Vec<u32>) {
        found.clear();
        marks.restart(self.positions.len());
        let within = |feature: u32| line.distance_px(&self.positions[feature as usize]) <= self.band_px;
        match &self.index {
            Index::Grid(grids) => grids.visit(line, self.band_px, |feature| {
                if within(feature) && marks.mark(feature) {
                    found.push(feature);
                }
            }),
            Index::Radial(tree) => self.visit_discs(tree, line, |feature| {
                if within(feature) && marks.mark(feature) {
                    found.push(feature);
                }
            }),
            Index::Linear => {
                for &feature in &self.members {
                    if within(feature) {
                        marks.mark(feature);
                        found.push(feature);
                    }
                }
            }
        }
        found.sort_unstable();
    }

    /// Calls `found` for the members in discs around samples of the line, for some more than once.
    fn visit_discs(&self, tree: &ImmutableKdTree<f64, 2>, line: &EpipolarLine, mut found: impl FnMut(u32)) {
        let ends = self.bounds.and_then(|bounds| bounds.grown(self.band_px).clip(line));
        let Some([enter, leave]) = ends else { return };
        let steps = ((leave - enter).norm() / self.band_px).ceil().max(1.0);
        let radius_sq = COVERING_RADIUS_SQ * self.band_px * self.band_px;
        for k in 0..=steps as usize {
            let sample = enter + (leave - enter) * (k as f64 / steps);
            let disc = tree.query(&sample.into()).within::<SquaredEuclidean<f64>>(radius_sq).unsorted().execute();
            disc.iter().for_each(|hit| found(self.members[hit.item as usize]));
        }
    }
}

/// Square of the radius, in spacings, at which discs cover a band as wide as their spacing: `1 + 1/4`, and a hair for
/// rounding.
const COVERING_RADIUS_SQ: f64 = 1.25 + 1e-9;

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::math::Rng;

    fn scattered(n: usize, rng: &mut Rng) -> Vec<Vector2<f64>> {
        let mut positions: Vec<_> =
            (0..n).map(|_| Vector2::new(rng.range(-30.0, 1530.0), rng.range(-20.0, 1020.0))).collect();
        // On the border and in the corners too.
        positions[0] = Vector2::new(-30.0, -20.0);
        positions[1] = Vector2::new(1530.0, 1020.0);
        positions[2] = Vector2::new(-30.0, 1020.0);
        positions[3] = Vector2::new(700.0, 1020.0);
        positions
    }

    fn random_line(rng: &mut Rng) -> EpipolarLine {
        let angle = rng.range(0.0, std::f64::consts::PI);
        let through = Vector2::new(rng.range(-50.0, 1550.0), rng.range(-40.0, 1040.0));
        let normal = Vector2::new(angle.cos(), angle.sin());
        EpipolarLine::from_coefficients(&Vector3::new(normal.x, normal.y, -normal.dot(&through))).unwrap()
    }

    /// Fraction of the oracle's candidates found, over many random lines.
    fn recall(search: CandidateSearch, half_size_bands: f64) -> f64 {
        let mut rng = Rng::from_parts(&[11]);
        let positions = scattered(4000, &mut rng);
        let members: Vec<u32> = (0..4000).filter(|m| m % 7 != 5).collect();
        let band = 6.0;
        let make =
            |search| CandidateFinder::new(positions.clone(), members.clone(), band, half_size_bands * band, search);
        let (oracle, finder) = (make(CandidateSearch::Linear), make(search));
        let (mut marks, mut expected, mut found) = (SeenMarks::default(), Vec::new(), Vec::new());
        let (mut total, mut hits) = (0, 0);
        for _ in 0..1500 {
            let line = random_line(&mut rng);
            oracle.near_line(&line, &mut marks, &mut expected);
            finder.near_line(&line, &mut marks, &mut found);
            assert!(found.windows(2).all(|pair| pair[0] < pair[1]), "ascending, none twice");
            assert!(found.iter().all(|f| expected.binary_search(f).is_ok()), "nothing beyond the band");
            total += expected.len();
            hits += found.len();
        }
        assert!(total > 10_000);
        hits as f64 / total as f64
    }

    #[test]
    fn the_grid_finds_all_from_root_five_bands_on() {
        assert_eq!(recall(CandidateSearch::Grid, 5f64.sqrt()), 1.0);
        assert_eq!(recall(CandidateSearch::Grid, 2.25), 1.0);
    }

    #[test]
    fn smaller_cells_miss_what_the_study_says() {
        assert!(recall(CandidateSearch::Grid, 2.0) > 0.9999);
        let printed = recall(CandidateSearch::Grid, 1.0);
        assert!((0.88..0.95).contains(&printed), "the printed cell size finds {printed}");
    }

    #[test]
    fn radial_search_finds_all() {
        assert_eq!(recall(CandidateSearch::Radial, 2.25), 1.0);
    }

    #[test]
    fn no_features_are_no_candidates() {
        for search in [CandidateSearch::Grid, CandidateSearch::Radial, CandidateSearch::Linear] {
            let finder = CandidateFinder::new(Vec::new(), Vec::new(), 4.0, 9.0, search);
            let mut found = vec![1];
            finder.near_line(&random_line(&mut Rng::from_parts(&[1])), &mut SeenMarks::default(), &mut found);
            assert!(found.is_empty());
        }
    }
}
