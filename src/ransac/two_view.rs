//! Estimators of two-view models: essential and fundamental matrix, homography, and a fundamental matrix with a known plane.

use nalgebra::{Matrix3, Vector2};

use super::sampson::{EssentialParameters, FundamentalParameters, refine_sampson};
use super::{Estimator, Models};
use crate::geometry::epipolar::{cross_matrix, sampson_error_sq};
use crate::solvers::five_point::five_point;
use crate::solvers::homography::{homography_dlt, homography_four_point};
use crate::solvers::seven_point::seven_point;

/// The positions of one point in two images, free of distortion and of order 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PointPair {
    /// In image a.
    pub a: Vector2<f64>,
    /// In image b.
    pub b: Vector2<f64>,
}

fn positions<const N: usize>(pairs: &[PointPair], sample: &[usize; N]) -> ([Vector2<f64>; N], [Vector2<f64>; N]) {
    (sample.map(|i| pairs[i].a), sample.map(|i| pairs[i].b))
}

/// Essential matrices (five-point solver, Sampson residuals) of pairs on the planes z = 1.
pub struct EssentialEstimator<'a>(pub &'a [PointPair]);

impl Estimator<5> for EssentialEstimator<'_> {
    type Model = Matrix3<f64>;

    fn num_data(&self) -> usize {
        self.0.len()
    }

    fn solve(&self, sample: &[usize; 5], models: &mut Models<Self::Model>) {
        let (a, b) = positions(self.0, sample);
        five_point(&a, &b).iter().for_each(|essential| models.push(*essential));
    }

    #[inline]
    fn residual_sq(&self, model: &Self::Model, datum: usize) -> f64 {
        sampson_error_sq(model, &self.0[datum].a, &self.0[datum].b)
    }

    fn refine(&self, model: &Self::Model, inliers: &[usize], threshold_sq: f64) -> Option<Self::Model> {
        refine_sampson(EssentialParameters::new(model)?, self.0, inliers, threshold_sq)
    }
}

/// Fundamental matrices (seven-point solver, Sampson residuals).
pub struct FundamentalEstimator<'a>(pub &'a [PointPair]);

impl Estimator<7> for FundamentalEstimator<'_> {
    type Model = Matrix3<f64>;

    fn num_data(&self) -> usize {
        self.0.len()
    }

    fn solve(&self, sample: &[usize; 7], models: &mut Models<Self::Model>) {
        let (a, b) = positions(self.0, sample);
        for fundamental in seven_point(&a, &b).iter() {
            if same_orientation(fundamental, &a, &b) {
                models.push(*fundamental);
            }
        }
    }

    #[inline]
    fn residual_sq(&self, model: &Self::Model, datum: usize) -> f64 {
        sampson_error_sq(model, &self.0[datum].a, &self.0[datum].b)
    }

    fn refine(&self, model: &Self::Model, inliers: &[usize], threshold_sq: f64) -> Option<Self::Model> {
        refine_sampson(FundamentalParameters::new(model)?, self.0, inliers, threshold_sq)
    }
}

/// The oriented epipolar constraint: `e_b x x_b ~ F x_a` must hold with one sign for all pairs of a sample, or some points
/// lie behind a camera (Chum, Werner, Matas, "Epipolar Geometry Estimation via RANSAC Benefits from the Oriented Epipolar
/// Constraint", ICPR 2004).
fn same_orientation<const N: usize>(f: &Matrix3<f64>, a: &[Vector2<f64>; N], b: &[Vector2<f64>; N]) -> bool {
    // The left null vector, as the longest cross product of two columns.
    let (c0, c1, c2) = (f.column(0), f.column(1), f.column(2));
    let crosses = [c0.cross(&c1), c1.cross(&c2), c2.cross(&c0)];
    let epipole =
        crosses.iter().fold(crosses[0], |best, c| if c.norm_squared() > best.norm_squared() { *c } else { best });
    let sign = |i: usize| epipole.cross(&b[i].push(1.0)).dot(&(f * a[i].push(1.0)));
    let first = sign(0);
    (1..N).all(|i| first * sign(i) > 0.0)
}

/// A homography with its inverse.
#[derive(Clone, Copy, Debug)]
pub struct HomographyModel {
    /// `x_b ~ H x_a`, of unit Frobenius norm.
    pub b_from_a: Matrix3<f64>,
    /// Its inverse.
    pub a_from_b: Matrix3<f64>,
}

impl HomographyModel {
    fn new(b_from_a: Matrix3<f64>) -> Option<Self> {
        let a_from_b = b_from_a.try_inverse()?;
        a_from_b.iter().all(|v| v.is_finite()).then_some(Self { b_from_a, a_from_b })
    }
}

/// Homographies (four-point solver); the squared residual is the mean of the squared transfer errors of both directions.
pub struct HomographyEstimator<'a>(pub &'a [PointPair]);

#[inline]
fn transfer_error_sq(h: &Matrix3<f64>, from: &Vector2<f64>, to: &Vector2<f64>) -> f64 {
    let mapped = h * from.push(1.0);
    (mapped.xy() / mapped.z - to).norm_squared()
}

impl Estimator<4> for HomographyEstimator<'_> {
    type Model = HomographyModel;

    fn num_data(&self) -> usize {
        self.0.len()
    }

    fn solve(&self, sample: &[usize; 4], models: &mut Models<Self::Model>) {
        let (a, b) = positions(self.0, sample);
        if let Some(model) = homography_four_point(&a, &b).and_then(HomographyModel::new) {
            models.push(model);
        }
    }

    #[inline]
    fn residual_sq(&self, model: &Self::Model, datum: usize) -> f64 {
        let PointPair { a, b } = &self.0[datum];
        0.5 * (transfer_error_sq(&model.b_from_a, a, b) + transfer_error_sq(&model.a_from_b, b, a))
    }

    fn refine(&self, _: &Self::Model, inliers: &[usize], _: f64) -> Option<Self::Model> {
        HomographyModel::new(homography_dlt(inliers.iter().map(|&i| (self.0[i].a, self.0[i].b)))?)
    }
}

/// Fundamental matrices of a scene most of which lies on a plane with homography `H`: two pairs off the plane fix the rest.
///
/// The line through `H x_a` and `x_b` passes through the epipole, so two pairs give
/// `e_b = (H x_a1 x x_b1) x (H x_a2 x x_b2)` and `F = [e_b]_x H` (plane and parallax; the remedy of Chum, Werner, Matas,
/// "Two-View Geometry Estimation Unaffected by a Dominant Plane", CVPR 2005).
pub struct PlaneAndParallaxEstimator<'a> {
    /// All pairs.
    pub pairs: &'a [PointPair],
    /// The homography of the plane.
    pub b_from_a: Matrix3<f64>,
    /// The pairs off the plane: the data samples are drawn from and models scored on.
    pub off_plane: Vec<usize>,
}

impl Estimator<2> for PlaneAndParallaxEstimator<'_> {
    type Model = Matrix3<f64>;

    fn num_data(&self) -> usize {
        self.off_plane.len()
    }

    fn solve(&self, sample: &[usize; 2], models: &mut Models<Self::Model>) {
        let [first, second] = sample.map(|i| {
            let PointPair { a, b } = &self.pairs[self.off_plane[i]];
            (self.b_from_a * a.push(1.0)).cross(&b.push(1.0))
        });
        let fundamental = cross_matrix(&first.cross(&second)) * self.b_from_a;
        let norm = fundamental.norm();
        if norm > f64::MIN_POSITIVE && norm.is_finite() {
            models.push(fundamental / norm);
        }
    }

    #[inline]
    fn residual_sq(&self, model: &Self::Model, datum: usize) -> f64 {
        let PointPair { a, b } = &self.pairs[self.off_plane[datum]];
        sampson_error_sq(model, a, b)
    }

    fn refine(&self, _: &Self::Model, _: &[usize], _: f64) -> Option<Self::Model> {
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::epipolar::essential_from_pose;
    use crate::math::Rng;
    use crate::ransac::{RansacOptions, ransac};
    use crate::solvers::test_scenes::{random_pairs, random_relative_pose};

    const THRESHOLD: f64 = 0.003;

    /// 200 pairs with noise 0.0005, the first `outliers` of them random in b.
    fn scene(rng: &mut Rng, outliers: usize) -> (Matrix3<f64>, Vec<PointPair>) {
        let b_from_a = random_relative_pose(rng);
        let (a, b) = random_pairs::<200>(rng, &b_from_a);
        let mut pairs = Vec::new();
        for i in 0..200 {
            let mut shake = || Vector2::new(rng.normal(), rng.normal()) * 5e-4;
            let (a, mut b) = (a[i] + shake(), b[i] + shake());
            if i < outliers {
                b = Vector2::new(rng.range(-0.8, 0.8), rng.range(-0.8, 0.8));
            }
            pairs.push(PointPair { a, b });
        }
        (essential_from_pose(&b_from_a).unwrap(), pairs)
    }

    fn true_inliers(truth: &Matrix3<f64>, pairs: &[PointPair]) -> usize {
        pairs.iter().filter(|p| sampson_error_sq(truth, &p.a, &p.b) < THRESHOLD * THRESHOLD).count()
    }

    #[test]
    fn epipolar_matrices_survive_many_outliers() {
        let mut rng = Rng::from_parts(&[1]);
        let options = RansacOptions { min_inlier_ratio: 0.2, max_trials: 20_000, ..RansacOptions::default() };
        let mut poor = (0, 0);
        for round in 0..40 {
            let outliers = [0, 60, 100, 140][round % 4];
            let (truth, pairs) = scene(&mut rng, outliers);
            let wanted = true_inliers(&truth, &pairs) as f64 * 0.97;
            let e = ransac(&EssentialEstimator(&pairs), THRESHOLD, &options, &mut rng).unwrap();
            poor.0 += usize::from((e.num_inliers as f64) < wanted);
            if outliers <= 100 {
                let f = ransac(&FundamentalEstimator(&pairs), THRESHOLD, &options, &mut rng).unwrap();
                poor.1 += usize::from((f.num_inliers as f64) < wanted);
            }
        }
        assert!(poor.0 <= 1 && poor.1 <= 1, "{poor:?} of 40 and 30 runs fell short");
    }

    #[test]
    fn a_homography_survives_many_outliers() {
        let mut rng = Rng::from_parts(&[2]);
        let h = Matrix3::new(1.0, 0.1, 0.2, -0.1, 0.9, 0.1, 0.1, 0.05, 1.0);
        let pairs: Vec<_> = (0..200)
            .map(|i| {
                let a = Vector2::new(rng.range(-0.8, 0.8), rng.range(-0.8, 0.8));
                let mapped = h * a.push(1.0);
                let b = if i < 140 { Vector2::new(rng.normal(), rng.normal()) } else { mapped.xy() / mapped.z };
                PointPair { a, b }
            })
            .collect();
        let report = ransac(&HomographyEstimator(&pairs), THRESHOLD, &RansacOptions::default(), &mut rng).unwrap();
        assert!((60..64).contains(&report.num_inliers));
    }
}
