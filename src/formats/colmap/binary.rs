//! The binary files: little-endian, counts of 64 bits first.
//!
//! Readers allocate as bytes arrive, never by a count that a file claims.

use std::collections::BTreeMap;
use std::io::{self, Read, Write};

use nalgebra::Vector3;

use super::{ColmapImage, ColmapPoint, ColmapPoint2d, checked_camera, checked_pose, points_with_mean_errors};
use crate::camera::{Camera, CameraModel, MAX_PARAMS, Pixel};
use crate::formats::FormatError;
use crate::scene::{ImageId, Reconstruction};

/// What a keypoint without a point has in place of a point's id.
const NO_POINT: u64 = u64::MAX;

/// Longest name that is read; file systems allow less.
const MAX_NAME_LEN: usize = 1 << 16;

/// Writes `cameras.bin`.
///
/// # Errors
/// When writing fails.
pub fn write_cameras_bin(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    let cameras = model.used_cameras();
    out.write_all(&(cameras.len() as u64).to_le_bytes())?;
    for (id, camera) in cameras {
        out.write_all(&(id.0 + 1).to_le_bytes())?;
        out.write_all(&camera.model.colmap_id().to_le_bytes())?;
        out.write_all(&u64::from(camera.width).to_le_bytes())?;
        out.write_all(&u64::from(camera.height).to_le_bytes())?;
        write_f64s(out, camera.params())?;
    }
    Ok(())
}

/// Writes `images.bin`; `name_of` gives each image's path relative to the folder of images.
///
/// # Errors
/// When writing fails, or a name holds a zero byte.
pub fn write_images_bin<'a>(
    model: &Reconstruction,
    name_of: impl Fn(ImageId) -> &'a str,
    out: &mut impl Write,
) -> io::Result<()> {
    out.write_all(&(model.images().len() as u64).to_le_bytes())?;
    for (&id, image) in model.images() {
        let name = name_of(id);
        if name.contains('\0') {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "an image name holds a zero byte"));
        }
        out.write_all(&(id.0 + 1).to_le_bytes())?;
        let rotation = image.cam_from_world.rotation;
        write_f64s(out, &[rotation.w, rotation.i, rotation.j, rotation.k])?;
        write_f64s(out, image.cam_from_world.translation.as_slice())?;
        out.write_all(&(image.camera.0 + 1).to_le_bytes())?;
        out.write_all(name.as_bytes())?;
        out.write_all(&[0])?;
        out.write_all(&(image.keypoints.len() as u64).to_le_bytes())?;
        for (keypoint, point) in image.keypoints.iter().zip(image.points()) {
            write_f64s(out, keypoint.0.as_slice())?;
            let point_id = point.map_or(NO_POINT, |id| id.index() as u64 + 1);
            out.write_all(&point_id.to_le_bytes())?;
        }
    }
    Ok(())
}

/// Writes `points3D.bin`.
///
/// # Errors
/// When writing fails.
pub fn write_points3d_bin(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    out.write_all(&(model.num_points() as u64).to_le_bytes())?;
    for (id, point, error_px) in points_with_mean_errors(model) {
        out.write_all(&(id.index() as u64 + 1).to_le_bytes())?;
        write_f64s(out, point.xyz.as_slice())?;
        out.write_all(&point.color)?;
        write_f64s(out, &[error_px])?;
        out.write_all(&(point.track.len() as u64).to_le_bytes())?;
        for seen in &point.track {
            out.write_all(&(seen.image.0 + 1).to_le_bytes())?;
            out.write_all(&seen.keypoint.0.to_le_bytes())?;
        }
    }
    Ok(())
}

fn write_f64s(out: &mut impl Write, values: &[f64]) -> io::Result<()> {
    values.iter().try_for_each(|value| out.write_all(&value.to_le_bytes()))
}

/// Reads `cameras.bin`.
///
/// # Errors
/// When it is damaged or has a camera model that is not supported.
pub fn read_cameras_bin(input: &mut impl Read) -> Result<BTreeMap<u32, Camera>, FormatError> {
    let mut fields = Fields { input, file: "cameras.bin" };
    let mut cameras = BTreeMap::new();
    for _ in 0..fields.u64()? {
        let id = fields.u32()?;
        let model_id = i32::from_le_bytes(fields.bytes()?);
        let model = CameraModel::from_colmap_id(model_id).ok_or_else(|| FormatError::Unsupported {
            file: fields.file,
            message: format!("the camera model number {model_id}"),
        })?;
        let size = [fields.u64()?, fields.u64()?];
        let mut params = [0.0; MAX_PARAMS];
        for param in &mut params[..model.num_params()] {
            *param = fields.f64()?;
        }
        let camera = checked_camera(fields.file, model, size, &params[..model.num_params()])?;
        if cameras.insert(id, camera).is_some() {
            return Err(FormatError::malformed(fields.file, format!("camera {id} comes twice")));
        }
    }
    Ok(cameras)
}

/// Reads `images.bin`.
///
/// # Errors
/// When it is damaged.
pub fn read_images_bin(input: &mut impl Read) -> Result<BTreeMap<u32, ColmapImage>, FormatError> {
    let mut fields = Fields { input, file: "images.bin" };
    let mut images = BTreeMap::new();
    for _ in 0..fields.u64()? {
        let id = fields.u32()?;
        let cam_from_world = checked_pose(fields.file, &fields.f64s()?)?;
        let camera_id = fields.u32()?;
        let name = fields.name()?;
        let mut points2d = Vec::new();
        for _ in 0..fields.u64()? {
            let [x, y] = fields.f64s()?;
            let point_id = Some(fields.u64()?).filter(|&id| id != NO_POINT);
            points2d.push(ColmapPoint2d { pixel: Pixel::new(x, y), point_id });
        }
        if images.insert(id, ColmapImage { camera_id, name, cam_from_world, points2d }).is_some() {
            return Err(FormatError::malformed(fields.file, format!("image {id} comes twice")));
        }
    }
    Ok(images)
}

/// Reads `points3D.bin`.
///
/// # Errors
/// When it is damaged.
pub fn read_points3d_bin(input: &mut impl Read) -> Result<BTreeMap<u64, ColmapPoint>, FormatError> {
    let mut fields = Fields { input, file: "points3D.bin" };
    let mut points = BTreeMap::new();
    for _ in 0..fields.u64()? {
        let id = fields.u64()?;
        let xyz = Vector3::from(fields.f64s()?);
        let color = fields.bytes()?;
        let error_px = fields.f64()?;
        let mut track = Vec::new();
        for _ in 0..fields.u64()? {
            track.push((fields.u32()?, fields.u32()?));
        }
        if points.insert(id, ColmapPoint { xyz, color, error_px, track }).is_some() {
            return Err(FormatError::malformed(fields.file, format!("point {id} comes twice")));
        }
    }
    Ok(points)
}

/// Takes fields off a file.
struct Fields<'a, R> {
    input: &'a mut R,
    file: &'static str,
}

impl<R: Read> Fields<'_, R> {
    fn bytes<const N: usize>(&mut self) -> Result<[u8; N], FormatError> {
        let mut bytes = [0; N];
        self.input.read_exact(&mut bytes).map_err(|error| match error.kind() {
            io::ErrorKind::UnexpectedEof => FormatError::malformed(self.file, "the file is cut short"),
            _ => error.into(),
        })?;
        Ok(bytes)
    }

    fn u32(&mut self) -> Result<u32, FormatError> {
        Ok(u32::from_le_bytes(self.bytes()?))
    }

    fn u64(&mut self) -> Result<u64, FormatError> {
        Ok(u64::from_le_bytes(self.bytes()?))
    }

    fn f64(&mut self) -> Result<f64, FormatError> {
        Ok(f64::from_le_bytes(self.bytes()?))
    }

    fn f64s<const N: usize>(&mut self) -> Result<[f64; N], FormatError> {
        let mut values = [0.0; N];
        for value in &mut values {
            *value = self.f64()?;
        }
        Ok(values)
    }

    fn name(&mut self) -> Result<String, FormatError> {
        let mut name = Vec::new();
        loop {
            match self.bytes()? {
                [0] => break,
                [byte] => name.push(byte),
            }
            if name.len() > MAX_NAME_LEN {
                return Err(FormatError::malformed(self.file, "a name does not end"));
            }
        }
        String::from_utf8(name).map_err(|_| FormatError::malformed(self.file, "a name is not UTF-8"))
    }
}
