//! Camera intrinsics: models, projection with analytic Jacobians, and undistortion.
//!
//! Frame of a camera: x to the right, y down, z forward. Pixels: the origin is the upper-left *corner* of the original
//! image, so the centre of the first pixel is (0.5, 0.5), as COLMAP has it. Normalised coordinates are `x / z, y / z`
//! without distortion.

mod distortion;
mod model;

pub use model::{CameraModel, MAX_PARAMS};

use nalgebra::{Matrix2x3, Matrix3, SMatrix, Vector2, Vector3};
use serde::{Deserialize, Serialize};

/// A position in pixels of the original image.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Pixel(pub Vector2<f64>);

/// A position on the plane `z = 1` of the camera frame, free of distortion.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Normalized(pub Vector2<f64>);

impl Pixel {
    /// From column and row.
    pub fn new(x: f64, y: f64) -> Self {
        Self(Vector2::new(x, y))
    }
}

impl Normalized {
    /// From its two coordinates.
    pub fn new(x: f64, y: f64) -> Self {
        Self(Vector2::new(x, y))
    }

    /// `(x, y, 1)`.
    pub fn homogeneous(&self) -> Vector3<f64> {
        Vector3::new(self.0.x, self.0.y, 1.0)
    }

    /// The unit ray through it, in the camera frame.
    pub fn ray(&self) -> Vector3<f64> {
        self.homogeneous().normalize()
    }
}

/// Focal length of a photograph of which nothing is known, as a share of its longer side: it sees 45 degrees. COLMAP's.
pub const TYPICAL_FOCAL: f64 = 1.2;

/// Where a focal length comes from, and so how far it is trusted.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum FocalSource {
    /// Nothing was known: a guess from the image size.
    Guess,
    /// From EXIF: a prior, never a truth.
    Exif,
    /// Estimated from the photographs.
    Estimated,
    /// Given by the user: kept as it is.
    Known,
}

impl FocalSource {
    /// Whether nothing but the photographs told the focal length, so that images may be moved to its camera and away from it.
    pub fn is_told_by_photographs(self) -> bool {
        matches!(self, Self::Guess | Self::Estimated)
    }
}

/// One set of intrinsics.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Camera {
    /// The model, which says what `params` mean.
    pub model: CameraModel,
    /// Columns of the original image.
    pub width: u32,
    /// Rows of the original image.
    pub height: u32,
    /// The first `model.num_params()` entries in COLMAP's order for the model; the rest are 0.
    pub params: [f64; MAX_PARAMS],
    /// Where the focal length comes from.
    pub focal_source: FocalSource,
}

/// A projection and its derivatives.
#[derive(Clone, Copy, Debug)]
pub struct ProjectionJacobian {
    /// The projected position.
    pub pixel: Pixel,
    /// Derivative of the pixel by the point in the camera frame.
    pub by_point: Matrix2x3<f64>,
    /// Derivative of the pixel by `params`; columns beyond the model's parameters are 0.
    pub by_params: SMatrix<f64, 2, MAX_PARAMS>,
}

/// Points nearer to the camera's plane than this (in scene units) do not project: their pixels would be unbounded.
const MIN_DEPTH: f64 = 1e-9;

impl Camera {
    /// A distortion-free camera of a model with the principal point in the middle.
    pub fn centered(model: CameraModel, width: u32, height: u32, focal_px: f64, focal_source: FocalSource) -> Self {
        let mut camera = Self { model, width, height, params: [0.0; MAX_PARAMS], focal_source };
        camera.set_focal(focal_px, focal_px);
        camera.set_principal_point(f64::from(width) / 2.0, f64::from(height) / 2.0);
        camera
    }

    /// Whether pictures of both are of one size.
    pub fn has_size_of(&self, other: &Self) -> bool {
        (self.width, self.height) == (other.width, other.height)
    }

    /// The parameters of the model, in COLMAP's order.
    pub fn params(&self) -> &[f64] {
        &self.params[..self.model.num_params()]
    }

    /// Focal lengths `(fx, fy)` in pixels.
    pub fn focal(&self) -> (f64, f64) {
        if self.model.has_two_focals() { (self.params[0], self.params[1]) } else { (self.params[0], self.params[0]) }
    }

    /// The mean of both focal lengths in pixels.
    pub fn mean_focal_px(&self) -> f64 {
        let (fx, fy) = self.focal();
        0.5 * (fx + fy)
    }

    /// Sets both focal lengths; a model with one takes their mean.
    pub fn set_focal(&mut self, fx: f64, fy: f64) {
        if self.model.has_two_focals() {
            self.params[0] = fx;
            self.params[1] = fy;
        } else {
            self.params[0] = 0.5 * (fx + fy);
        }
    }

    /// The principal point in pixels.
    pub fn principal_point(&self) -> Pixel {
        let at = self.model.principal_point_index();
        Pixel::new(self.params[at], self.params[at + 1])
    }

    /// Sets the principal point in pixels.
    pub fn set_principal_point(&mut self, cx: f64, cy: f64) {
        let at = self.model.principal_point_index();
        self.params[at] = cx;
        self.params[at + 1] = cy;
    }

    /// The distortion `(k1, k2, p1, p2)`; coefficients the model lacks are 0.
    pub fn distortion(&self) -> [f64; 4] {
        let at = self.model.distortion_index();
        let mut coefficients = [0.0; 4];
        let n = self.model.num_params() - at;
        coefficients[..n].copy_from_slice(&self.params[at..at + n]);
        coefficients
    }

    /// The same camera as another model: shared parameters are kept, new distortion coefficients start at 0.
    pub fn with_model(&self, model: CameraModel) -> Self {
        let mut camera = Self { model, params: [0.0; MAX_PARAMS], ..self.clone() };
        let (fx, fy) = self.focal();
        camera.set_focal(fx, fy);
        let center = self.principal_point().0;
        camera.set_principal_point(center.x, center.y);
        let at = model.distortion_index();
        let n = model.num_params() - at;
        camera.params[at..at + n].copy_from_slice(&self.distortion()[..n]);
        camera
    }

    /// The matrix K (without distortion).
    pub fn calibration_matrix(&self) -> Matrix3<f64> {
        let (fx, fy) = self.focal();
        let center = self.principal_point().0;
        Matrix3::new(fx, 0.0, center.x, 0.0, fy, center.y, 0.0, 0.0, 1.0)
    }

    /// The pixel of a point in the camera frame; none for a point not in front of the camera.
    #[inline]
    pub fn project(&self, x_in_cam: &Vector3<f64>) -> Option<Pixel> {
        if x_in_cam.z < MIN_DEPTH {
            return None;
        }
        Some(self.project_normalized(&Normalized::new(x_in_cam.x / x_in_cam.z, x_in_cam.y / x_in_cam.z)))
    }

    /// The pixel of a normalised position.
    #[inline]
    pub fn project_normalized(&self, normalized: &Normalized) -> Pixel {
        let distorted = distortion::distort(&self.distortion(), &normalized.0);
        let (fx, fy) = self.focal();
        let center = self.principal_point().0;
        Pixel::new(fx * distorted.x + center.x, fy * distorted.y + center.y)
    }

    /// [`Camera::project`] with its derivatives by the point and by the parameters.
    pub fn project_with_jacobian(&self, x_in_cam: &Vector3<f64>) -> Option<ProjectionJacobian> {
        if x_in_cam.z < MIN_DEPTH {
            return None;
        }
        let inverse_z = 1.0 / x_in_cam.z;
        let normalized = Vector2::new(x_in_cam.x * inverse_z, x_in_cam.y * inverse_z);
        let distorted = distortion::distort_with_jacobian(&self.distortion(), &normalized);
        let (fx, fy) = self.focal();
        let center = self.principal_point().0;
        let pixel = Pixel::new(fx * distorted.position.x + center.x, fy * distorted.position.y + center.y);
        let normalized_by_point =
            Matrix2x3::new(inverse_z, 0.0, -normalized.x * inverse_z, 0.0, inverse_z, -normalized.y * inverse_z);
        let mut by_point = distorted.by_position * normalized_by_point;
        by_point.row_mut(0).scale_mut(fx);
        by_point.row_mut(1).scale_mut(fy);
        let mut by_params = SMatrix::<f64, 2, MAX_PARAMS>::zeros();
        by_params[(0, 0)] = distorted.position.x;
        by_params[(1, usize::from(self.model.has_two_focals()))] = distorted.position.y;
        let center_at = self.model.principal_point_index();
        by_params[(0, center_at)] = 1.0;
        by_params[(1, center_at + 1)] = 1.0;
        let at = self.model.distortion_index();
        for k in 0..self.model.num_params() - at {
            by_params[(0, at + k)] = fx * distorted.by_coefficients[(0, k)];
            by_params[(1, at + k)] = fy * distorted.by_coefficients[(1, k)];
        }
        Some(ProjectionJacobian { pixel, by_point, by_params })
    }

    /// The undistorted normalised position of a pixel (Newton's method on the distortion; where the distortion can't be
    /// inverted, the best position found).
    pub fn unproject(&self, pixel: &Pixel) -> Normalized {
        let (fx, fy) = self.focal();
        let center = self.principal_point().0;
        let distorted = Vector2::new((pixel.0.x - center.x) / fx, (pixel.0.y - center.y) / fy);
        Normalized(distortion::undistort(&self.distortion(), &distorted))
    }

    /// The pixel an ideal camera without distortion but with the same focal lengths and principal point would show:
    /// what epipolar lines are straight in.
    pub fn undistort_pixel(&self, pixel: &Pixel) -> Pixel {
        let normalized = self.unproject(pixel).0;
        let (fx, fy) = self.focal();
        let center = self.principal_point().0;
        Pixel::new(fx * normalized.x + center.x, fy * normalized.y + center.y)
    }

    /// A length in pixels as a length on the plane z = 1.
    pub fn px_to_normalized(&self, length_px: f64) -> f64 {
        length_px / self.mean_focal_px()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    pub(crate) fn distorted_camera(model: CameraModel) -> Camera {
        let mut camera = Camera::centered(model, 1000, 800, 900.0, FocalSource::Known);
        camera.set_focal(900.0, if model.has_two_focals() { 910.0 } else { 900.0 });
        camera.set_principal_point(510.0, 390.0);
        let at = model.distortion_index();
        let n = model.num_params() - at;
        camera.params[at..at + n].copy_from_slice(&[-0.12, 0.03, 0.002, -0.001][..n]);
        camera
    }

    #[test]
    fn unprojection_inverts_projection() {
        for model in CameraModel::ALL {
            let camera = distorted_camera(model);
            for (x, y) in [(0.0, 0.0), (0.3, -0.2), (-0.5, 0.4), (0.55, 0.43)] {
                let normalized = Normalized::new(x, y);
                let back = camera.unproject(&camera.project_normalized(&normalized));
                assert!((back.0 - normalized.0).norm() < 1e-10, "{model:?} {x} {y}");
            }
        }
    }

    #[test]
    fn jacobians_agree_with_differences() {
        let step = 1e-6;
        for model in CameraModel::ALL {
            let camera = distorted_camera(model);
            let x_in_cam = Vector3::new(0.7, -0.5, 2.3);
            let jacobian = camera.project_with_jacobian(&x_in_cam).unwrap();
            assert!((jacobian.pixel.0 - camera.project(&x_in_cam).unwrap().0).norm() < 1e-12);
            for k in 0..3 {
                let mut offset = Vector3::zeros();
                offset[k] = step;
                let ahead = camera.project(&(x_in_cam + offset)).unwrap().0;
                let behind = camera.project(&(x_in_cam - offset)).unwrap().0;
                assert!((jacobian.by_point.column(k) - (ahead - behind) / (2.0 * step)).norm() < 1e-5);
            }
            for k in 0..model.num_params() {
                let (mut more, mut less) = (camera.clone(), camera.clone());
                more.params[k] += step;
                less.params[k] -= step;
                let difference =
                    (more.project(&x_in_cam).unwrap().0 - less.project(&x_in_cam).unwrap().0) / (2.0 * step);
                assert!((jacobian.by_params.column(k) - difference).norm() < 1e-5, "{model:?} parameter {k}");
            }
        }
    }

    #[test]
    fn a_point_behind_does_not_project() {
        assert!(distorted_camera(CameraModel::Radial).project(&Vector3::new(0.0, 0.0, -1.0)).is_none());
    }
}
