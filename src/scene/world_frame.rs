//! A world frame people can use: the model levelled with +z up, centred at the median camera, of a fixed extent.
//!
//! Scale stays arbitrary: nothing in photographs fixes it. Up is told by the cameras. Photographers hold the horizon level,
//! so the direction most nearly orthogonal to all image x axes (or y axes, for a picture turned on its side, which the EXIF
//! orientation tells) is the vertical; its sign is that of the mean of the pictures' up directions.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, UnitQuaternion, Vector3};

use super::{ImageId, Reconstruction};
use crate::geometry::Rigid3;

/// Extent the cameras are scaled to (COLMAP's value).
const CAMERA_EXTENT: f64 = 10.0;
/// Share of the cameras the extent is measured over, so that a stray one does not decide it.
const EXTENT_QUANTILE: f64 = 0.9;
/// The cameras' x axes must leave a direction this much emptier than the next for it to be trusted as the vertical: below,
/// they all point one way and the mean up direction is the better guess.
const MIN_EMPTINESS: f64 = 0.2;

/// Levels, centres and scales a model in place. `orientation` holds the EXIF orientation of the images that have one.
pub fn level(model: &mut Reconstruction, orientation: &BTreeMap<ImageId, u8>) {
    if model.images().is_empty() {
        return;
    }
    let up = up_in_world(model, orientation);
    let level_from_world = UnitQuaternion::rotation_between(&up, &Vector3::z())
        .unwrap_or_else(|| UnitQuaternion::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
    let centers: Vec<Vector3<f64>> = model.images().values().map(|image| image.center_in_world()).collect();
    let leveled: Vec<Vector3<f64>> = centers.iter().map(|center| level_from_world * center).collect();
    let middle = Vector3::from_fn(|axis, _| median(leveled.iter().map(|center| center[axis]).collect()));
    let center = level_from_world.inverse() * middle;
    let mut distances: Vec<f64> = centers.iter().map(|other| (other - center).norm()).collect();
    distances.sort_by(f64::total_cmp);
    let extent = distances[((distances.len() - 1) as f64 * EXTENT_QUANTILE) as usize];
    let scale = if extent > 0.0 { CAMERA_EXTENT / (2.0 * extent) } else { 1.0 };
    transform(model, scale, &level_from_world, &center);
}

/// `x' = scale * rotation * (x - center)` for every point and camera.
fn transform(model: &mut Reconstruction, scale: f64, rotation: &UnitQuaternion<f64>, center: &Vector3<f64>) {
    let moved = |x: &Vector3<f64>| rotation * (x - center) * scale;
    let poses: Vec<(ImageId, Rigid3)> = model
        .images()
        .iter()
        .map(|(&id, image)| {
            let cam_from_level = image.cam_from_world.rotation * rotation.inverse();
            (id, Rigid3::from_center(cam_from_level, &moved(&image.center_in_world())))
        })
        .collect();
    for (id, pose) in poses {
        model.set_pose(id, pose);
    }
    let points: Vec<_> = model.points().map(|(id, point)| (id, moved(&point.xyz))).collect();
    for (id, xyz) in points {
        model.set_xyz(id, xyz);
    }
}

/// The directions of a picture's horizontal and of its top, in its camera frame, for an EXIF orientation.
fn right_and_top(orientation: u8) -> (Vector3<f64>, Vector3<f64>) {
    match orientation {
        3 | 4 => (-Vector3::x(), Vector3::y()),
        5 | 6 => (-Vector3::y(), -Vector3::x()),
        7 | 8 => (Vector3::y(), Vector3::x()),
        _ => (Vector3::x(), -Vector3::y()),
    }
}

fn up_in_world(model: &Reconstruction, orientation: &BTreeMap<ImageId, u8>) -> Vector3<f64> {
    let mut spread = Matrix3::zeros();
    let mut mean_top = Vector3::zeros();
    for (id, image) in model.images() {
        let world_from_cam = image.cam_from_world.rotation.inverse();
        let (right, top) = right_and_top(orientation.get(id).copied().unwrap_or(1));
        let right_in_world = world_from_cam * right;
        spread += right_in_world * right_in_world.transpose();
        mean_top += world_from_cam * top;
    }
    let eigen = spread.symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    let vertical: Vector3<f64> = eigen.eigenvectors.column(order[0]).into();
    let emptiness = (eigen.eigenvalues[order[1]] - eigen.eigenvalues[order[0]]) / model.images().len() as f64;
    let up = if emptiness > MIN_EMPTINESS * MIN_EMPTINESS {
        if vertical.dot(&mean_top) < 0.0 { -vertical } else { vertical }
    } else {
        mean_top
    };
    up.try_normalize(f64::EPSILON).unwrap_or_else(Vector3::z)
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{Camera, CameraModel, FocalSource};
    use crate::scene::CameraId;

    #[test]
    fn a_ring_of_level_cameras_ends_level() {
        let camera = Camera::centered(CameraModel::SimpleRadial, 100, 100, 100.0, FocalSource::Guess);
        let mut model = Reconstruction::new(BTreeMap::from([(CameraId(0), camera)]));
        let tilt = UnitQuaternion::from_scaled_axis(Vector3::new(0.7, -0.4, 0.3));
        for k in 0..8u32 {
            let angle = f64::from(k) * std::f64::consts::FRAC_PI_4;
            let center = Vector3::new(3.0 * angle.cos(), 3.0 * angle.sin(), 1.0);
            let forward = -Vector3::new(angle.cos(), angle.sin(), 0.2 * f64::from(k % 2)).normalize();
            let right = forward.cross(&Vector3::z()).normalize();
            let down = forward.cross(&right);
            let rotation = Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
            let pose = Rigid3::from_matrix(&rotation, -(rotation * center));
            let tilted = pose.compose(&Rigid3::new(tilt, Vector3::new(5.0, 1.0, 2.0)));
            model.register(ImageId(k), CameraId(0), tilted, Vec::new().into());
        }
        level(&mut model, &BTreeMap::new());
        for image in model.images().values() {
            let top = image.cam_from_world.rotation.inverse() * -Vector3::y();
            assert!(top.z > 0.9, "the top of every picture points up: {top}");
            assert!(image.center_in_world().z.abs() < 1e-6, "all cameras are at one height");
        }
    }
}
