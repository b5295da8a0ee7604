//! Camera poses of other origins: plain lists, Strecha's `*.camera` files, VisualSFM's NVM.
//!
//! All give `cam_from_world` with the camera's x to the right, y down, z forward.

use std::collections::BTreeMap;
use std::io::BufRead;

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};

use super::FormatError;
use crate::geometry::Rigid3;

/// Reads a list of lines `image qw qx qy qz cx cy cz`: the rotation is `cam_from_world`, c the camera centre in the world.
/// Lines that start with `#` are comments.
///
/// # Errors
/// When a line is not of that form.
pub fn read_pose_list(input: &mut impl BufRead) -> Result<BTreeMap<String, Rigid3>, FormatError> {
    const FILE: &str = "pose list";
    let mut poses = BTreeMap::new();
    for (number, line) in (1..).zip(input.lines()) {
        let line = line?;
        if line.trim().is_empty() || line.starts_with('#') {
            continue;
        }
        let mut fields = line.split_whitespace();
        let name = fields.next().unwrap_or_default().to_owned();
        let values = numbers(fields).unwrap_or_default();
        let pose = values.first_chunk::<7>().and_then(pose_of_quaternion_and_center);
        let pose = pose.ok_or_else(|| FormatError::malformed(FILE, format!("line {number} is no pose")))?;
        poses.insert(name, pose);
    }
    Ok(poses)
}

/// Reads a `*.camera` file (Strecha et al., "On benchmarking camera calibration and multi-view stereo", CVPR 2008): K, the
/// distortion, the rotation `world_from_cam`, the camera centre, and the image size.
///
/// # Errors
/// When it is not of that form.
pub fn read_strecha_camera(input: &mut impl BufRead) -> Result<Rigid3, FormatError> {
    let mut text = String::new();
    input.read_to_string(&mut text)?;
    let values = numbers(text.split_whitespace()).unwrap_or_default();
    // 9 numbers of K and 3 of the distortion come first.
    let (Some(rotation), Some(center)) = (values.get(12..21), values.get(21..24)) else {
        return Err(FormatError::malformed("*.camera", "it needs 24 numbers at least"));
    };
    let world_from_cam = Matrix3::from_row_slice(rotation);
    let rotation = Rigid3::from_matrix(&world_from_cam.transpose(), Vector3::zeros()).rotation;
    Ok(Rigid3::from_center(rotation, &Vector3::from_column_slice(center)))
}

/// Reads the cameras of the first model of an NVM file (Wu, "VisualSFM"): after a header line and their number, a line each
/// with `image focal qw qx qy qz cx cy cz k 0`.
///
/// # Errors
/// When it is not of that form.
pub fn read_nvm_poses(input: &mut impl BufRead) -> Result<BTreeMap<String, Rigid3>, FormatError> {
    const FILE: &str = "NVM";
    let mut lines = input.lines().filter(|line| !line.as_ref().is_ok_and(|line| line.trim().is_empty()));
    let mut next = || lines.next().transpose()?.ok_or_else(|| FormatError::malformed(FILE, "the file is cut short"));
    if !next()?.starts_with("NVM_V3") {
        return Err(FormatError::malformed(FILE, "it does not start with NVM_V3"));
    }
    let count: usize =
        next()?.trim().parse().map_err(|_| FormatError::malformed(FILE, "the number of cameras is missing"))?;
    let mut poses = BTreeMap::new();
    for _ in 0..count {
        let line = next()?;
        let mut fields = line.split_whitespace();
        let name = fields.next().unwrap_or_default().to_owned();
        let values = numbers(fields).unwrap_or_default();
        let pose = values.get(1..).and_then(|rest| rest.first_chunk::<7>()).and_then(pose_of_quaternion_and_center);
        poses.insert(name, pose.ok_or_else(|| FormatError::malformed(FILE, "a camera is no pose"))?);
    }
    Ok(poses)
}

fn numbers<'a>(fields: impl Iterator<Item = &'a str>) -> Option<Vec<f64>> {
    fields.map(|field| field.parse().ok()).collect()
}

/// From w, x, y, z of the rotation (of any length but 0) and the centre.
fn pose_of_quaternion_and_center(values: &[f64; 7]) -> Option<Rigid3> {
    let [w, x, y, z, center @ ..] = values;
    let quaternion = Quaternion::new(*w, *x, *y, *z);
    let rotation = UnitQuaternion::try_new(quaternion, f64::MIN_POSITIVE)?;
    values.iter().all(|v| v.is_finite()).then(|| Rigid3::from_center(rotation, &Vector3::from_column_slice(center)))
}
