//! Which intrinsics the photographs can tell.
//!
//! A focal length needs a few images; a principal point needs many that share the camera (a shift of the principal point and
//! a small rotation look alike in one image); distortion comes between. What can't be told stays at its prior.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::bundle::{FocalPrior, FreeIntrinsics};
use crate::camera::{Camera, CameraModel, FocalSource, TYPICAL_FOCAL};
use crate::scene::{CameraId, ImageId, Reconstruction};

/// How many images sharing a camera it takes to free its parameters.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct IntrinsicsOptions {
    /// Images in the model before any focal length is freed; two views leave it badly determined.
    pub min_model_images_for_focal: usize,
    /// Images in the model before distortion is freed.
    pub min_model_images_for_distortion: usize,
    /// Whether the principal point is estimated or held in the middle of the picture.
    pub principal_point: PrincipalPoint,
    /// Images sharing a camera before its principal point is freed. Measured on sets of four to seven surveyed
    /// photographs, freeing it raises the AUC at 1 degree from 65 to 91 (own focal lengths for all, as COLMAP has them:
    /// 81); with three it may go astray.
    pub min_images_for_principal_point: usize,
    /// Images sharing a camera before it gets two radial coefficients.
    pub min_images_for_radial: usize,
    /// Images sharing a camera before it gets two focal lengths and tangential distortion as well; null never. Tangential
    /// distortion and a shift of the principal point look alike, so freeing both leaves neither right: measured on eleven
    /// surveyed photographs without distortion, the principal point is 1.4 pixels off without it and 4.6 with it.
    pub min_images_for_opencv: Option<usize>,
    /// Whether intrinsics are refined at all (known ones never are).
    pub refine: bool,
    /// The focal length that photographs without EXIF are expected to have, as a share of the longer side: [`TYPICAL_FOCAL`].
    pub typical_focal: f64,
    /// Standard deviation of its logarithm; null leaves such focal lengths without a prior. It covers wide lenses and
    /// short telephotos, and weighs no more than one sighting, so it decides only where the sightings leave a focal
    /// length open: of nine runs on a street of 29 photographs without EXIF, four ended at 20 to 12,000 times the
    /// longer side without it, and none of eight beyond 7 with it.
    pub typical_focal_sigma_log: Option<f64>,
    /// Share up to which the focal lengths of two cameras of one image size, neither from EXIF, agree: they are one camera.
    pub agreeing_focal_difference: f64,
}

/// Where the principal point is.
///
/// In one picture a shift of the principal point looks like a small rotation; a few pictures that share the camera tell them
/// apart. Programs that hold it in the middle (COLMAP, Bundler) turn every camera by `offset / focal` instead: measured on
/// surveyed photographs, estimating it turns 0.48 degrees of rotation error into 0.06.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PrincipalPoint {
    /// Estimated for cameras whose pictures carry no EXIF focal length and may be crops; held in the middle for the others,
    /// which are whole, and the axis of a lens meets the sensor near its middle.
    #[default]
    Auto,
    /// Estimated for every camera with enough pictures.
    Estimated,
    /// Held in the middle, to agree with programs that do so.
    Middle,
}

impl PrincipalPoint {
    /// Whether a camera whose focal length is known from there gets its principal point estimated.
    fn is_estimated(self, focal_source: FocalSource) -> bool {
        match self {
            Self::Auto => focal_source != FocalSource::Exif,
            Self::Estimated => true,
            Self::Middle => false,
        }
    }
}

impl Default for IntrinsicsOptions {
    fn default() -> Self {
        Self {
            min_model_images_for_focal: 3,
            min_model_images_for_distortion: 4,
            principal_point: PrincipalPoint::Auto,
            min_images_for_principal_point: 4,
            min_images_for_radial: 4,
            min_images_for_opencv: None,
            refine: true,
            typical_focal: TYPICAL_FOCAL,
            typical_focal_sigma_log: Some(0.5),
            agreeing_focal_difference: 0.04,
        }
    }
}

/// The parameters to free of every camera a model uses.
pub fn free_intrinsics(model: &Reconstruction, options: &IntrinsicsOptions) -> BTreeMap<CameraId, FreeIntrinsics> {
    let images = model.images().len();
    let free = |id: CameraId, sharing: usize| {
        if !options.refine || model.cameras[&id].focal_source == FocalSource::Known {
            return FreeIntrinsics::default();
        }
        FreeIntrinsics {
            focal: images >= options.min_model_images_for_focal,
            distortion: images >= options.min_model_images_for_distortion,
            principal_point: sharing >= options.min_images_for_principal_point
                && options.principal_point.is_estimated(model.cameras[&id].focal_source),
        }
    };
    sharing(model).into_iter().map(|(id, sharing)| (id, free(id, sharing))).collect()
}

/// What the focal lengths that nothing but the photographs told are expected to be.
pub fn focal_priors(model: &Reconstruction, options: &IntrinsicsOptions) -> BTreeMap<CameraId, FocalPrior> {
    let Some(sigma_log) = options.typical_focal_sigma_log else { return BTreeMap::new() };
    let told = model.cameras.iter().filter(|(_, camera)| camera.focal_source.is_told_by_photographs());
    let prior = |camera: &Camera| {
        let focal_px = options.typical_focal * f64::from(camera.width.max(camera.height));
        FocalPrior { focal_px, sigma_log }
    };
    told.map(|(&id, camera)| (id, prior(camera))).collect()
}

/// The cameras that an image of the group `group` may share, in id order: the group's own, and, where no EXIF told it, all of
/// its size that images were split off to. Only cameras in use.
pub fn cameras_to_share(model: &Reconstruction, group: CameraId, given: &Camera) -> Vec<CameraId> {
    let told = given.focal_source.is_told_by_photographs();
    let fits = |id: &CameraId| {
        let camera = &model.cameras[id];
        *id == group || (told && camera.has_size_of(given) && camera.focal_source.is_told_by_photographs())
    };
    sharing(model).into_keys().filter(fits).collect()
}

/// Adds a camera to a model and returns its id, which is new.
pub fn add_camera(model: &mut Reconstruction, camera: Camera) -> CameraId {
    let id = model.cameras.last_key_value().map_or(CameraId(0), |(last, _)| CameraId(last.0 + 1));
    model.cameras.insert(id, camera);
    id
}

/// Makes cameras of one size whose focal lengths agree, and that no EXIF told, into one: that of most images. Returns how many
/// cameras went.
pub fn merge_agreeing_cameras(model: &mut Reconstruction, options: &IntrinsicsOptions) -> usize {
    let mut uses: Vec<(CameraId, usize)> = sharing(model).into_iter().collect();
    uses.sort_by_key(|&(id, images)| (std::cmp::Reverse(images), id));
    let mut kept: Vec<CameraId> = Vec::new();
    let mut merged = 0;
    for (id, _) in uses {
        let camera = &model.cameras[&id];
        let agrees = |other: &&CameraId| {
            let other = &model.cameras[*other];
            other.has_size_of(camera)
                && other.focal_source.is_told_by_photographs()
                && camera.focal_source.is_told_by_photographs()
                && (other.mean_focal_px() / camera.mean_focal_px()).ln().abs()
                    <= options.agreeing_focal_difference.ln_1p()
        };
        let Some(&into) = kept.iter().find(agrees) else {
            kept.push(id);
            continue;
        };
        let users: Vec<ImageId> =
            model.images().iter().filter(|(_, image)| image.camera == id).map(|(&image, _)| image).collect();
        for image in users {
            model.set_camera(image, into);
        }
        merged += 1;
    }
    merged
}

/// How many images of a model use each camera.
fn sharing(model: &Reconstruction) -> BTreeMap<CameraId, usize> {
    let mut sharing = BTreeMap::new();
    for image in model.images().values() {
        *sharing.entry(image.camera).or_insert(0) += 1;
    }
    sharing
}

/// Gives every camera of a model as rich a camera model as its images determine.
pub fn enrich_cameras(model: &mut Reconstruction, options: &IntrinsicsOptions) {
    let sharing = sharing(model);
    for (id, camera) in &mut model.cameras {
        let richest = richest_model(sharing.get(id).copied().unwrap_or(0), options);
        if camera.focal_source != FocalSource::Known && richest > camera.model {
            *camera = camera.with_model(richest);
        }
    }
}

/// The model that as many images determine.
fn richest_model(sharing: usize, options: &IntrinsicsOptions) -> CameraModel {
    if options.min_images_for_opencv.is_some_and(|enough| sharing >= enough) {
        CameraModel::OpenCv
    } else if sharing >= options.min_images_for_radial {
        CameraModel::Radial
    } else {
        CameraModel::SimpleRadial
    }
}
