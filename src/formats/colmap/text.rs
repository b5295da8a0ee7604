//! The text files: a line an entry (two an image), fields separated by blanks, comments after `#`.
//!
//! Numbers are written with as many digits as it takes to read the same number back.

use std::collections::BTreeMap;
use std::io::{self, BufRead, Write};
use std::str::{FromStr, SplitWhitespace};

use nalgebra::Vector3;

use super::{ColmapImage, ColmapPoint, ColmapPoint2d, checked_camera, checked_pose, points_with_mean_errors};
use crate::camera::{Camera, CameraModel, Pixel};
use crate::formats::FormatError;
use crate::formats::shortest::Shortest;
use crate::scene::{ImageId, Reconstruction};

/// Writes `cameras.txt`.
///
/// # Errors
/// When writing fails.
pub fn write_cameras_txt(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "# One camera a line: CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]")?;
    for (id, camera) in model.used_cameras() {
        write!(out, "{} {} {} {}", id.0 + 1, camera.model.colmap_name(), camera.width, camera.height)?;
        for param in camera.params() {
            write!(out, " {}", Shortest(*param))?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Writes `images.txt`; `name_of` gives each image's path relative to the folder of images.
///
/// # Errors
/// When writing fails, or a name holds a line break.
pub fn write_images_txt<'a>(
    model: &Reconstruction,
    name_of: impl Fn(ImageId) -> &'a str,
    out: &mut impl Write,
) -> io::Result<()> {
    writeln!(out, "# Two lines an image: IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME")?;
    writeln!(out, "# and its keypoints: (X Y POINT3D_ID)[], the id being -1 where no point is seen")?;
    for (&id, image) in model.images() {
        let name = name_of(id);
        if name.contains(['\n', '\r']) {
            return Err(io::Error::new(io::ErrorKind::InvalidInput, "an image name holds a line break"));
        }
        let (q, t) = (image.cam_from_world.rotation, image.cam_from_world.translation);
        write!(out, "{} {} {} {} {}", id.0 + 1, Shortest(q.w), Shortest(q.i), Shortest(q.j), Shortest(q.k))?;
        writeln!(out, " {} {} {} {} {name}", Shortest(t.x), Shortest(t.y), Shortest(t.z), image.camera.0 + 1)?;
        let mut blank = "";
        for (keypoint, point) in image.keypoints.iter().zip(image.points()) {
            write!(out, "{blank}{} {} ", Shortest(keypoint.0.x), Shortest(keypoint.0.y))?;
            match point {
                Some(id) => write!(out, "{}", id.index() as u64 + 1)?,
                None => write!(out, "-1")?,
            }
            blank = " ";
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Writes `points3D.txt`.
///
/// # Errors
/// When writing fails.
pub fn write_points3d_txt(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "# One point a line: POINT3D_ID X Y Z R G B ERROR (IMAGE_ID POINT2D_IDX)[]")?;
    for (id, point, error_px) in points_with_mean_errors(model) {
        let (xyz, [r, g, b]) = (point.xyz, point.color);
        write!(out, "{} {} {} {}", id.index() as u64 + 1, Shortest(xyz.x), Shortest(xyz.y), Shortest(xyz.z))?;
        write!(out, " {r} {g} {b} {}", Shortest(error_px))?;
        for seen in &point.track {
            write!(out, " {} {}", seen.image.0 + 1, seen.keypoint.0)?;
        }
        writeln!(out)?;
    }
    Ok(())
}

/// Reads `cameras.txt`.
///
/// # Errors
/// When it is damaged or has a camera model that is not supported.
pub fn read_cameras_txt(input: &mut impl BufRead) -> Result<BTreeMap<u32, Camera>, FormatError> {
    let mut lines = Lines { input, file: "cameras.txt", number: 0 };
    let mut cameras = BTreeMap::new();
    while let Some(line) = lines.next_entry()? {
        let mut fields = lines.fields(&line);
        let id = fields.take("camera id")?;
        let name: String = fields.take("camera model")?;
        let model = CameraModel::from_colmap_name(&name).ok_or_else(|| FormatError::Unsupported {
            file: lines.file,
            message: format!("the camera model {name}"),
        })?;
        let size = [fields.take("width")?, fields.take("height")?];
        let params = fields.take_rest::<f64>("parameter")?;
        if cameras.insert(id, checked_camera(lines.file, model, size, &params)?).is_some() {
            return Err(lines.malformed(&format!("camera {id} comes twice")));
        }
    }
    Ok(cameras)
}

/// Reads `images.txt`.
///
/// # Errors
/// When it is damaged.
pub fn read_images_txt(input: &mut impl BufRead) -> Result<BTreeMap<u32, ColmapImage>, FormatError> {
    let mut lines = Lines { input, file: "images.txt", number: 0 };
    let mut images = BTreeMap::new();
    while let Some(line) = lines.next_entry()? {
        let mut fields = lines.fields(&line);
        let id: u32 = fields.take("image id")?;
        let mut pose = [0.0; 7];
        for value in &mut pose {
            *value = fields.take("pose")?;
        }
        let camera_id = fields.take("camera id")?;
        // The name is the rest of the line: it may hold blanks.
        let name = line.trim_start().splitn(10, ' ').nth(9).unwrap_or_default().trim_end().to_owned();
        if name.is_empty() {
            return Err(lines.malformed("the name is missing"));
        }
        let cam_from_world = checked_pose(lines.file, &pose)?;
        let keypoints = lines.next_line()?.unwrap_or_default();
        let mut fields = lines.fields(&keypoints);
        let mut points2d = Vec::new();
        while let Some(x) = fields.try_take::<f64>("keypoint")? {
            let y = fields.take("keypoint")?;
            let point_id: i64 = fields.take("point id")?;
            points2d.push(ColmapPoint2d { pixel: Pixel::new(x, y), point_id: u64::try_from(point_id).ok() });
        }
        if images.insert(id, ColmapImage { camera_id, name, cam_from_world, points2d }).is_some() {
            return Err(lines.malformed(&format!("image {id} comes twice")));
        }
    }
    Ok(images)
}

/// Reads `points3D.txt`.
///
/// # Errors
/// When it is damaged.
pub fn read_points3d_txt(input: &mut impl BufRead) -> Result<BTreeMap<u64, ColmapPoint>, FormatError> {
    let mut lines = Lines { input, file: "points3D.txt", number: 0 };
    let mut points = BTreeMap::new();
    while let Some(line) = lines.next_entry()? {
        let mut fields = lines.fields(&line);
        let id: u64 = fields.take("point id")?;
        let xyz = Vector3::new(fields.take("x")?, fields.take("y")?, fields.take("z")?);
        let color = [fields.take("red")?, fields.take("green")?, fields.take("blue")?];
        let error_px = fields.take("error")?;
        let mut track = Vec::new();
        while let Some(image) = fields.try_take("track")? {
            track.push((image, fields.take("track")?));
        }
        if points.insert(id, ColmapPoint { xyz, color, error_px, track }).is_some() {
            return Err(lines.malformed(&format!("point {id} comes twice")));
        }
    }
    Ok(points)
}

/// The lines of a file, counted for messages.
struct Lines<'a, R> {
    input: &'a mut R,
    file: &'static str,
    number: usize,
}

impl<R: BufRead> Lines<'_, R> {
    fn next_line(&mut self) -> Result<Option<String>, FormatError> {
        let mut line = String::new();
        self.number += 1;
        match self.input.read_line(&mut line) {
            Ok(0) => Ok(None),
            Ok(_) => Ok(Some(line)),
            Err(error) if error.kind() == io::ErrorKind::InvalidData => Err(self.malformed("it is not UTF-8")),
            Err(error) => Err(error.into()),
        }
    }

    /// The next line that is neither blank nor a comment.
    fn next_entry(&mut self) -> Result<Option<String>, FormatError> {
        while let Some(line) = self.next_line()? {
            if !line.trim().is_empty() && !line.trim_start().starts_with('#') {
                return Ok(Some(line));
            }
        }
        Ok(None)
    }

    fn fields<'l>(&self, line: &'l str) -> LineFields<'l> {
        LineFields { rest: line.split_whitespace(), file: self.file, number: self.number }
    }

    fn malformed(&self, message: &str) -> FormatError {
        FormatError::malformed(self.file, format!("line {}: {message}", self.number))
    }
}

/// Takes fields off a line.
struct LineFields<'l> {
    rest: SplitWhitespace<'l>,
    file: &'static str,
    number: usize,
}

impl LineFields<'_> {
    fn try_take<T: FromStr>(&mut self, what: &str) -> Result<Option<T>, FormatError> {
        let Some(field) = self.rest.next() else { return Ok(None) };
        field.parse().map(Some).map_err(|_| self.malformed(what))
    }

    fn take<T: FromStr>(&mut self, what: &str) -> Result<T, FormatError> {
        self.try_take(what)?.ok_or_else(|| self.malformed(what))
    }

    fn take_rest<T: FromStr>(&mut self, what: &str) -> Result<Vec<T>, FormatError> {
        std::iter::from_fn(|| self.try_take(what).transpose()).collect()
    }

    fn malformed(&self, what: &str) -> FormatError {
        let message = format!("line {}: the {what} is missing or wrong", self.number);
        FormatError::malformed(self.file, message)
    }
}
