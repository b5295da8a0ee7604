//! Options of the point addition stage.

use serde::{Deserialize, Serialize};

use super::candidate_search::CandidateSearch;
use crate::camera::Camera;
use crate::matching::standing::StandingOptions;

/// Everything that steers the addition of points.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AddPointsOptions {
    /// Which pairs are matched.
    pub candidate_pairs: CandidatePairOptions,
    /// How a pair is matched.
    pub guided_match: GuidedMatchOptions,
    /// How tracks become points.
    pub triangulation: TriangulationOptions,
    /// How lengths in pixels grow with the image.
    pub pixel_scaling: PixelScaling,
    /// Which memory the stage may use.
    pub blocks: BlockOptions,
}

impl AddPointsOptions {
    /// Adds a sentence for every value that can't work.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.candidate_pairs.validate(errors);
        self.guided_match.validate(errors);
        self.triangulation.validate(errors);
        self.pixel_scaling.validate(errors);
        self.blocks.validate(errors);
    }
}

/// Adds a sentence when a condition does not hold.
fn require(holds: bool, message: &str, errors: &mut Vec<String>) {
    if !holds {
        errors.push(format!("add_points.{message}"));
    }
}

/// Which pairs are matched (paper, section 6.1).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct CandidatePairOptions {
    /// A pair is a candidate when it shares more points than this. The paper's T.
    pub more_shared_points_than: usize,
    /// The candidates of an image are at most this fraction of all images, the most covisible ones. The paper's k = 10 %.
    pub top_fraction: f64,
    /// ... but this many in any case, or small sets would go unmatched. The authors' own scripts have 20; beyond the ten most
    /// covisible, a set of 50 pictures all round an object gains 7 % more points for twice the time.
    pub top_at_least: usize,
    /// Images with fewer candidates than this get candidates of their candidates too; 0 turns that off. The authors' code
    /// does the same.
    pub second_level_below: usize,
}

impl Default for CandidatePairOptions {
    fn default() -> Self {
        Self { more_shared_points_than: 8, top_fraction: 0.1, top_at_least: 10, second_level_below: 5 }
    }
}

impl CandidatePairOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        let fraction = (0.0..=1.0).contains(&self.top_fraction);
        require(fraction, "candidate_pairs.top_fraction must lie between 0 and 1", errors);
        let some = self.top_at_least >= 1;
        require(some, "candidate_pairs.top_at_least must be at least 1", errors);
    }
}

/// How a pair is matched along epipolar lines (paper, section 6.2).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct GuidedMatchOptions {
    /// How features near an epipolar line are found. Grid, radial and linear search give the same matches; the sweep has no
    /// groups of lines, so its candidates are those of each query's own band, without the group's tolerance.
    pub search: CandidateSearch,
    /// Half-width of the band around an epipolar line, the paper's d: scaled pixels. Wider bands forgive worse poses and
    /// compare more features. The authors' code has 4.
    pub band_px: f64,
    /// Queries share one candidate set while their lines cut the border of the target within this of the group's first
    /// line: scaled pixels. The paper's 2.
    pub group_tolerance_px: f64,
    /// Half the side of a cell of the overlapping grids, in bands. From `sqrt(5)` on nothing is missed
    /// ([`super::grid`]); the authors' code has 2.
    pub cell_half_size_bands: f64,
    /// Queries nearer than this many bands to the epipole are left out: their lines say nothing.
    pub epipole_clearance_bands: f64,
    /// Largest ratio of the best distance to the second best. Raising it gives more and worse matches.
    pub max_ratio: f64,
    /// Largest ratio of a match that may make a point without a third view's consent: where nothing else speaks against wrong
    /// matches, this must.
    pub distinctive_ratio: f64,
    /// Candidate sets smaller than this are filled up with random features of the target, which compete for the second
    /// place only. The authors' 50.
    pub pad_to: usize,
    /// Features within this of one another are one place: a candidate is not held against another at its place (SIFT
    /// describes a place once per dominant orientation): scaled pixels.
    pub same_place_px: f64,
    /// Whether a match must be the best in both directions.
    pub mutual: bool,
    /// Whether the way back of a mutual match must pass the ratio test too.
    pub ratio_both_ways: bool,
    /// Whether a match must triangulate in front of both cameras.
    pub cheirality: bool,
    /// Which matches are no part of the scene, as they stand still in the frame: an epipolar line that lies along the
    /// motion does not tell them from others.
    pub standing: StandingOptions,
    /// Largest factor by which the ratio of both keypoints' scales may differ from the one their depths foretell; none
    /// turns the gate off.
    pub max_scale_discrepancy: Option<f64>,
    /// Largest difference of a match's change of orientation from the commonest of the pair, in degrees; none turns the
    /// gate off.
    pub max_orientation_discrepancy_deg: Option<f64>,
    /// A pair with fewer matches is given up. The authors' 16.
    pub min_pair_matches: usize,
}

impl Default for GuidedMatchOptions {
    fn default() -> Self {
        Self {
            search: CandidateSearch::Sweep,
            band_px: 4.0,
            group_tolerance_px: 2.0,
            cell_half_size_bands: 2.25,
            epipole_clearance_bands: 3.0,
            max_ratio: 0.8,
            distinctive_ratio: 0.6,
            pad_to: 50,
            same_place_px: 2.0,
            mutual: true,
            ratio_both_ways: false,
            cheirality: true,
            standing: StandingOptions::default(),
            max_scale_discrepancy: Some(3.0),
            max_orientation_discrepancy_deg: Some(60.0),
            min_pair_matches: 16,
        }
    }
}

impl GuidedMatchOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        self.standing.validate(errors);
        require(self.band_px > 0.0, "guided_match.band_px must be positive", errors);
        require(self.group_tolerance_px >= 0.0, "guided_match.group_tolerance_px must not be negative", errors);
        require(self.cell_half_size_bands >= 1.0, "guided_match.cell_half_size_bands must be at least 1", errors);
        require(
            self.epipole_clearance_bands >= 0.0,
            "guided_match.epipole_clearance_bands must not be negative",
            errors,
        );
        require(self.max_ratio > 0.0 && self.max_ratio <= 1.0, "guided_match.max_ratio must lie in (0, 1]", errors);
        let strict = self.distinctive_ratio > 0.0 && self.distinctive_ratio <= self.max_ratio;
        require(strict, "guided_match.distinctive_ratio must lie in (0, max_ratio]", errors);
        require(self.same_place_px >= 0.0, "guided_match.same_place_px must not be negative", errors);
        let scale = self.max_scale_discrepancy.is_none_or(|factor| factor >= 1.0);
        require(scale, "guided_match.max_scale_discrepancy must be at least 1", errors);
        let turn = self.max_orientation_discrepancy_deg.is_none_or(|angle| angle > 0.0);
        require(turn, "guided_match.max_orientation_discrepancy_deg must be positive", errors);
    }
}

/// How tracks become points (paper, section 6.3).
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TriangulationOptions {
    /// Largest distance of an observation from the projected point: scaled pixels.
    pub max_reprojection_error_px: f64,
    /// New points are made from at least this many observations.
    pub min_track_length: usize,
    /// Smallest of the largest angles between two rays of a point with three or more observations, in degrees.
    pub min_angle_deg: f64,
    /// The same for a point with two, in degrees.
    pub min_angle_two_view_deg: f64,
    /// Largest reprojection error of a point with two observations, whose matches nothing else confirms: scaled pixels.
    pub max_two_view_error_px: f64,
}

impl Default for TriangulationOptions {
    fn default() -> Self {
        Self {
            max_reprojection_error_px: 4.0,
            min_track_length: 2,
            min_angle_deg: 1.5,
            min_angle_two_view_deg: 2.0,
            max_two_view_error_px: 2.0,
        }
    }
}

impl TriangulationOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        let error = self.max_reprojection_error_px > 0.0 && self.max_two_view_error_px > 0.0;
        require(error, "triangulation: reprojection errors must be positive", errors);
        require(self.min_track_length >= 2, "triangulation.min_track_length must be at least 2", errors);
        let angles = [self.min_angle_deg, self.min_angle_two_view_deg];
        let sensible = angles.iter().all(|angle| (0.0..90.0).contains(angle));
        require(sensible, "triangulation: angles must lie between 0 and 90 degrees", errors);
    }
}

/// Lengths given in *scaled pixels* are meant for images with a long side of `reference_side_px`, and grow and shrink with
/// the image within limits: pose errors grow with the image, errors of keypoints do not.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PixelScaling {
    /// The long side, in pixels, at which a scaled pixel is a pixel.
    pub reference_side_px: f64,
    /// A scaled pixel is never less than this many pixels.
    pub at_least: f64,
    /// A scaled pixel is never more than this many pixels.
    pub at_most: f64,
}

impl Default for PixelScaling {
    fn default() -> Self {
        Self { reference_side_px: 3200.0, at_least: 0.5, at_most: 2.0 }
    }
}

impl PixelScaling {
    /// Pixels of the camera's images to a scaled pixel.
    pub fn factor(&self, camera: &Camera) -> f64 {
        let side = f64::from(camera.width.max(camera.height));
        (side / self.reference_side_px).clamp(self.at_least, self.at_most)
    }

    fn validate(&self, errors: &mut Vec<String>) {
        require(self.reference_side_px > 0.0, "pixel_scaling.reference_side_px must be positive", errors);
        let ordered = self.at_least > 0.0 && self.at_least <= self.at_most;
        require(ordered, "pixel_scaling: at_least must be positive and not above at_most", errors);
    }
}

/// Which memory the stage may use.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct BlockOptions {
    /// Pairs are worked through in tiles of this many images by as many (or as there are threads, if more): at most
    /// twice this many images' features (about 4 MB each) are in memory at a time. Smaller tiles read features more
    /// often: on 128 images of 17,000 features 8 takes 2 % more CPU time than 64, and 120 MB less.
    pub images_per_block: usize,
}

impl Default for BlockOptions {
    fn default() -> Self {
        Self { images_per_block: 8 }
    }
}

impl BlockOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        require(self.images_per_block >= 1, "blocks.images_per_block must be at least 1", errors);
    }
}
