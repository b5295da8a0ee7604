//! PLY, binary little-endian: the point cloud, and the cameras as frusta.
//!
//! Reference: Turk, "The PLY polygon file format", 1994.

use std::io::{self, Write};

use nalgebra::Vector3;

use crate::camera::{Camera, Pixel};
use crate::scene::{Reconstruction, RegisteredImage};

/// Writes the points: `x y z` (float, world), `red green blue` (uchar), in id order.
///
/// # Errors
/// When writing fails.
pub fn write_points(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment points of a Multistage model\nelement vertex {}\n{VERTEX}end_header\n",
        model.num_points()
    )?;
    model.points().try_for_each(|(_, point)| write_vertex(out, &point.xyz, point.color))
}

const VERTEX: &str = "property float x\nproperty float y\nproperty float z\n\
    property uchar red\nproperty uchar green\nproperty uchar blue\n";

fn write_vertex(out: &mut impl Write, xyz: &Vector3<f64>, color: [u8; 3]) -> io::Result<()> {
    xyz.iter().try_for_each(|&value| out.write_all(&(value as f32).to_le_bytes()))?;
    out.write_all(&color)
}

/// Depth of a frustum as a part of the median distance from a camera to its nearest neighbour.
const FRUSTUM_DEPTH_RATIO: f64 = 0.5;

const FRUSTUM_COLOR: [u8; 3] = [230, 90, 40];

/// Vertices of a frustum: the camera centre, then the corners upper left, upper right, lower right, lower left of its image.
const FRUSTUM_VERTICES: usize = 5;

/// The four sides, as seen from outside.
const FRUSTUM_FACES: [[i32; 3]; 4] = [[0, 2, 1], [0, 3, 2], [0, 4, 3], [0, 1, 4]];

/// From the centre to the corners, and around the image.
const FRUSTUM_EDGES: [[i32; 2]; 8] = [[0, 1], [0, 2], [0, 3], [0, 4], [1, 2], [2, 3], [3, 4], [4, 1]];

/// Writes a frustum for each registered image, in id order: vertices, triangular faces and edges.
///
/// # Errors
/// When writing fails.
pub fn write_cameras(model: &Reconstruction, out: &mut impl Write) -> io::Result<()> {
    let count = model.images().len();
    write!(
        out,
        "ply\nformat binary_little_endian 1.0\ncomment cameras of a Multistage model: centre and image corners\n\
         element vertex {}\n{VERTEX}\
         element face {}\nproperty list uchar int vertex_indices\n\
         element edge {}\nproperty int vertex1\nproperty int vertex2\nend_header\n",
        count * FRUSTUM_VERTICES,
        count * FRUSTUM_FACES.len(),
        count * FRUSTUM_EDGES.len(),
    )?;
    let depth = frustum_depth(model);
    for (&id, image) in model.images() {
        for vertex in frustum(image, model.camera_of(id), depth) {
            write_vertex(out, &vertex, FRUSTUM_COLOR)?;
        }
    }
    let first_vertices = || (0..count).map(|k| (k * FRUSTUM_VERTICES) as i32);
    for first in first_vertices() {
        for face in FRUSTUM_FACES {
            out.write_all(&[3])?;
            face.iter().try_for_each(|vertex| out.write_all(&(first + vertex).to_le_bytes()))?;
        }
    }
    for first in first_vertices() {
        for edge in FRUSTUM_EDGES {
            edge.iter().try_for_each(|vertex| out.write_all(&(first + vertex).to_le_bytes()))?;
        }
    }
    Ok(())
}

/// The depth at which all frusta end.
fn frustum_depth(model: &Reconstruction) -> f64 {
    let centers: Vec<Vector3<f64>> = model.images().values().map(RegisteredImage::center_in_world).collect();
    let mut nearest: Vec<f64> = (0..centers.len())
        .filter_map(|k| {
            let others = centers.iter().enumerate().filter(|&(other, _)| other != k);
            others.map(|(_, center)| (center - centers[k]).norm()).min_by(f64::total_cmp)
        })
        .collect();
    nearest.sort_by(f64::total_cmp);
    let median = nearest.get(nearest.len() / 2).copied().filter(|&distance| distance > 0.0);
    FRUSTUM_DEPTH_RATIO * median.unwrap_or(1.0)
}

/// Centre and image corners of a camera in the world.
fn frustum(image: &RegisteredImage, camera: &Camera, depth: f64) -> [Vector3<f64>; FRUSTUM_VERTICES] {
    let world_from_cam = image.cam_from_world.inverse();
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    let corner = |x: f64, y: f64| {
        let ray = camera.unproject(&Pixel::new(x, y)).homogeneous();
        world_from_cam.apply(&(ray * depth))
    };
    let center = world_from_cam.translation;
    [center, corner(0.0, 0.0), corner(width, 0.0), corner(width, height), corner(0.0, height)]
}
