//! Bundler's `bundle.out` (version 0.3) and `list.txt`.
//!
//! Frames: Bundler's camera looks along -z with y up, so with `D = diag(1, -1, -1)` its rotation and translation are `D R` and
//! `D t` of ours. It projects `P = R X + t` as
//!
//!   p = -(P.x, P.y) / P.z,    p' = f (1 + k1 |p|^2 + k2 |p|^4) p
//!
//! in pixels from the image centre, x to the right and y up.
//!
//! **What is written as a measured position.** Bundler's camera has one focal length, two radial coefficients, and its
//! principal point in the middle of the image. Our cameras may have the principal point elsewhere, two focal lengths
//! and tangential distortion. Therefore the position of a sighting is written as `p' + e`, the projection by the
//! Bundler camera in the file plus our residual `e = keypoint - projection` (its y turned up). A reader of the file
//! alone thus finds our reprojection errors exactly. For a camera without tangential distortion and with one focal
//! length, `f, k1, k2` are our own, and `p' + e` is the keypoint as seen from the principal point: the plain Bundler
//! convention wherever that is the image centre. For other cameras `f, k1, k2` are those that come nearest to our
//! projection over the whole image, by least squares.
//!
//! Reference: Snavely, "Bundler v0.4 User's Manual", 2009, section "Output format and scene representation".

use std::collections::BTreeMap;
use std::io::{self, BufRead, Write};

use nalgebra::{Matrix3, Vector2, Vector3};

use super::FormatError;
use super::shortest::Shortest;
use crate::camera::{Camera, CameraModel, Pixel};
use crate::geometry::Rigid3;
use crate::scene::{ImageId, Observation, Point3d, Reconstruction};

/// The intrinsics a Bundler camera has.
#[derive(Clone, Copy, Debug, PartialEq)]
struct BundlerCamera {
    focal_px: f64,
    k1: f64,
    k2: f64,
}

/// A fit samples the image at a grid of this many positions a side.
const FIT_SAMPLES_PER_SIDE: u32 = 12;

impl BundlerCamera {
    /// The same camera where it can be, else the nearest over the image.
    fn nearest(camera: &Camera) -> Self {
        match camera.model {
            CameraModel::SimplePinhole | CameraModel::SimpleRadial | CameraModel::Radial => {
                let [k1, k2, ..] = camera.distortion();
                Self { focal_px: camera.mean_focal_px(), k1, k2 }
            }
            CameraModel::Pinhole | CameraModel::OpenCv => Self::fit(camera),
        }
    }

    /// `p'` is linear in `a = (f, f k1, f k2)`: it is `p (1, |p|^2, |p|^4) . a`. Least squares against our projection, seen
    /// from the principal point.
    fn fit(camera: &Camera) -> Self {
        let (mut normal, mut right) = (Matrix3::zeros(), Vector3::zeros());
        let center = camera.principal_point().0;
        for row in 0..=FIT_SAMPLES_PER_SIDE {
            for column in 0..=FIT_SAMPLES_PER_SIDE {
                let part = |k: u32, side: u32| f64::from(k) / f64::from(FIT_SAMPLES_PER_SIDE) * f64::from(side);
                let at = camera.unproject(&Pixel::new(part(column, camera.width), part(row, camera.height)));
                // Where the distortion can't be inverted, the projection says what the position really shows.
                let target = camera.project_normalized(&at).0 - center;
                let radius_sq = at.0.norm_squared();
                let powers = Vector3::new(1.0, radius_sq, radius_sq * radius_sq);
                normal += radius_sq * powers * powers.transpose();
                right += powers * at.0.dot(&target);
            }
        }
        match normal.lu().solve(&right) {
            Some(a) if a.iter().all(|v| v.is_finite()) && a[0] > 0.0 => {
                Self { focal_px: a[0], k1: a[1] / a[0], k2: a[2] / a[0] }
            }
            _ => Self { focal_px: camera.mean_focal_px(), k1: 0.0, k2: 0.0 },
        }
    }

    /// `p'` of a point in our camera frame, y up.
    fn project(&self, x_in_cam: &Vector3<f64>) -> Vector2<f64> {
        let p = Vector2::new(x_in_cam.x / x_in_cam.z, -x_in_cam.y / x_in_cam.z);
        let radius_sq = p.norm_squared();
        self.focal_px * (1.0 + radius_sq * (self.k1 + self.k2 * radius_sq)) * p
    }
}

/// Our camera frame to Bundler's, or back.
fn turned(values: &Vector3<f64>) -> Vector3<f64> {
    Vector3::new(values.x, -values.y, -values.z)
}

/// Writes `bundle.out`: the registered images in the order of [`write_list`], and all points.
///
/// # Errors
/// When writing fails.
pub fn write_bundle(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "# Bundle file v0.3")?;
    writeln!(out, "{} {}", model.images().len(), model.num_points())?;
    let mut cameras = BTreeMap::new();
    for (rank, (&id, image)) in model.images().iter().enumerate() {
        let camera = BundlerCamera::nearest(model.camera_of(id));
        cameras.insert(id, (rank, camera));
        writeln!(out, "{} {} {}", Shortest(camera.focal_px), Shortest(camera.k1), Shortest(camera.k2))?;
        let rotation = image.cam_from_world.rotation_matrix();
        let rows = [0, 1, 2].map(|row| if row == 0 { rotation.row(row).into_owned() } else { -rotation.row(row) });
        for row in rows {
            writeln!(out, "{} {} {}", Shortest(row[0]), Shortest(row[1]), Shortest(row[2]))?;
        }
        let t = turned(&image.cam_from_world.translation);
        writeln!(out, "{} {} {}", Shortest(t.x), Shortest(t.y), Shortest(t.z))?;
    }
    for (_, point) in model.points() {
        let (xyz, [r, g, b]) = (point.xyz, point.color);
        writeln!(out, "{} {} {}\n{r} {g} {b}", Shortest(xyz.x), Shortest(xyz.y), Shortest(xyz.z))?;
        write!(out, "{}", point.track.len())?;
        for seen in &point.track {
            let (rank, camera) = &cameras[&seen.image];
            let at = measured(model, camera, point, *seen);
            write!(out, " {rank} {} {} {}", seen.keypoint.0, Shortest(at.x), Shortest(at.y))?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// The position to write for a sighting (see the head of this module).
fn measured(model: &Reconstruction, camera: &BundlerCamera, point: &Point3d, seen: Observation) -> Vector2<f64> {
    let image = &model.images()[&seen.image];
    let ours = model.camera_of(seen.image);
    let keypoint = image.keypoints[seen.keypoint.index()].0;
    let x_in_cam = image.cam_from_world.apply(&point.xyz);
    match ours.project(&x_in_cam) {
        Some(projected) => {
            let residual = keypoint - projected.0;
            camera.project(&x_in_cam) + Vector2::new(residual.x, -residual.y)
        }
        // A point behind the camera has no residual: its plain position, from the principal point.
        None => {
            let offset = keypoint - ours.principal_point().0;
            Vector2::new(offset.x, -offset.y)
        }
    }
}

/// Writes `list.txt`: the name of each registered image, in id order.
///
/// # Errors
/// When writing fails, or a name holds a line break.
pub fn write_list<'a>(
    model: &Reconstruction,
    name_of: impl Fn(ImageId) -> &'a str,
    out: &mut impl Write,
) -> io::Result<()> {
    for &id in model.images().keys() {
        let name = name_of(id);
        if name.contains(['\n', '\r']) {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "an image name holds a line break"));
        }
        writeln!(out, "{name}")?;
    }
    Ok(())
}

const BUNDLE: &str = "bundle.out";

/// Reads the poses of a `bundle.out`, as `cam_from_world` in our frame; none for an image that is not registered (its focal
/// length is 0).
///
/// # Errors
/// When it is damaged.
pub fn read_bundle_poses(input: &mut impl BufRead) -> Result<Vec<Option<Rigid3>>, FormatError> {
    let mut numbers = Numbers { input, rest: Vec::new() };
    let count = numbers.next()?;
    numbers.next()?;
    let mut poses = Vec::new();
    // A count that is no whole number ends with the file, as nothing is allocated by it.
    while (poses.len() as f64) < count {
        let mut values = [0.0; 15];
        for value in &mut values {
            *value = numbers.next()?;
        }
        let [focal_px, _, _, rest @ ..] = values;
        let rows = Matrix3::from_row_slice(&rest[..9]);
        let rotation = Matrix3::from_diagonal(&Vector3::new(1.0, -1.0, -1.0)) * rows;
        let translation = turned(&Vector3::new(rest[9], rest[10], rest[11]));
        poses.push((focal_px != 0.0).then(|| Rigid3::from_matrix(&rotation, translation)));
    }
    Ok(poses)
}

/// Reads the names of a `list.txt` (what follows a blank in a line is a focal length hint when it starts with a 0).
///
/// # Errors
/// When it can't be read.
pub fn read_list(input: &mut impl BufRead) -> Result<Vec<String>, FormatError> {
    let mut names = Vec::new();
    for line in input.lines() {
        let line = line?;
        let line = line.trim();
        let name = match line.rsplitn(3, ' ').collect::<Vec<_>>()[..] {
            [focal, "0", name] if focal.parse::<f64>().is_ok() => name,
            _ => line.strip_suffix(" 0").unwrap_or(line),
        };
        if !name.is_empty() {
            names.push(name.to_owned());
        }
    }
    Ok(names)
}

/// The numbers of a file whatever the line breaks, without comment lines.
struct Numbers<'a, R> {
    input: &'a mut R,
    rest: Vec<f64>,
}

impl<R: BufRead> Numbers<'_, R> {
    fn next(&mut self) -> Result<f64, FormatError> {
        loop {
            if let Some(number) = self.rest.pop() {
                return Ok(number);
            }
            let mut line = String::new();
            if self.input.read_line(&mut line)? == 0 {
                return Err(FormatError::malformed(BUNDLE, "the file is cut short"));
            }
            if line.trim_start().starts_with('#') {
                continue;
            }
            let parsed: Result<Vec<f64>, _> = line.split_whitespace().map(str::parse).collect();
            self.rest = parsed.map_err(|_| FormatError::malformed(BUNDLE, "not a number where one should be"))?;
            self.rest.reverse();
        }
    }
}
