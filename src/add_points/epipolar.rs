//! Epipolar lines from known poses (paper, section 6.2, equations 1 to 3).
//!
//! With `x_in_target = R x_in_query + t`, normalised positions of one point satisfy `x_t^T E x_q = 0`, `E = [t]_x R`. In
//! *undistorted pixels* (what a lens without distortion but with the same K would show) that is `p_t^T F p_q = 0` with
//!
//!   F = K_t^-T E K_q^-1
//!
//! and the line of a query is `l = F p_q = K_t^-T (E x_q)`. The print's equation 1 is the transpose of what its text uses
//! (it maps points of the candidate to lines in the query image), knows no distortion, and its equation 3 lacks the
//! absolute value; all three are mended here. Lines are made from normalised coordinates in double precision and scaled to
//! a unit normal, so that [`EpipolarLine::distance_px`] is a distance: written out with six decimals, the entries of F
//! (1e-8 to 1e-6) lose half of all matches.

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::camera::{Camera, Normalized};
use crate::geometry::Rigid3;

/// A line `normal . p + offset_px = 0` with a unit normal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct EpipolarLine {
    /// Unit normal.
    pub normal: Vector2<f64>,
    /// Distance of the origin from the line, signed.
    pub offset_px: f64,
}

impl EpipolarLine {
    /// From `(a, b, c)` of `a x + b y + c = 0`; none for the line at infinity and for the non-line of a query at the epipole.
    pub fn from_coefficients(line: &Vector3<f64>) -> Option<Self> {
        let length = line.x.hypot(line.y);
        let normal = Vector2::new(line.x, line.y) / length;
        let offset_px = line.z / length;
        (normal.iter().all(|c| c.is_finite()) && offset_px.is_finite()).then_some(Self { normal, offset_px })
    }

    /// Distance of a position from the line (equation 3, with its absolute value).
    #[inline]
    pub fn distance_px(&self, at: &Vector2<f64>) -> f64 {
        (self.normal.dot(at) + self.offset_px).abs()
    }

    /// The unit vector along the line.
    pub fn direction(&self) -> Vector2<f64> {
        Vector2::new(-self.normal.y, self.normal.x)
    }
}

/// An upright rectangle in undistorted pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BoundingBox {
    /// Smallest coordinates.
    pub min: Vector2<f64>,
    /// Largest coordinates.
    pub max: Vector2<f64>,
}

impl BoundingBox {
    /// The smallest box of some positions; none of none.
    pub fn around<'a>(positions: impl Iterator<Item = &'a Vector2<f64>>) -> Option<Self> {
        positions.fold(None, |bounds: Option<Self>, at| {
            Some(match bounds {
                None => Self { min: *at, max: *at },
                Some(bounds) => Self { min: bounds.min.inf(at), max: bounds.max.sup(at) },
            })
        })
    }

    /// The box with a margin on every side.
    pub fn grown(&self, margin_px: f64) -> Self {
        let margin = Vector2::repeat(margin_px);
        Self { min: self.min - margin, max: self.max + margin }
    }

    /// Where a line enters and leaves the box, in the order of its direction; none when it misses.
    pub fn clip(&self, line: &EpipolarLine) -> Option<[Vector2<f64>; 2]> {
        let (origin, along) = (line.normal * -line.offset_px, line.direction());
        let (mut enter, mut leave) = (f64::NEG_INFINITY, f64::INFINITY);
        for axis in 0..2 {
            let (near, far) = (self.min[axis] - origin[axis], self.max[axis] - origin[axis]);
            if along[axis] == 0.0 {
                if near > 0.0 || far < 0.0 {
                    return None;
                }
                continue;
            }
            let (a, b) = (near / along[axis], far / along[axis]);
            enter = enter.max(a.min(b));
            leave = leave.min(a.max(b));
        }
        (enter <= leave).then(|| [origin + along * enter, origin + along * leave])
    }
}

/// The epipolar geometry of two images with poses, from the image that asks (*query*) to the one searched (*target*).
#[derive(Clone, Debug)]
pub struct EpipolarGeometry {
    essential: Matrix3<f64>,
    inverse_target_calibration: Matrix3<f64>,
    fundamental: Matrix3<f64>,
    epipole_in_query: Vector3<f64>,
    epipole_in_target: Vector3<f64>,
    rotation: Matrix3<f64>,
    translation: Vector3<f64>,
}

/// Baselines shorter than this share of the centres' distance from the origin are rounding errors.
const MIN_RELATIVE_BASELINE: f64 = 1e-12;

impl EpipolarGeometry {
    /// Of a query and a target, each with its intrinsics and its `cam_from_world`; none when both centres coincide.
    pub fn new(query: (&Camera, &Rigid3), target: (&Camera, &Rigid3)) -> Option<Self> {
        let target_from_query = target.1.compose(&query.1.inverse());
        let (rotation, translation) = (target_from_query.rotation_matrix(), target_from_query.translation);
        let reach = query.1.translation.norm() + target.1.translation.norm();
        if translation.norm() <= MIN_RELATIVE_BASELINE * reach {
            return None;
        }
        let essential = translation.normalize().cross_matrix() * rotation;
        let (k_query, k_target) = (query.0.calibration_matrix(), target.0.calibration_matrix());
        let inverse_target_calibration = k_target.try_inverse()?;
        let fundamental = inverse_target_calibration.transpose() * essential * k_query.try_inverse()?;
        Some(Self {
            essential,
            inverse_target_calibration,
            fundamental,
            epipole_in_query: k_query * target_from_query.target_origin_in_source(),
            epipole_in_target: k_target * translation,
            rotation,
            translation,
        })
    }

    /// F with `p_target^T F p_query = 0` in undistorted pixels. Its scale is arbitrary.
    pub fn fundamental(&self) -> &Matrix3<f64> {
        &self.fundamental
    }

    /// The line of a query in the target's undistorted pixels, as `(a, b, c)` of no particular scale.
    pub fn line_coefficients(&self, query: &Normalized) -> Vector3<f64> {
        self.inverse_target_calibration.tr_mul(&(self.essential * query.homogeneous()))
    }

    /// The line of a query in the target's undistorted pixels; none for a query at the epipole.
    pub fn line_in_target(&self, query: &Normalized) -> Option<EpipolarLine> {
        EpipolarLine::from_coefficients(&self.line_coefficients(query))
    }

    /// The image of the target's centre in the query's undistorted pixels; none when it is at infinity.
    pub fn epipole_in_query(&self) -> Option<Vector2<f64>> {
        finite(&self.epipole_in_query)
    }

    /// The image of the query's centre in the target's undistorted pixels, homogeneous: all epipolar lines meet there.
    pub fn epipole_in_target(&self) -> Vector3<f64> {
        self.epipole_in_target
    }

    /// Depths (z in the query's and in the target's frame) of the point that two positions see, in the world's unit; none
    /// when their rays are parallel. Either may be negative: such a point is behind that camera.
    ///
    /// From `mu x_t = lambda R x_q + t`: crossed with `x_t`, `lambda (x_t x R x_q) = -(x_t x t)`, solved in the least squares
    /// sense.
    pub fn depths(&self, query: &Normalized, target: &Normalized) -> Option<(f64, f64)> {
        let (ray, at) = (self.rotation * query.homogeneous(), target.homogeneous());
        let across = at.cross(&ray);
        let depth = -across.dot(&at.cross(&self.translation)) / across.norm_squared();
        let point = ray * depth + self.translation;
        depth.is_finite().then_some((depth, point.z))
    }
}

/// The position of homogeneous coordinates; none when it is at infinity.
pub(super) fn finite(homogeneous: &Vector3<f64>) -> Option<Vector2<f64>> {
    let at = homogeneous.xy() / homogeneous.z;
    at.iter().all(|c| c.is_finite()).then_some(at)
}

#[cfg(test)]
mod tests {
    use nalgebra::UnitQuaternion;

    use super::*;
    use crate::camera::{CameraModel, FocalSource, Pixel};
    use crate::math::Rng;

    fn cameras() -> (Camera, Camera) {
        let mut query = Camera::centered(CameraModel::OpenCv, 1600, 1200, 1300.0, FocalSource::Known);
        query.params[4..8].copy_from_slice(&[-0.11, 0.02, 0.001, -0.002]);
        let mut target = Camera::centered(CameraModel::Radial, 1000, 1500, 1100.0, FocalSource::Known);
        target.params[3..5].copy_from_slice(&[-0.08, 0.01]);
        (query, target)
    }

    fn poses() -> (Rigid3, Rigid3) {
        let turn = |x, y, z| UnitQuaternion::from_scaled_axis(Vector3::new(x, y, z));
        let query = Rigid3::from_center(turn(0.05, 0.2, -0.1), &Vector3::new(0.5, -0.2, 0.1));
        (query, Rigid3::from_center(turn(-0.1, -0.25, 0.3), &Vector3::new(-1.0, 0.3, 0.4)))
    }

    #[test]
    fn points_lie_on_their_lines_in_undistorted_pixels() {
        let ((query, target), (query_pose, target_pose)) = (cameras(), poses());
        let geometry = EpipolarGeometry::new((&query, &query_pose), (&target, &target_pose)).unwrap();
        let mut rng = Rng::from_parts(&[3]);
        let (mut seen, mut off_line) = (0, 0.0f64);
        for _ in 0..200 {
            let world = Vector3::new(rng.range(-2.0, 2.0), rng.range(-2.0, 2.0), rng.range(4.0, 9.0));
            let (in_query, in_target) = (query_pose.apply(&world), target_pose.apply(&world));
            let (Some(p_query), Some(p_target)) = (query.project(&in_query), target.project(&in_target)) else {
                continue;
            };
            seen += 1;
            let straight = |camera: &Camera, p: &Pixel| camera.undistort_pixel(p).0.push(1.0);
            let (u_query, u_target) = (straight(&query, &p_query), straight(&target, &p_target));
            let residual = (u_target.transpose() * geometry.fundamental() * u_query)[0];
            assert!(residual.abs() < 1e-9, "p_t^T F p_q = {residual}");
            let transposed = (u_query.transpose() * geometry.fundamental() * u_target)[0];
            assert!(transposed.abs() > 1e-9, "the direction of F matters");
            let line = geometry.line_in_target(&query.unproject(&p_query)).unwrap();
            assert!(line.distance_px(&u_target.xy()) < 1e-6);
            off_line = off_line.max(line.distance_px(&p_target.0));
            let (depth_query, depth_target) =
                geometry.depths(&query.unproject(&p_query), &target.unproject(&p_target)).unwrap();
            assert!((depth_query - in_query.z).abs() < 1e-6 && (depth_target - in_target.z).abs() < 1e-6);
        }
        assert!(seen > 100);
        assert!(off_line > 4.0, "distortion matters: without undoing it points are {off_line} px off");
    }

    #[test]
    fn epipoles_are_where_the_centres_show() {
        let ((query, target), (query_pose, target_pose)) = (cameras(), poses());
        let geometry = EpipolarGeometry::new((&query, &query_pose), (&target, &target_pose)).unwrap();
        let back = EpipolarGeometry::new((&target, &target_pose), (&query, &query_pose)).unwrap();
        let in_query = geometry.epipole_in_query().unwrap();
        assert!((in_query - finite(&back.epipole_in_target()).unwrap()).norm() < 1e-6);
        let line = geometry.fundamental() * in_query.push(1.0);
        assert!(line.norm() < 1e-9 * geometry.fundamental().norm() * in_query.norm());
        assert!(EpipolarGeometry::new((&query, &query_pose), (&query, &query_pose)).is_none());
    }

    #[test]
    fn lines_are_clipped_to_the_box() {
        let bounds = BoundingBox { min: Vector2::new(0.0, 0.0), max: Vector2::new(10.0, 20.0) };
        let line = |a, b, c| EpipolarLine::from_coefficients(&Vector3::new(a, b, c)).unwrap();
        let [enter, leave] = bounds.clip(&line(2.0, -2.0, 0.0)).unwrap();
        assert!((enter - leave).norm() - 200f64.sqrt() < 1e-12);
        assert!(bounds.clip(&line(0.0, 1.0, -21.0)).is_none(), "horizontal, below");
        assert!(bounds.clip(&line(1.0, 0.0, -4.0)).is_some(), "vertical, inside");
        assert!(bounds.clip(&line(1.0, 1.0, -40.0)).is_none(), "oblique, beyond a corner");
        assert!(EpipolarLine::from_coefficients(&Vector3::new(0.0, 0.0, 1.0)).is_none());
    }
}
