//! COLMAP's sparse models, binary and text: `cameras`, `images` and `points3D`.
//!
//! Ids in the files count from 1: ours plus one. Quaternions are ordered w, x, y, z and turn world into camera, as ours do;
//! pixels have the centre of the first pixel at (0.5, 0.5), as ours have; so nothing is converted. An image lists all its
//! keypoints, those without a point too; cameras that no image uses are left out. A point's `error` is the mean reprojection
//! error of its sightings in pixels.
//!
//! Reference: <https://colmap.github.io/format.html>, "Sparse reconstruction".

mod binary;
mod model;
mod text;

pub use binary::{
    read_cameras_bin, read_images_bin, read_points3d_bin, write_cameras_bin, write_images_bin, write_points3d_bin,
};
pub use model::{ColmapImage, ColmapModel, ColmapPoint, ColmapPoint2d};
pub use text::{
    read_cameras_txt, read_images_txt, read_points3d_txt, write_cameras_txt, write_images_txt, write_points3d_txt,
};

use super::FormatError;
use crate::camera::{Camera, CameraModel, FocalSource, MAX_PARAMS};
use crate::geometry::Rigid3;
use crate::scene::{Point3d, Point3dId, Reconstruction};
use nalgebra::{Quaternion, UnitQuaternion, Vector3};

/// Every point in order of ids, with the mean reprojection error of its sightings in pixels.
fn points_with_mean_errors(model: &Reconstruction) -> impl Iterator<Item = (Point3dId, &Point3d, f64)> {
    let mut sums_px = vec![0.0; model.point_id_bound()];
    for &image in model.images().keys() {
        for (id, error_px) in model.errors_of_image_px(image) {
            sums_px[id.index()] += error_px;
        }
    }
    model.points().map(move |(id, point)| (id, point, sums_px[id.index()] / point.track.len() as f64))
}

/// A camera of a file's fields.
fn checked_camera(
    file: &'static str,
    model: CameraModel,
    [width, height]: [u64; 2],
    params: &[f64],
) -> Result<Camera, FormatError> {
    let side = |pixels: u64| {
        u32::try_from(pixels).map_err(|_| FormatError::malformed(file, format!("an image side of {pixels} pixels")))
    };
    if params.len() != model.num_params() || params.iter().any(|p| !p.is_finite()) {
        let message = format!("{} needs {} finite parameters", model.colmap_name(), model.num_params());
        return Err(FormatError::malformed(file, message));
    }
    let mut all = [0.0; MAX_PARAMS];
    all[..params.len()].copy_from_slice(params);
    Ok(Camera { model, width: side(width)?, height: side(height)?, params: all, focal_source: FocalSource::Estimated })
}

/// A pose of a file's fields: quaternion w, x, y, z and translation.
fn checked_pose(file: &'static str, fields: &[f64; 7]) -> Result<Rigid3, FormatError> {
    let quaternion = Quaternion::new(fields[0], fields[1], fields[2], fields[3]);
    // The norm of a file's quaternion is 1 up to rounding; anything far from it is no rotation.
    if fields.iter().any(|value| !value.is_finite()) || !(0.5..2.0).contains(&quaternion.norm()) {
        return Err(FormatError::malformed(file, "a pose is not a rotation and a translation"));
    }
    let translation = Vector3::new(fields[4], fields[5], fields[6]);
    Ok(Rigid3::new(UnitQuaternion::from_quaternion(quaternion), translation))
}
