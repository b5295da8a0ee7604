//! Projection of all camera models by one formula, with the derivatives the normal equations need.
//!
//! Every model is the Brown-Conrady one of [`crate::camera`] with some parameters equal or zero, so the inner loop needs no
//! branch on the model: a camera is the eight numbers of its [`Lens`], and a parameter that may change is a [`Column`] of
//! the derivative.

use crate::camera::Camera;

/// Intrinsics as `fx, fy, cx, cy, k1, k2, p1, p2`, whatever the model.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Lens {
    pub focal: [f64; 2],
    pub center: [f64; 2],
    pub distortion: [f64; 4],
}

/// What a parameter of a model is to the lens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Column {
    /// Both focal lengths at once.
    Focal,
    /// One focal length: 0 for x, 1 for y.
    FocalOf(usize),
    /// A coordinate of the principal point: 0 for x, 1 for y.
    Center(usize),
    /// A distortion coefficient, in the order of the lens.
    Distortion(usize),
}

impl Lens {
    pub fn of(camera: &Camera) -> Self {
        let (fx, fy) = camera.focal();
        let center = camera.principal_point().0;
        Self { focal: [fx, fy], center: [center.x, center.y], distortion: camera.distortion() }
    }

    /// What parameter `index` of a camera is.
    pub fn column(camera: &Camera, index: usize) -> Column {
        let model = camera.model;
        let center = model.principal_point_index();
        if index >= model.distortion_index() {
            Column::Distortion(index - model.distortion_index())
        } else if index >= center {
            Column::Center(index - center)
        } else if model.has_two_focals() {
            Column::FocalOf(index)
        } else {
            Column::Focal
        }
    }

    /// The pixel of a point in the camera frame, which must lie in front of the camera.
    #[inline(always)]
    pub fn project(&self, x_in_cam: &[f64; 3]) -> [f64; 2] {
        let inverse_z = 1.0 / x_in_cam[2];
        let (x, y) = (x_in_cam[0] * inverse_z, x_in_cam[1] * inverse_z);
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = x * x + y * y;
        let g = 1.0 + r2 * (k1 + k2 * r2);
        let xy2 = 2.0 * x * y;
        let x_d = x * g + p1 * xy2 + p2 * (r2 + 2.0 * x * x);
        let y_d = y * g + p2 * xy2 + p1 * (r2 + 2.0 * y * y);
        [self.focal[0] * x_d + self.center[0], self.focal[1] * y_d + self.center[1]]
    }

    /// [`Lens::project`] with what its derivatives need.
    #[inline(always)]
    pub fn linearise(&self, x_in_cam: &[f64; 3]) -> Linearised {
        let inverse_z = 1.0 / x_in_cam[2];
        let (x, y) = (x_in_cam[0] * inverse_z, x_in_cam[1] * inverse_z);
        let [k1, k2, p1, p2] = self.distortion;
        let r2 = x * x + y * y;
        let g = 1.0 + r2 * (k1 + k2 * r2);
        let slope = 2.0 * (k1 + 2.0 * k2 * r2);
        let xy2 = 2.0 * x * y;
        let x_d = x * g + p1 * xy2 + p2 * (r2 + 2.0 * x * x);
        let y_d = y * g + p2 * xy2 + p1 * (r2 + 2.0 * y * y);
        let cross = 0.5 * xy2 * slope + 2.0 * (p1 * x + p2 * y);
        let xx = g + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x;
        let yy = g + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x;
        let (fx, fy) = (self.focal[0] * inverse_z, self.focal[1] * inverse_z);
        Linearised {
            pixel: [self.focal[0] * x_d + self.center[0], self.focal[1] * y_d + self.center[1]],
            by_point: [
                [fx * xx, fx * cross, -fx * (xx * x + cross * y)],
                [fy * cross, fy * yy, -fy * (cross * x + yy * y)],
            ],
            distorted: [x_d, y_d],
            normalized: [x, y],
        }
    }
}

/// A projection and its derivative by the point in the camera frame (two rows).
pub(super) struct Linearised {
    pub pixel: [f64; 2],
    pub by_point: [[f64; 3]; 2],
    distorted: [f64; 2],
    normalized: [f64; 2],
}

impl Linearised {
    /// The derivative of the pixel by one parameter.
    #[inline(always)]
    pub fn by_parameter(&self, lens: &Lens, column: Column) -> [f64; 2] {
        let [x, y] = self.normalized;
        let r2 = x * x + y * y;
        let [fx, fy] = lens.focal;
        match column {
            Column::Focal => self.distorted,
            Column::FocalOf(0) => [self.distorted[0], 0.0],
            Column::FocalOf(_) => [0.0, self.distorted[1]],
            Column::Center(0) => [1.0, 0.0],
            Column::Center(_) => [0.0, 1.0],
            Column::Distortion(0) => [fx * x * r2, fy * y * r2],
            Column::Distortion(1) => [fx * x * r2 * r2, fy * y * r2 * r2],
            Column::Distortion(2) => [fx * 2.0 * x * y, fy * (r2 + 2.0 * y * y)],
            Column::Distortion(_) => [fx * (r2 + 2.0 * x * x), fy * 2.0 * x * y],
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{CameraModel, FocalSource};
    use crate::geometry::Rigid3;
    use nalgebra::{UnitQuaternion, Vector3};

    fn camera(model: CameraModel) -> Camera {
        let mut camera = Camera::centered(model, 1000, 800, 900.0, FocalSource::Known);
        camera.set_focal(900.0, if model.has_two_focals() { 915.0 } else { 900.0 });
        camera.set_principal_point(510.0, 390.0);
        let at = model.distortion_index();
        let n = model.num_params() - at;
        camera.params[at..at + n].copy_from_slice(&[-0.12, 0.03, 0.002, -0.001][..n]);
        camera
    }

    #[test]
    fn agrees_with_the_camera() {
        for model in CameraModel::ALL {
            let camera = camera(model);
            let lens = Lens::of(&camera);
            let x_in_cam = Vector3::new(0.7, -0.5, 2.3);
            let theirs = camera.project_with_jacobian(&x_in_cam).unwrap();
            let ours = lens.linearise(&x_in_cam.into());
            assert_eq!(ours.pixel, lens.project(&x_in_cam.into()));
            for row in 0..2 {
                assert!((ours.pixel[row] - theirs.pixel.0[row]).abs() < 1e-10);
                for k in 0..3 {
                    assert!((ours.by_point[row][k] - theirs.by_point[(row, k)]).abs() < 1e-10);
                }
                for k in 0..model.num_params() {
                    let column = ours.by_parameter(&lens, Lens::column(&camera, k));
                    assert!((column[row] - theirs.by_params[(row, k)]).abs() < 1e-10, "{model:?} {k}");
                }
            }
        }
    }

    /// The derivative of the pixel by the six numbers of `Rigid3::step`, which the normal equations take apart, is
    /// `by_point * [-[y]_x | I]` with `y = R x`.
    #[test]
    fn pose_derivatives_agree_with_steps() {
        let cam_from_world =
            Rigid3::new(UnitQuaternion::from_scaled_axis(Vector3::new(0.2, -0.4, 0.1)), Vector3::new(0.1, 0.2, 3.0));
        let x_in_world = Vector3::new(0.5, -0.4, 0.3);
        let turned = cam_from_world.rotation * x_in_world;
        for model in CameraModel::ALL {
            let lens = Lens::of(&camera(model));
            let here = lens.linearise(&cam_from_world.apply(&x_in_world).into());
            for k in 0..6 {
                let mut step = [0.0; 6];
                step[k] = 1e-6;
                let (omega, v) = (Vector3::from_row_slice(&step[..3]), Vector3::from_row_slice(&step[3..]));
                let ahead = lens.project(&cam_from_world.step(&omega, &v).apply(&x_in_world).into());
                let behind = lens.project(&cam_from_world.step(&-omega, &-v).apply(&x_in_world).into());
                let moved = if k < 3 { omega.cross(&turned) } else { v } * 1e6;
                for row in 0..2 {
                    let analytic = (0..3).map(|j| here.by_point[row][j] * moved[j]).sum::<f64>();
                    assert!((analytic - (ahead[row] - behind[row]) / 2e-6).abs() < 1e-4, "{model:?} {k}");
                }
            }
        }
    }
}
