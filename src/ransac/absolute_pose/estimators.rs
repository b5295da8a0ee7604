//! The estimators of absolute pose: with a focal length that is trusted (P3P) and with one that is not (P4Pf).

use nalgebra::{Matrix3, SMatrix, SVector, Vector2, Vector3};

use super::super::{Estimator, Models};
use crate::geometry::Rigid3;
use crate::solvers::p3p::p3p;
use crate::solvers::p4pf::p4pf;

/// Points with the positions at which a camera sees them.
pub(super) struct Correspondences<'a> {
    /// In the world.
    pub points: &'a [Vector3<f64>],
    /// Free of distortion, relative to the principal point, in pixels of square shape.
    pub seen_px: Vec<Vector2<f64>>,
    /// The focal length the camera came with, in pixels.
    pub focal_px: f64,
}

/// A pinhole camera in place. The rotation is kept as a matrix because scoring uses it most.
#[derive(Clone, Copy, Debug)]
pub(super) struct PinholePose {
    pub rotation: Matrix3<f64>,
    pub translation: Vector3<f64>,
    pub focal_px: f64,
}

impl PinholePose {
    fn new(cam_from_world: &Rigid3, focal_px: f64) -> Self {
        Self { rotation: cam_from_world.rotation_matrix(), translation: cam_from_world.translation, focal_px }
    }

    pub fn cam_from_world(&self) -> Rigid3 {
        let mut pose = Rigid3::from_matrix(&self.rotation, self.translation);
        pose.rotation.renormalize();
        pose
    }
}

impl Correspondences<'_> {
    /// In squared pixels; infinite for a point not in front.
    #[inline]
    fn residual_sq(&self, model: &PinholePose, datum: usize) -> f64 {
        let x = model.rotation * self.points[datum] + model.translation;
        if x.z <= 0.0 {
            return f64::INFINITY;
        }
        (x.xy() * (model.focal_px / x.z) - self.seen_px[datum]).norm_squared()
    }

    /// Gauss-Newton on the reprojection error of the inliers, on the pose (6) and, for `P = 7`, the logarithm of the focal.
    fn refine<const P: usize>(&self, model: &PinholePose, inliers: &[usize], threshold_sq: f64) -> Option<PinholePose> {
        let mut pose = model.cam_from_world();
        let mut focal_px = model.focal_px;
        if 2 * inliers.len() < P {
            return None;
        }
        for _ in 0..STEPS {
            let rotation = pose.rotation_matrix();
            let mut hessian = SMatrix::<f64, P, P>::zeros();
            let mut gradient = SVector::<f64, P>::zeros();
            for &datum in inliers {
                let turned = rotation * self.points[datum];
                let x = turned + pose.translation;
                if x.z <= 0.0 {
                    continue;
                }
                let inverse_z = 1.0 / x.z;
                let (u, v) = (x.x * inverse_z, x.y * inverse_z);
                let residual = Vector2::new(u, v) * focal_px - self.seen_px[datum];
                let weight = 1.0 / (1.0 + residual.norm_squared() / (CAUCHY_SHARE_SQ * threshold_sq));
                // d(u, v)/dx = 1/z [1 0 -u; 0 1 -v];  dx/d(omega, v) = [-[R X]_x | I]
                let s = focal_px * inverse_z;
                let rows = [Vector3::new(s, 0.0, -s * u), Vector3::new(0.0, s, -s * v)];
                for (axis, by_point) in rows.iter().enumerate() {
                    let by_turn = turned.cross(by_point);
                    let full = [
                        by_turn.x,
                        by_turn.y,
                        by_turn.z,
                        by_point.x,
                        by_point.y,
                        by_point.z,
                        focal_px * if axis == 0 { u } else { v },
                    ];
                    for j in 0..P {
                        let scaled = weight * full[j];
                        gradient[j] += scaled * residual[axis];
                        for i in 0..=j {
                            hessian[(i, j)] += scaled * full[i];
                        }
                    }
                }
            }
            hessian.fill_lower_triangle_with_upper_triangle();
            for k in 0..P {
                hessian[(k, k)] += DAMPING * hessian[(k, k)] + f64::MIN_POSITIVE;
            }
            let step = hessian.cholesky()?.solve(&-gradient);
            if !step.iter().all(|v: &f64| v.is_finite()) {
                return None;
            }
            pose = pose.step(&Vector3::new(step[0], step[1], step[2]), &Vector3::new(step[3], step[4], step[5]));
            if P > 6 {
                focal_px *= step[6].clamp(-MAX_LOG_FOCAL_STEP, MAX_LOG_FOCAL_STEP).exp();
            }
        }
        Some(PinholePose::new(&pose, focal_px))
    }
}

/// Gauss-Newton steps of one refinement; the robust loop repeats refinements while they pay.
const STEPS: usize = 2;
/// Damping of the normal equations relative to their diagonal, against directions the inliers leave open.
const DAMPING: f64 = 1e-9;
/// The Cauchy weight `1 / (1 + r^2 / c^2)` has `c^2` at this share of the squared inlier threshold.
const CAUCHY_SHARE_SQ: f64 = 0.1;
/// The focal length may change by this much (logarithm) a step: 1.35 times.
const MAX_LOG_FOCAL_STEP: f64 = 0.3;

/// P3P with the camera's own focal length.
pub(super) struct KnownFocal<'a>(pub &'a Correspondences<'a>);

impl Estimator<3> for KnownFocal<'_> {
    type Model = PinholePose;

    fn num_data(&self) -> usize {
        self.0.points.len()
    }

    fn solve(&self, sample: &[usize; 3], models: &mut Models<PinholePose>) {
        let focal_px = self.0.focal_px;
        let rays = sample.map(|i| self.0.seen_px[i].push(focal_px).normalize());
        for pose in p3p(&rays, &sample.map(|i| self.0.points[i])).iter() {
            models.push(PinholePose::new(pose, focal_px));
        }
    }

    #[inline]
    fn residual_sq(&self, model: &PinholePose, datum: usize) -> f64 {
        self.0.residual_sq(model, datum)
    }

    fn refine(&self, model: &PinholePose, inliers: &[usize], threshold_sq: f64) -> Option<PinholePose> {
        self.0.refine::<6>(model, inliers, threshold_sq)
    }
}

/// P4Pf.
pub(super) struct UnknownFocal<'a> {
    pub correspondences: &'a Correspondences<'a>,
    /// Focal lengths outside are impossible.
    pub focal_range_px: (f64, f64),
}

impl UnknownFocal<'_> {
    fn allows(&self, focal_px: f64) -> bool {
        focal_px >= self.focal_range_px.0 && focal_px <= self.focal_range_px.1
    }
}

impl Estimator<4> for UnknownFocal<'_> {
    type Model = PinholePose;

    fn num_data(&self) -> usize {
        self.correspondences.points.len()
    }

    fn solve(&self, sample: &[usize; 4], models: &mut Models<PinholePose>) {
        let unit_px = self.correspondences.focal_px;
        let seen = sample.map(|i| self.correspondences.seen_px[i] / unit_px);
        for found in p4pf(&seen, &sample.map(|i| self.correspondences.points[i])).iter() {
            let focal_px = found.focal * unit_px;
            if self.allows(focal_px) {
                models.push(PinholePose::new(&found.cam_from_world, focal_px));
            }
        }
    }

    #[inline]
    fn residual_sq(&self, model: &PinholePose, datum: usize) -> f64 {
        self.correspondences.residual_sq(model, datum)
    }

    fn refine(&self, model: &PinholePose, inliers: &[usize], threshold_sq: f64) -> Option<PinholePose> {
        let refined = self.correspondences.refine::<7>(model, inliers, threshold_sq)?;
        self.allows(refined.focal_px).then_some(refined)
    }
}
