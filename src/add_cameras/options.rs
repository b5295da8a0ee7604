//! Options of the stage.

use serde::{Deserialize, Serialize};

use crate::ransac::RansacOptions;
use crate::ransac::absolute_pose::AbsolutePoseOptions;

/// A way to find which features of an image see which points.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum LocalizationMethod {
    /// Active correspondence search through visual words, in both directions.
    ActiveSearch,
    /// 2D-2D matching with the localised images that share most coarse matches.
    RankedMatch,
    /// Every point's mean descriptor against every feature.
    DirectMatch,
}

/// How images are localised.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct AddCamerasOptions {
    /// The ways to find correspondences, in the order they are tried until one gives a pose.
    pub methods: Vec<LocalizationMethod>,
    /// Active search.
    pub active_search: ActiveSearchOptions,
    /// Ranked matching.
    pub ranked_match: RankedMatchOptions,
    /// Direct matching.
    pub direct_match: DirectMatchOptions,
    /// The visual words.
    pub vocabulary: VocabularyOptions,
    /// Reduction of large models.
    pub set_cover: SetCoverOptions,
    /// The pose and its acceptance.
    pub pose: PoseOptions,
}

impl Default for AddCamerasOptions {
    fn default() -> Self {
        use LocalizationMethod::{ActiveSearch, DirectMatch, RankedMatch};
        Self {
            methods: vec![ActiveSearch, RankedMatch, DirectMatch],
            active_search: ActiveSearchOptions::default(),
            ranked_match: RankedMatchOptions::default(),
            direct_match: DirectMatchOptions::default(),
            vocabulary: VocabularyOptions::default(),
            set_cover: SetCoverOptions::default(),
            pose: PoseOptions::default(),
        }
    }
}

impl AddCamerasOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if self.methods.is_empty() {
            errors.push("methods must name at least one way to find correspondences".to_owned());
        }
        self.active_search.validate(errors);
        self.ranked_match.validate(errors);
        self.direct_match.validate(errors);
        self.vocabulary.validate(errors);
        self.pose.validate(errors);
        if self.set_cover.points_per_camera == 0 {
            errors.push("points_per_camera must be at least 1".to_owned());
        }
    }
}

/// Adds a sentence when a ratio or a distance is out of range.
fn validate_descriptor_tests(ratios: &[(&str, f64)], max_distance: f64, errors: &mut Vec<String>) {
    for (name, ratio) in ratios {
        if !(*ratio > 0.0 && *ratio <= 1.0) {
            errors.push(format!("{name} is {ratio}, it must be above 0 and at most 1"));
        }
    }
    if !(max_distance > 0.0 && max_distance <= 2.0) {
        errors.push(format!("max_distance is {max_distance}, it must be above 0 and at most 2"));
    }
}

/// Active correspondence search.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ActiveSearchOptions {
    /// Largest ratio of distances from a feature to its nearest and second-nearest point. 0.7 in Sattler et al.
    pub ratio_2d_to_3d: f64,
    /// Largest ratio of distances from a point to its nearest and second-nearest feature. 0.6 in Sattler et al.
    pub ratio_3d_to_2d: f64,
    /// Largest distance of a match, as a multiple of a descriptor's length.
    pub max_distance: f64,
    /// The search ends with this many correspondences. Higher: slower, poses from more points. 100 in Sattler et al.
    pub enough_correspondences: usize,
    /// Around a point that was found, so many of its nearest points are looked for in the image. 200 in Sattler et al.
    pub neighbors_3d: usize,
}

impl Default for ActiveSearchOptions {
    fn default() -> Self {
        Self {
            ratio_2d_to_3d: 0.7,
            ratio_3d_to_2d: 0.6,
            max_distance: 0.7,
            enough_correspondences: 200,
            neighbors_3d: 200,
        }
    }
}

impl ActiveSearchOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        let ratios = [("ratio_2d_to_3d", self.ratio_2d_to_3d), ("ratio_3d_to_2d", self.ratio_3d_to_2d)];
        validate_descriptor_tests(&ratios, self.max_distance, errors);
        if self.enough_correspondences == 0 {
            errors.push("enough_correspondences must be at least 1".to_owned());
        }
    }
}

/// Ranked 2D-2D matching.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RankedMatchOptions {
    /// K: so many localised images of most coarse matches lend their features. Ours (the paper gives no number).
    pub images: usize,
    /// Largest ratio of distances from a proxy to its nearest and second-nearest feature among all of the image. Below
    /// Lowe's 0.8 because one side only is tested; the authors' program has 0.6.
    pub ratio: f64,
    /// Largest distance of a match, as a multiple of a descriptor's length.
    pub max_distance: f64,
    /// A feature must also be nearer to its proxy than to the other proxies of that image.
    pub cross_check: bool,
    /// Only more correspondences than this are worth a pose. 16 in the paper.
    pub more_than: usize,
}

impl Default for RankedMatchOptions {
    fn default() -> Self {
        Self { images: 20, ratio: 0.75, max_distance: 0.7, cross_check: true, more_than: 16 }
    }
}

impl RankedMatchOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        validate_descriptor_tests(&[("ratio", self.ratio)], self.max_distance, errors);
    }
}

/// Direct 3D-2D matching.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DirectMatchOptions {
    /// Largest ratio of distances from a point to its nearest and second-nearest feature.
    pub ratio: f64,
    /// Largest distance of a match, as a multiple of a descriptor's length.
    pub max_distance: f64,
    /// A feature must also be nearer to its point than to all other points.
    pub cross_check: bool,
}

impl Default for DirectMatchOptions {
    fn default() -> Self {
        Self { ratio: 0.75, max_distance: 0.7, cross_check: true }
    }
}

impl DirectMatchOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        validate_descriptor_tests(&[("ratio", self.ratio)], self.max_distance, errors);
    }
}

/// Training of the visual words.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct VocabularyOptions {
    /// One word for so many points of the model. Lower: shorter lists to search, more features miss their word.
    pub points_per_word: usize,
    /// Never more words than this. Their training and look-up costs grow with it; Sattler et al. take 100,000 for models
    /// of millions of points.
    pub max_words: usize,
    /// Words that share one word of the coarser level, which the 3D-to-2D search goes by. Higher: more features are
    /// compared with a point.
    pub words_per_coarse_word: usize,
    /// Rounds of k-means.
    pub iterations: usize,
}

impl Default for VocabularyOptions {
    fn default() -> Self {
        Self { points_per_word: 20, max_words: 5000, words_per_coarse_word: 20, iterations: 6 }
    }
}

impl VocabularyOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        for (name, value) in [
            ("points_per_word", self.points_per_word),
            ("max_words", self.max_words),
            ("words_per_coarse_word", self.words_per_coarse_word),
        ] {
            if value == 0 {
                errors.push(format!("{name} must be at least 1"));
            }
        }
    }
}

/// Reduction of large models.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SetCoverOptions {
    /// Models of more points than this are reduced. 100,000 in the paper.
    pub above_points: usize,
    /// k: every camera keeps so many points, where it sees so many. 300 to 500 in the paper.
    pub points_per_camera: usize,
}

impl Default for SetCoverOptions {
    fn default() -> Self {
        Self { above_points: 100_000, points_per_camera: 400 }
    }
}

/// The pose of a localised image.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseOptions {
    /// Fewer correspondences than this are not worth a try.
    pub min_correspondences: usize,
    /// A pose with fewer inliers is not accepted.
    pub min_inliers: usize,
    /// A pose with a smaller share of inliers among the correspondences is not accepted.
    pub min_inlier_ratio: f64,
    /// RANSAC and refinement. Its own bounds on inliers do not matter here.
    pub estimation: AbsolutePoseOptions,
    /// Inliers with a larger reprojection error, in pixels, do not enter the tracks.
    pub max_track_error_px: f64,
}

impl Default for PoseOptions {
    fn default() -> Self {
        let estimation = AbsolutePoseOptions {
            ransac: RansacOptions { min_inlier_ratio: 0.1, ..AbsolutePoseOptions::default().ransac },
            ..AbsolutePoseOptions::default()
        };
        Self { min_correspondences: 12, min_inliers: 16, min_inlier_ratio: 0.2, estimation, max_track_error_px: 4.0 }
    }
}

impl PoseOptions {
    fn validate(&self, errors: &mut Vec<String>) {
        self.estimation.validate(errors);
        if self.min_inliers < 6 {
            errors.push(format!("min_inliers is {}, it must be at least 6", self.min_inliers));
        }
        if !(0.0..=1.0).contains(&self.min_inlier_ratio) {
            errors.push(format!("min_inlier_ratio is {}, it must be between 0 and 1", self.min_inlier_ratio));
        }
        if !(self.max_track_error_px > 0.0 && self.max_track_error_px.is_finite()) {
            errors.push(format!("max_track_error_px is {}, it must be positive", self.max_track_error_px));
        }
    }
}
