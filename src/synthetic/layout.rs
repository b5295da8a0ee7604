//! Where the cameras and the surface points of a synthetic scene lie. World frame: z up, in units of about a metre.

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::Rigid3;
use crate::math::Rng;

/// How cameras and points lie to each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Layout {
    /// A full circle of cameras round a rough ball of radius 1, at distance 4: a statue. Each sees the near side.
    Orbit,
    /// An arc of cameras in front of a wall 6 wide and 4 high with relief: a facade. Each sees most of the wall.
    Facade,
    /// A row of cameras, half a unit apart, along a wall as long as the row: a street. Each sees its part, so that the
    /// images hang together as a band.
    Street,
}

/// A point of the surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct SurfacePoint {
    /// Position in the world.
    pub xyz: Vector3<f64>,
    /// Outward normal of the surface, without the relief.
    pub normal: Vector3<f64>,
}

/// Cosine of the steepest view, to the normal, under which a surface point is still detected (about 75 degrees).
const GRAZING_COSINE: f64 = 0.25;
/// Distance of neighbouring cameras in a street.
const STREET_STEP: f64 = 0.5;
/// Standard deviation of the jitter of camera centres and of the points they look at, so that no configuration is
/// exactly symmetric, planar or collinear.
const JITTER: f64 = 0.15;

fn jitter(rng: &mut Rng) -> Vector3<f64> {
    Vector3::new(rng.normal(), rng.normal(), rng.normal()) * JITTER
}

impl Layout {
    /// The pose of camera `index` of `count`.
    pub(super) fn pose(self, index: usize, count: usize, rng: &mut Rng) -> Rigid3 {
        let share = index as f64 / count.max(1) as f64;
        let middle = index as f64 - 0.5 * (count as f64 - 1.0);
        let (center, target) = match self {
            Self::Orbit => {
                let angle = std::f64::consts::TAU * share;
                (Vector3::new(4.0 * angle.cos(), 4.0 * angle.sin(), 0.8), Vector3::zeros())
            }
            Self::Facade => {
                let angle = std::f64::consts::FRAC_PI_2 * (share - 0.5);
                (Vector3::new(6.0 * angle.sin(), -6.0 * angle.cos(), 1.6), Vector3::new(0.0, 0.0, 2.0))
            }
            Self::Street => {
                let x = STREET_STEP * middle;
                (Vector3::new(x, -4.0, 1.6), Vector3::new(x, 0.0, 2.0))
            }
        };
        look_at(&(center + jitter(rng)), &(target + jitter(rng)), 0.05 * rng.normal())
    }

    /// A random surface point of a scene of `count` cameras.
    pub(super) fn point(self, count: usize, rng: &mut Rng) -> SurfacePoint {
        let relief = 0.3 * rng.range(-1.0, 1.0);
        match self {
            Self::Orbit => {
                let normal = loop {
                    let v = Vector3::new(rng.normal(), rng.normal(), rng.normal());
                    if let Some(normal) = v.try_normalize(1e-3) {
                        break normal;
                    }
                };
                SurfacePoint { xyz: normal * (1.0 + relief), normal }
            }
            Self::Facade | Self::Street => {
                let half_width = if self == Self::Facade { 3.0 } else { 0.5 * STREET_STEP * count as f64 + 1.0 };
                let xyz = Vector3::new(rng.range(-half_width, half_width), relief, rng.range(0.0, 4.0));
                SurfacePoint { xyz, normal: -Vector3::y() }
            }
        }
    }
}

impl SurfacePoint {
    /// Whether the surface faces a camera at `center_in_world` well enough to be detected there.
    pub(super) fn faces(&self, center_in_world: &Vector3<f64>) -> bool {
        let to_camera = center_in_world - self.xyz;
        to_camera.dot(&self.normal) > GRAZING_COSINE * to_camera.norm()
    }
}

/// `cam_from_world` of a camera that looks at `target`, upright but for a roll.
pub(super) fn look_at(center_in_world: &Vector3<f64>, target_in_world: &Vector3<f64>, roll_rad: f64) -> Rigid3 {
    let forward = (target_in_world - center_in_world).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let down = forward.cross(&right);
    let upright = Matrix3::from_rows(&[right.transpose(), down.transpose(), forward.transpose()]);
    let roll = nalgebra::Rotation3::from_axis_angle(&Vector3::z_axis(), roll_rad).into_inner();
    let rotation = Rigid3::from_matrix(&(roll * upright), Vector3::zeros()).rotation;
    Rigid3::from_center(rotation, center_in_world)
}
