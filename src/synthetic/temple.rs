//! Photographs of a stone temple, rendered by casting rays: the demo's pictures, with poses and intrinsics known exactly.
//!
//! Carving and stains differ from side to side, so opposite sides are not mistaken for each other. Every picture has an
//! exposure and sensor noise of its own. The same options give the same bytes for any number of threads.

use nalgebra::{UnitQuaternion, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::layout::look_at;
use super::temple_solids::{BASE_HALF, COLONNADE_HALF, COLUMN_TOP, FLOOR, Hit, Material, STEP_HEIGHT, Solids, Vec3};
use super::temple_stone::{SUN, stone};
use crate::camera::{Camera, CameraModel, FocalSource, Pixel};
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::RgbImage;

/// What to photograph.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct TempleOptions {
    /// Seed of the stones, the poses and the noise.
    pub seed: u64,
    /// Number of photographs, evenly along the arc; every fourth is taken from above.
    pub num_images: usize,
    /// Degrees of the circle around the temple that the photographs are taken from; 360: from all round.
    pub arc_deg: f64,
    /// Columns of every photograph.
    pub width: u32,
    /// Rows of every photograph.
    pub height: u32,
    /// Focal length in multiples of the width.
    pub focal_ratio: f64,
    /// Factor of the focal length in every other photograph, as after zooming; 1: none.
    pub zoom: f64,
    /// The focal length that EXIF states, as a factor of the true one without zoom; null: there is no EXIF.
    pub exif_focal_factor: Option<f64>,
    /// First radial distortion coefficient.
    pub k1: f64,
    /// Largest change of exposure, as a share of the mean.
    pub exposure_spread: f64,
    /// Standard deviation of the sensor's noise, in grey levels of 255.
    pub noise: f64,
}

impl Default for TempleOptions {
    fn default() -> Self {
        Self {
            seed: 0,
            num_images: 30,
            arc_deg: 360.0,
            width: 1280,
            height: 960,
            focal_ratio: 0.86,
            zoom: 1.0,
            exif_focal_factor: Some(1.0),
            k1: -0.06,
            exposure_spread: 0.25,
            noise: 1.5,
        }
    }
}

impl TempleOptions {
    /// Adds what is wrong with the values to `errors`.
    pub fn validate(&self, errors: &mut Vec<String>) {
        let mut check = |ok: bool, message: &str| {
            if !ok {
                errors.push(message.to_owned());
            }
        };
        check((1..=10_000).contains(&self.num_images), "num_images must be 1 to 10000");
        check(self.arc_deg > 0.0 && self.arc_deg <= 360.0, "arc_deg must be above 0 and at most 360");
        check((16..=16_384).contains(&self.width), "width must be 16 to 16384");
        check((16..=16_384).contains(&self.height), "height must be 16 to 16384");
        check((0.3..=5.0).contains(&self.focal_ratio), "focal_ratio must be 0.3 to 5");
        check((0.5..=2.0).contains(&self.zoom), "zoom must be 0.5 to 2");
        let stated = self.exif_focal_factor.unwrap_or(1.0);
        check((0.25..=4.0).contains(&stated), "exif_focal_factor must be 0.25 to 4, or null");
        check((-0.15..=0.15).contains(&self.k1), "k1 must be -0.15 to 0.15");
        check((0.0..=0.5).contains(&self.exposure_spread), "exposure_spread must be 0 to 0.5");
        check((0.0..=50.0).contains(&self.noise), "noise must be 0 to 50");
    }
}

/// The temple, ready to be photographed.
#[derive(Clone, Debug)]
pub struct Temple {
    options: TempleOptions,
    solids: Solids,
    seed: u32,
}

/// Streams of random numbers.
#[repr(u64)]
#[derive(Clone, Copy)]
enum Stream {
    Solids = 0x7e01,
    Pose,
    Exposure,
    Noise,
}

/// Rows that one task renders; the rays between two tasks' rows are cast by both.
const BAND_ROWS: usize = 16;
/// How far from a surface its shadow ray starts, in metres: more than the rounding of single precision at 40 m.
const SHADOW_OFFSET: f32 = 2e-3;
/// Where samples of a pixel lie in it: a rotated grid.
const SAMPLES: [[f32; 2]; 4] = [[0.125, 0.375], [0.375, 0.875], [0.625, 0.125], [0.875, 0.625]];

impl Temple {
    /// The temple of these options.
    pub fn new(options: &TempleOptions) -> Self {
        let mut rng = Rng::from_parts(&[options.seed, Stream::Solids as u64]);
        let seed = rng.next_u32();
        Self { options: options.clone(), solids: Solids::new(&mut rng), seed }
    }

    /// The camera of a photograph.
    pub fn camera(&self, index: usize) -> Camera {
        let options = &self.options;
        let zoom = if index.is_multiple_of(2) { 1.0 } else { options.zoom };
        let focal_px = options.focal_ratio * zoom * f64::from(options.width);
        let mut camera =
            Camera::centered(CameraModel::SimpleRadial, options.width, options.height, focal_px, FocalSource::Known);
        camera.params[CameraModel::SimpleRadial.distortion_index()] = options.k1;
        camera
    }

    /// The pose of a photograph.
    pub fn cam_from_world(&self, index: usize) -> Rigid3 {
        let mut rng = Rng::from_parts(&[self.options.seed, Stream::Pose as u64, index as u64]);
        let mut jitter = |size: f64| rng.range(-size, size);
        let step = self.options.arc_deg.to_radians() / self.options.num_images as f64;
        let angle = step * (index as f64 + 0.2 * jitter(1.0));
        let above = index % 4 == 3;
        let (reach, height) = if above { (18.5, 7.5 + jitter(1.5)) } else { (16.5, 1.7 + jitter(0.2)) };
        let reach = reach * (1.0 + 0.05 * jitter(1.0));
        let center = Vector3::new(1.08 * reach * angle.cos(), 0.95 * reach * angle.sin(), height);
        let target = Vector3::new(jitter(0.8), jitter(0.8), 4.3 + jitter(0.3));
        look_at(&center, &target, 0.03 * jitter(1.0))
    }

    /// The corners of the lowest step's upper side.
    pub fn platform_corners(&self) -> [Vector3<f64>; 4] {
        let [x, y] = BASE_HALF.map(f64::from);
        let z = f64::from(STEP_HEIGHT);
        [[-x, -y], [x, -y], [x, y], [-x, y]].map(|[x, y]| Vector3::new(x, y, z))
    }

    /// The place on a surface that a pixel of a photograph shows, unless it shows the sky.
    pub fn surface_at(&self, index: usize, pixel: &Pixel) -> Option<Vector3<f64>> {
        let pose = self.cam_from_world(index);
        let ray = pose.rotation.inverse() * self.camera(index).unproject(pixel).homogeneous();
        let center = pose.target_origin_in_source();
        let hit = self.solids.nearest(&center.cast(), &ray.cast())?;
        Some(center + ray * f64::from(hit.distance))
    }

    /// A photograph.
    pub fn photograph(&self, index: usize) -> RgbImage {
        let (width, height) = (self.options.width as usize, self.options.height as usize);
        let view = View::new(self, index);
        let mut exposure = Rng::from_parts(&[self.options.seed, Stream::Exposure as u64, index as u64]);
        let exposure = (1.0 + self.options.exposure_spread * exposure.range(-1.0, 1.0)) as f32;
        let mut data = vec![0u8; 3 * width * height];
        data.par_chunks_mut(3 * width * BAND_ROWS).enumerate().for_each(|(band, rows)| {
            let first = band * BAND_ROWS;
            let mut upper = view.corners(first);
            for (y, row) in (first..).zip(rows.chunks_exact_mut(3 * width)) {
                let lower = view.corners(y + 1);
                let mut rng = Rng::from_parts(&[self.options.seed, Stream::Noise as u64, index as u64, y as u64]);
                for (x, out) in row.chunks_exact_mut(3).enumerate() {
                    let light = view.light_of_pixel([&upper[x], &upper[x + 1], &lower[x], &lower[x + 1]]);
                    for (out, light) in out.iter_mut().zip(light) {
                        let level = 255.0 * developed(exposure * light);
                        *out = (f64::from(level) + self.options.noise * rng.normal()).round().clamp(0.0, 255.0) as u8;
                    }
                }
                upper = lower;
            }
        });
        RgbImage::new(width, height, data)
    }

    /// The light that a surface sends back along a ray.
    fn light(&self, center: &Vec3, direction: &Vec3, hit: &Hit, pixel_angle: f32) -> [f32; 3] {
        let place = center + direction * hit.distance;
        let slant = hit.normal.dot(direction).abs().max(0.3);
        let footprint = hit.distance * pixel_angle / slant.sqrt();
        let (color, relief) = stone(&place, &hit.normal, hit.material, hit.id, footprint, self.seed);
        let sun = Vec3::from(SUN).normalize();
        let facing = hit.normal.dot(&sun).max(0.0);
        let lit = facing > 0.0 && !self.solids.blocks(&(place + hit.normal * SHADOW_OFFSET), &sun);
        let direct = if lit { 1.15 * facing * relief } else { 0.0 };
        let ambient = 0.62 * openness(&place, hit) * (0.55 + 0.45 * relief);
        let warm = [1.06, 1.0, 0.9];
        let cool = [0.92, 0.98, 1.08];
        let haze = (hit.distance / 250.0).min(1.0);
        let far = sky(&Vec3::new(direction.x, direction.y, 0.0));
        std::array::from_fn(|i| {
            let near = color[i] * (direct * warm[i] + ambient * cool[i]);
            near + (far[i] - near) * haze
        })
    }
}

/// A photograph in the making.
struct View<'a> {
    temple: &'a Temple,
    camera: Camera,
    world_from_cam: UnitQuaternion<f64>,
    center: Vec3,
    /// What a pixel in the middle covers, in radians.
    pixel_angle: f32,
}

/// The corner of four pixels.
struct Corner {
    /// From the camera's centre through it; not of unit length.
    ray: Vec3,
    hit: Option<Hit>,
}

impl<'a> View<'a> {
    fn new(temple: &'a Temple, index: usize) -> Self {
        let (camera, pose) = (temple.camera(index), temple.cam_from_world(index));
        Self {
            temple,
            world_from_cam: pose.rotation.inverse(),
            center: pose.target_origin_in_source().cast(),
            pixel_angle: camera.px_to_normalized(1.0) as f32,
            camera,
        }
    }

    /// The upper corners of a row of pixels. Between corners the distortion is as good as linear.
    fn corners(&self, y: usize) -> Vec<Corner> {
        let corner = |x: u32| {
            let pixel = Pixel::new(f64::from(x), y as f64);
            let ray: Vec3 = (self.world_from_cam * self.camera.unproject(&pixel).homogeneous()).cast();
            Corner { ray, hit: self.temple.solids.nearest(&self.center, &ray) }
        };
        (0..=self.camera.width).map(corner).collect()
    }

    /// The light that falls on a pixel between its upper left, upper right, lower left and lower right corner. Where all four
    /// see one face, the light of the middle stands for all: details smaller than a pixel are left out of the stones anyway.
    fn light_of_pixel(&self, corners: [&Corner; 4]) -> [f32; 3] {
        const SAME_FACE_COSINE: f32 = 0.8;
        let ray = |[u, v]: [f32; 2]| {
            let between = |a: &Corner, b: &Corner| a.ray + (b.ray - a.ray) * u;
            let (top, bottom) = (between(corners[0], corners[1]), between(corners[2], corners[3]));
            (top + (bottom - top) * v).normalize()
        };
        let solids = &self.temple.solids;
        let middle = ray([0.5, 0.5]);
        match &corners[0].hit {
            None if corners.iter().all(|corner| corner.hit.is_none()) => return sky(&middle),
            Some(first) => {
                let same = |hit: &Hit| hit.id == first.id && hit.normal.dot(&first.normal) > SAME_FACE_COSINE;
                if corners.iter().all(|corner| corner.hit.as_ref().is_some_and(same))
                    && let Some(hit) = solids.meet(first.id, &self.center, &middle)
                {
                    return self.temple.light(&self.center, &middle, &hit, self.pixel_angle);
                }
            }
            None => {}
        }
        let mut sum = [0.0; 3];
        for ray in SAMPLES.map(ray) {
            let light = match solids.nearest(&self.center, &ray) {
                Some(hit) => self.temple.light(&self.center, &ray, &hit, self.pixel_angle),
                None => sky(&ray),
            };
            for (sum, light) in sum.iter_mut().zip(light) {
                *sum += light / SAMPLES.len() as f32;
            }
        }
        sum
    }
}

/// The share of the sky that a place sees, roughly: less among the columns, at the foot of the steps and in windows.
fn openness(place: &Vec3, hit: &Hit) -> f32 {
    let upward = 0.75 + 0.25 * hit.normal.z;
    let [x, y] = COLONNADE_HALF;
    let inside = (x + 0.4 - place.x.abs()).min(y + 0.4 - place.y.abs());
    let roofed = place.z >= FLOOR - 0.01 && place.z <= COLUMN_TOP + 0.01;
    let porch = if roofed { 1.0 - 0.3 * (inside / 0.8).clamp(0.0, 1.0) } else { 1.0 };
    let foot = if hit.material == Material::Ground {
        let out = (place.x.abs() - BASE_HALF[0]).max(place.y.abs() - BASE_HALF[1]);
        0.7 + 0.3 * (out / 0.6).clamp(0.0, 1.0)
    } else {
        1.0
    };
    upward * porch * foot
}

fn sky(direction: &Vec3) -> [f32; 3] {
    let up = direction.z.max(0.0).sqrt();
    [0.86 - 0.5 * up, 0.9 - 0.36 * up, 0.95 - 0.1 * up]
}

/// The film's curve: light to a level from 0 to 1.
fn developed(light: f32) -> f32 {
    let light = 0.8 * light;
    (light / (0.45 + light) * 1.45).clamp(0.0, 1.0).powf(1.3)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn small() -> TempleOptions {
        TempleOptions { num_images: 6, width: 160, height: 120, ..TempleOptions::default() }
    }

    #[test]
    fn the_same_options_give_the_same_bytes() {
        let photograph = |threads| {
            let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().expect("a pool");
            pool.install(|| Temple::new(&small()).photograph(1))
        };
        let first = photograph(1);
        assert_eq!(first, photograph(3));
        let other = Temple::new(&TempleOptions { seed: 1, ..small() }).photograph(1);
        assert_ne!(first, other);
    }

    #[test]
    fn photographs_have_texture_and_light() {
        let photograph = Temple::new(&small()).photograph(0);
        let n = photograph.data.len() as f64;
        let mean = photograph.data.iter().map(|&v| f64::from(v)).sum::<f64>() / n;
        let variance = photograph.data.iter().map(|&v| (f64::from(v) - mean).powi(2)).sum::<f64>() / n;
        assert!((50.0..220.0).contains(&mean), "mean level {mean}");
        assert!(variance > 20.0 * 20.0, "variance {variance}");
    }

    /// The pixel of a corner, moved by half a pixel towards the temple's axis, shows a place within centimetres of the
    /// corner; that holds for corners that nothing hides.
    #[test]
    fn corners_are_seen_where_the_pose_and_the_camera_say() {
        let temple = Temple::new(&TempleOptions { seed: 3, ..TempleOptions::default() });
        let camera = temple.camera(0);
        let mut seen = 0;
        for index in 0..30 {
            let pose = temple.cam_from_world(index);
            for corner in temple.platform_corners() {
                let inward = Vector3::new(corner.x * 0.999, corner.y * 0.999, corner.z - 0.005);
                let Some(pixel) = camera.project(&pose.apply(&inward)) else { continue };
                let Some(place) = temple.surface_at(index, &pixel) else { continue };
                let depth = (corner - pose.target_origin_in_source()).norm();
                let distance = (place - pose.target_origin_in_source()).norm();
                let near_corner = corner.xy().dot(&pose.target_origin_in_source().xy()) > 0.0;
                if near_corner && distance > depth - 0.1 {
                    assert!((place - corner).norm() < 0.1, "photograph {index}: {place} for {corner}");
                    seen += 1;
                }
            }
        }
        assert!(seen > 20, "only {seen} corners seen");
    }

    #[test]
    fn bad_options_are_told() {
        let mut errors = Vec::new();
        TempleOptions::default().validate(&mut errors);
        assert!(errors.is_empty());
        TempleOptions { num_images: 0, focal_ratio: f64::NAN, ..TempleOptions::default() }.validate(&mut errors);
        assert_eq!(errors.len(), 2);
    }
}
