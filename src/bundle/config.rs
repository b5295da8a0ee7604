//! What a bundle adjustment may change.

use std::collections::{BTreeMap, BTreeSet};

use crate::camera::FocalSource;
use crate::scene::{CameraId, ImageId, Point3dId, Reconstruction};

/// Which images, points and intrinsics take part, and which of them may change.
///
/// All sightings of the chosen points count, those of images not named here with their poses held.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct BundleConfig {
    /// Images whose poses may change.
    pub variable_images: BTreeSet<ImageId>,
    /// Points that take part.
    pub points: PointSelection,
    /// Points that take part but stay where they are; only those that `points` chooses matter.
    pub constant_points: BTreeSet<Point3dId>,
    /// The intrinsics that may change; cameras not named stay as they are.
    pub intrinsics: BTreeMap<CameraId, FreeIntrinsics>,
    /// What pulls focal lengths towards values known beforehand.
    pub focal_priors: BTreeMap<CameraId, FocalPrior>,
    /// How position, rotation and scale of the whole are held.
    pub gauge: Gauge,
}

/// The points that take part.
#[derive(Clone, Debug, Default, PartialEq)]
pub enum PointSelection {
    /// All that a variable image sees.
    #[default]
    SeenByVariableImages,
    /// These, as far as they exist.
    Only(BTreeSet<Point3dId>),
}

/// Which intrinsics of a camera may change.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct FreeIntrinsics {
    /// Focal length, or both.
    pub focal: bool,
    /// All distortion coefficients the model has.
    pub distortion: bool,
    /// The principal point; weakly held by [`super::BundleOptions::principal_point_sigma`].
    pub principal_point: bool,
}

/// A Gaussian prior on the logarithm of a focal length: `ln f ~ N(ln focal_px, sigma_log^2)`, so that factors count.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalPrior {
    /// The focal length expected, in pixels.
    pub focal_px: f64,
    /// Standard deviation of the logarithm: 0.1 is about 10 %. It weighs against reprojection errors of one pixel.
    pub sigma_log: f64,
}

/// How the seven degrees of freedom that no sighting determines are held.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Gauge {
    /// Leaves it to the damping: the model may drift a little as a whole. Measured on 360 perturbed scenes of 3 to 10 images:
    /// more of them reach the minimum than when two images are held, in fewer steps.
    #[default]
    Free,
    /// If fewer than two poses are constant: holds the pose of the variable image with the most sightings (unless one pose
    /// is constant) and one coordinate of the translation of the image farthest from it, which fixes the scale.
    TwoImages,
}

impl FreeIntrinsics {
    /// Focal length and distortion.
    pub const FOCAL_AND_DISTORTION: Self = Self { focal: true, distortion: true, principal_point: false };
    /// Everything.
    pub const ALL: Self = Self { focal: true, distortion: true, principal_point: true };
}

impl BundleConfig {
    /// Everything may change: all poses, all points, and of every camera what `free` says (but no focal length that is
    /// [`FocalSource::Known`]).
    pub fn global(model: &Reconstruction, free: FreeIntrinsics) -> Self {
        let intrinsics = model.cameras.iter().map(|(&id, camera)| {
            (id, FreeIntrinsics { focal: free.focal && camera.focal_source != FocalSource::Known, ..free })
        });
        Self {
            variable_images: model.images().keys().copied().collect(),
            intrinsics: intrinsics.collect(),
            ..Self::default()
        }
    }

    /// Only these poses and the points they see may change; all other images hold the frame.
    pub fn local(variable_images: impl IntoIterator<Item = ImageId>) -> Self {
        Self { variable_images: variable_images.into_iter().collect(), ..Self::default() }
    }
}
