//! What can be set about feature extraction.

use serde::{Deserialize, Serialize};

/// Options of [`super::extract`].
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SiftOptions {
    /// First octave: -1 doubles the image first (more and smaller features, about four times the time), 0 does not.
    /// Origin: Lowe 2004, section 3.3.
    pub first_octave: i32,
    /// Levels per octave in which extrema are sought; more give more, less distinct features. Origin: Lowe 2004, section 3.2.
    pub levels_per_octave: usize,
    /// Least absolute difference of Gaussians at a refined extremum that is distinct, for grey values in [0, 1]; raising it
    /// drops features of low contrast. Origin: measured; COLMAP has 0.0067. Where there are more features than are kept, 0.005
    /// gives a tenth more points than 0.0018 at a lower reprojection error.
    pub peak_threshold: f32,
    /// Least of a faint one; at most `peak_threshold`. Origin: measured. Guided matching and the ratio test leave out what does
    /// not repeat, so that 0.0018 gives dark and smooth images a third more points.
    pub faint_threshold: f32,
    /// Faint features are only taken, those of the largest scales, by images that have fewer distinct ones than this,
    /// to make up this number. Lowering it saves time on images of little texture and costs them points.
    pub faint_up_to: usize,
    /// Largest ratio of the two principal curvatures; lowering it drops more edge responses. Origin: measured; Lowe 2004,
    /// section 4.1, has 10.
    pub edge_threshold: f32,
    /// Most orientations, hence features, per extremum. Origin: COLMAP.
    pub max_orientations: usize,
    /// Most features kept, those of the largest scales; time and points of a model grow with it. Origin: the paper's images
    /// have 9K to 39K.
    pub max_features: usize,
    /// Most features kept per million pixels: beyond, more of them cost time without describing more of the object. Origin:
    /// measured, twice the points of COLMAP's 8192 features at 1 to 6 megapixels; South Building, all brick and leaves, needs
    /// 16,000 for that and has 1.5 times as many at 11,000.
    pub max_features_per_megapixel: usize,
    /// Small images keep as many features as this, whatever their size.
    pub small_image_features: usize,
    /// Gaussian sigma of the first level of an octave, in its own pixels; lowering it finds smaller, more features. Origin:
    /// measured; Lowe 2004, section 3.3, has 1.6. 1.2 gives twice the features of small images at a lower reprojection error,
    /// and shorter filters.
    pub sigma0: f32,
    /// Gaussian sigma that the camera's own blur is taken for, in original pixels. Origin: measured; Lowe 2004, section 3.3,
    /// has 0.5, but reduced photographs are sharper.
    pub camera_sigma_px: f32,
}

impl Default for SiftOptions {
    fn default() -> Self {
        Self {
            first_octave: -1,
            levels_per_octave: 3,
            peak_threshold: 0.005,
            faint_threshold: 0.0018,
            faint_up_to: 9000,
            edge_threshold: 15.0,
            max_orientations: 2,
            max_features: 26_624,
            max_features_per_megapixel: 16_000,
            small_image_features: 12_000,
            sigma0: 1.2,
            camera_sigma_px: 0.25,
        }
    }
}

impl SiftOptions {
    /// Most features kept of an image of so many pixels.
    pub fn limit(&self, width: usize, height: usize) -> usize {
        let by_area = (width * height).saturating_mul(self.max_features_per_megapixel) / 1_000_000;
        by_area.max(self.small_image_features).min(self.max_features)
    }

    /// Adds a sentence to `errors` for every value out of its range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |holds: bool, message: &str| {
            if !holds {
                errors.push(message.to_owned());
            }
        };
        check((-1..=0).contains(&self.first_octave), "features.first_octave must be -1 or 0");
        check((1..=8).contains(&self.levels_per_octave), "features.levels_per_octave must be 1 to 8");
        check(self.peak_threshold >= 0.0 && self.peak_threshold < 1.0, "features.peak_threshold must be in [0, 1)");
        check(
            self.faint_threshold >= 0.0 && self.faint_threshold <= self.peak_threshold,
            "features.faint_threshold must be 0 to peak_threshold",
        );
        check(self.edge_threshold >= 1.0, "features.edge_threshold must be at least 1");
        check((1..=8).contains(&self.max_orientations), "features.max_orientations must be 1 to 8");
        check(self.max_features >= 1, "features.max_features must be at least 1");
        check((0.8..=4.0).contains(&self.sigma0), "features.sigma0 must be 0.8 to 4");
        check(
            self.camera_sigma_px >= 0.0 && self.camera_sigma_px <= 0.375 * self.sigma0,
            "features.camera_sigma_px must be 0 to 0.375 sigma0",
        );
    }
}
