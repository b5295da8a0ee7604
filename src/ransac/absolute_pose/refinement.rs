//! Non-linear refinement of a camera on its inliers: pose, and on request focal length and first radial coefficient.
//!
//! Levenberg-Marquardt on `sum c^2 log(1 + |r|^2 / c^2)` (Cauchy loss) of the reprojection errors `r` in pixels of the full
//! camera model, with `x_in_cam = R X + t`, the left update of [`Rigid3::step`], and the focal length as its logarithm. The
//! loss is handled by reweighting: each residual weighs `1 / (1 + |r|^2 / c^2)`.

use nalgebra::{SMatrix, SVector, Vector3};

use crate::camera::{Camera, Pixel};
use crate::geometry::Rigid3;

/// Pose (6), log focal, k1.
const PARAMETERS: usize = 8;
const LOG_FOCAL: usize = 6;
const K1: usize = 7;

/// What to move besides the pose.
#[derive(Clone, Copy, Debug)]
pub(super) struct Free {
    pub focal: bool,
    pub k1: bool,
}

/// Steps tried at most.
const MAX_STEPS: usize = 30;
/// Damping at the start, relative to the diagonal.
const INITIAL_DAMPING: f64 = 1e-4;
/// Damping at which no step will help any more.
const MAX_DAMPING: f64 = 1e10;
/// A relative fall of the cost that ends the refinement.
const TINY_FALL: f64 = 1e-9;

/// A camera in place.
#[derive(Clone, Debug)]
pub(super) struct PlacedCamera {
    pub cam_from_world: Rigid3,
    pub camera: Camera,
}

impl PlacedCamera {
    pub fn residual_sq(&self, point: &Vector3<f64>, pixel: &Pixel) -> f64 {
        match self.camera.project(&self.cam_from_world.apply(point)) {
            Some(projected) => (projected.0 - pixel.0).norm_squared(),
            None => f64::INFINITY,
        }
    }

    fn cost(&self, data: &[(Vector3<f64>, Pixel)], loss_px: f64) -> f64 {
        let c_sq = loss_px * loss_px;
        data.iter().map(|(point, pixel)| c_sq * (self.residual_sq(point, pixel) / c_sq).ln_1p()).sum()
    }

    fn step(&self, delta: &SVector<f64, PARAMETERS>) -> Self {
        let (omega, v) = (Vector3::new(delta[0], delta[1], delta[2]), Vector3::new(delta[3], delta[4], delta[5]));
        let mut next = Self { cam_from_world: self.cam_from_world.step(&omega, &v), camera: self.camera.clone() };
        let (fx, fy) = self.camera.focal();
        let factor = delta[LOG_FOCAL].exp();
        next.camera.set_focal(fx * factor, fy * factor);
        if has_k1(&self.camera) {
            next.camera.params[self.camera.model.distortion_index()] += delta[K1];
        }
        next
    }

    /// The residual and its derivatives by `(omega, v, log f, k1)`.
    fn linearize(
        &self,
        point: &Vector3<f64>,
        pixel: &Pixel,
    ) -> Option<(nalgebra::Vector2<f64>, SMatrix<f64, 2, PARAMETERS>)> {
        let turned = self.cam_from_world.rotation * point;
        let projection = self.camera.project_with_jacobian(&(turned + self.cam_from_world.translation))?;
        let mut jacobian = SMatrix::<f64, 2, PARAMETERS>::zeros();
        for axis in 0..2 {
            let by_point = projection.by_point.row(axis).transpose();
            let by_turn = turned.cross(&by_point);
            for k in 0..3 {
                jacobian[(axis, k)] = by_turn[k];
                jacobian[(axis, 3 + k)] = by_point[k];
            }
        }
        let (fx, fy) = self.camera.focal();
        let two = usize::from(self.camera.model.has_two_focals());
        jacobian[(0, LOG_FOCAL)] = fx * projection.by_params[(0, 0)];
        jacobian[(1, LOG_FOCAL)] = fy * projection.by_params[(1, two)];
        if has_k1(&self.camera) {
            let at = self.camera.model.distortion_index();
            jacobian[(0, K1)] = projection.by_params[(0, at)];
            jacobian[(1, K1)] = projection.by_params[(1, at)];
        }
        Some((projection.pixel.0 - pixel.0, jacobian))
    }
}

impl PlacedCamera {
    /// The reweighted normal equations, with the rows and columns of what is held those of the identity.
    fn normal_equations(
        &self,
        data: &[(Vector3<f64>, Pixel)],
        free: Free,
        c_sq: f64,
    ) -> (SMatrix<f64, PARAMETERS, PARAMETERS>, SVector<f64, PARAMETERS>) {
        let mut hessian = SMatrix::<f64, PARAMETERS, PARAMETERS>::zeros();
        let mut gradient = SVector::<f64, PARAMETERS>::zeros();
        for (point, pixel) in data {
            let Some((residual, jacobian)) = self.linearize(point, pixel) else { continue };
            let weight = 1.0 / (1.0 + residual.norm_squared() / c_sq);
            hessian += jacobian.transpose() * jacobian * weight;
            gradient += jacobian.transpose() * residual * weight;
        }
        for (parameter, hold) in [(LOG_FOCAL, !free.focal), (K1, !(free.k1 && has_k1(&self.camera)))] {
            if hold {
                hessian.row_mut(parameter).fill(0.0);
                hessian.column_mut(parameter).fill(0.0);
                hessian[(parameter, parameter)] = 1.0;
                gradient[parameter] = 0.0;
            }
        }
        (hessian, gradient)
    }

    /// The change of the logarithm of the focal length in the first undamped step with pose and focal length free: near the
    /// least cost, all of the change there will be. None where the matches do not determine it.
    pub fn focal_pull(&self, data: &[(Vector3<f64>, Pixel)], loss_px: f64) -> Option<f64> {
        let (hessian, gradient) = self.normal_equations(data, Free { focal: true, k1: false }, loss_px * loss_px);
        Some(-hessian.cholesky()?.solve(&gradient)[LOG_FOCAL])
    }
}

fn has_k1(camera: &Camera) -> bool {
    camera.model.distortion_index() < camera.model.num_params()
}

/// The camera with the least robust cost near `start`.
pub(super) fn refine(start: PlacedCamera, data: &[(Vector3<f64>, Pixel)], free: Free, loss_px: f64) -> PlacedCamera {
    let c_sq = loss_px * loss_px;
    let mut at = start;
    let mut cost = at.cost(data, loss_px);
    let mut damping = INITIAL_DAMPING;
    let mut steps = 0;
    while steps < MAX_STEPS && damping < MAX_DAMPING && cost.is_finite() {
        let (hessian, gradient) = at.normal_equations(data, free, c_sq);
        let mut improved = false;
        while steps < MAX_STEPS && damping < MAX_DAMPING && !improved {
            steps += 1;
            let mut damped = hessian;
            for k in 0..PARAMETERS {
                damped[(k, k)] += damping * hessian[(k, k)];
            }
            let next = damped.cholesky().map(|factor| at.step(&factor.solve(&-gradient)));
            let next_cost = next.as_ref().map_or(f64::INFINITY, |next| next.cost(data, loss_px));
            match next {
                Some(next) if next_cost < cost => {
                    improved = true;
                    damping *= 0.1;
                    let fall = 1.0 - next_cost / cost;
                    (at, cost) = (next, next_cost);
                    if fall < TINY_FALL {
                        return at;
                    }
                }
                _ => damping *= 10.0,
            }
        }
        if !improved {
            break;
        }
    }
    at
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{CameraModel, FocalSource};
    use crate::math::Rng;
    use crate::solvers::test_scenes::{random_points_in_front, random_pose};

    #[test]
    fn jacobian_agrees_with_differences() {
        let mut rng = Rng::from_parts(&[1]);
        for model in CameraModel::ALL {
            let mut camera = Camera::centered(model, 1000, 800, 900.0, FocalSource::Known);
            if has_k1(&camera) {
                camera.params[model.distortion_index()] = -0.05;
            }
            let placed = PlacedCamera { cam_from_world: random_pose(&mut rng), camera };
            let [point] = random_points_in_front(&mut rng, &placed.cam_from_world);
            let pixel = Pixel::new(400.0, 300.0);
            let (_, jacobian) = placed.linearize(&point, &pixel).unwrap();
            let h = 1e-6;
            for k in 0..if has_k1(&placed.camera) { 8 } else { 7 } {
                let mut delta = SVector::<f64, PARAMETERS>::zeros();
                delta[k] = h;
                let at = |delta: &SVector<f64, PARAMETERS>| placed.step(delta).linearize(&point, &pixel).unwrap().0;
                let difference = (at(&delta) - at(&-delta)) / (2.0 * h);
                assert!((difference - jacobian.column(k)).norm() < 1e-3, "{model:?} parameter {k}");
            }
        }
    }
}
