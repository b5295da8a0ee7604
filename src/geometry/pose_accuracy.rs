//! How well the poses of a model agree with a reference.
//!
//! Two kinds of measures. After a robust similarity alignment of the camera centres: the distances of the centres and the
//! angles between the rotations of the images that both have. Without any alignment, over *all* pairs of reference images: the
//! error of a pair is the larger of the angle between both relative rotations and the angle between both directions from
//! one camera to the other, 180 degrees when the model lacks one of the images; the area under the share of pairs below a
//! threshold, from 0 to the threshold, is the AUC in per cent.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use super::{Rigid3, align_robustly};
use crate::math::Rng;

/// Thresholds of the AUC in degrees.
pub const AUC_THRESHOLDS_DEG: [f64; 4] = [1.0, 3.0, 5.0, 10.0];

/// Centres further from their place than this part of the mean camera distance do not take part in the alignment.
const ALIGNMENT_LIMIT: f64 = 0.05;

/// Reference cameras nearer to each other than this part of the mean distance have no direction between them.
const COINCIDENT: f64 = 1e-6;

/// Accuracy of a model's poses.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseAccuracy {
    /// Images of the reference.
    pub reference_images: usize,
    /// Of these, images of the model.
    pub registered: usize,
    /// Images of the model that the reference lacks.
    pub extra: usize,
    /// Errors after alignment; null when fewer than three images are common or they do not fix a similarity.
    pub aligned: Option<AlignedErrors>,
    /// Area under the curve at 1, 3, 5 and 10 degrees, in per cent; null when the reference has no pair.
    pub auc_percent: Option<[f64; 4]>,
}

/// Errors of the common images after alignment.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AlignedErrors {
    /// Distance of the centres, in units of the reference.
    pub center: Spread,
    /// The mean of the same, relative to the mean distance between two cameras of the reference.
    pub center_mean_relative: f64,
    /// Angle between the rotations.
    pub rotation_deg: Spread,
}

/// Mean, median and maximum.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Spread {
    /// Mean.
    pub mean: f64,
    /// Median (the mean of the middle two of an even number).
    pub median: f64,
    /// Maximum.
    pub max: f64,
}

/// Compares poses `cam_from_world` by image name.
pub fn pose_accuracy(model: &BTreeMap<String, Rigid3>, reference: &BTreeMap<String, Rigid3>) -> PoseAccuracy {
    let common: Vec<(&Rigid3, &Rigid3)> =
        reference.iter().filter_map(|(name, pose)| Some((model.get(name)?, pose))).collect();
    let unit = mean_distance(reference);
    PoseAccuracy {
        reference_images: reference.len(),
        registered: common.len(),
        extra: model.keys().filter(|name| !reference.contains_key(*name)).count(),
        aligned: aligned_errors(&common, unit),
        auc_percent: auc_percent(&pair_errors_deg(model, reference, unit)),
    }
}

fn mean_distance(poses: &BTreeMap<String, Rigid3>) -> f64 {
    let centers: Vec<Vector3<f64>> = poses.values().map(Rigid3::target_origin_in_source).collect();
    let (mut sum, mut pairs) = (0.0, 0usize);
    for (at, a) in centers.iter().enumerate() {
        for b in &centers[at + 1..] {
            sum += (a - b).norm();
            pairs += 1;
        }
    }
    if pairs == 0 { 0.0 } else { sum / pairs as f64 }
}

fn aligned_errors(common: &[(&Rigid3, &Rigid3)], unit: f64) -> Option<AlignedErrors> {
    let centers = |poses: Vec<&Rigid3>| poses.into_iter().map(Rigid3::target_origin_in_source).collect::<Vec<_>>();
    let source = centers(common.iter().map(|pair| pair.0).collect());
    let target = centers(common.iter().map(|pair| pair.1).collect());
    let mut rng = Rng::from_parts(&[common.len() as u64]);
    let reference_from_model = align_robustly(&source, &target, ALIGNMENT_LIMIT * unit, &mut rng)?;
    let distances = source.iter().zip(&target).map(|(x, y)| (reference_from_model.apply(x) - y).norm()).collect();
    let angles = common
        .iter()
        .map(|(pose, truth)| {
            let turned = reference_from_model.transform_pose(pose);
            angle_deg(&(turned.rotation_matrix() * truth.rotation_matrix().transpose()))
        })
        .collect();
    let center = spread(distances)?;
    Some(AlignedErrors { center, center_mean_relative: center.mean / unit, rotation_deg: spread(angles)? })
}

fn spread(mut values: Vec<f64>) -> Option<Spread> {
    values.sort_by(f64::total_cmp);
    let (n, max) = (values.len(), *values.last()?);
    let median = 0.5 * (values[(n - 1) / 2] + values[n / 2]);
    Some(Spread { mean: values.iter().sum::<f64>() / n as f64, median, max })
}

/// The angle of a rotation matrix.
fn angle_deg(rotation: &Matrix3<f64>) -> f64 {
    (0.5 * (rotation.trace() - 1.0)).clamp(-1.0, 1.0).acos().to_degrees()
}

fn pair_errors_deg(model: &BTreeMap<String, Rigid3>, reference: &BTreeMap<String, Rigid3>, unit: f64) -> Vec<f64> {
    /// A pose as the matrix and the centre, and what the model has of it.
    struct Both {
        truth: (Matrix3<f64>, Vector3<f64>),
        found: Option<(Matrix3<f64>, Vector3<f64>)>,
    }
    let parts = |pose: &Rigid3| (pose.rotation_matrix(), pose.target_origin_in_source());
    let images: Vec<Both> =
        reference.iter().map(|(name, pose)| Both { truth: parts(pose), found: model.get(name).map(parts) }).collect();
    let mut errors = Vec::new();
    for (at, a) in images.iter().enumerate() {
        for b in &images[at + 1..] {
            let (Some((a_rotation, a_center)), Some((b_rotation, b_center))) = (&a.found, &b.found) else {
                errors.push(180.0);
                continue;
            };
            let relative = b_rotation * a_rotation.transpose();
            let true_relative = b.truth.0 * a.truth.0.transpose();
            let rotation_deg = angle_deg(&(relative * true_relative.transpose()));
            let direction = a_rotation * (b_center - a_center);
            let true_direction = a.truth.0 * (b.truth.1 - a.truth.1);
            let (length, true_length) = (direction.norm(), true_direction.norm());
            let direction_deg = if length > 0.0 && true_length > COINCIDENT * unit {
                (direction.dot(&true_direction) / (length * true_length)).clamp(-1.0, 1.0).acos().to_degrees()
            } else {
                0.0
            };
            errors.push(rotation_deg.max(direction_deg));
        }
    }
    errors
}

/// The exact area under the recall curve: the mean of `max(0, threshold - error) / threshold`.
fn auc_percent(errors_deg: &[f64]) -> Option<[f64; 4]> {
    (!errors_deg.is_empty()).then(|| {
        AUC_THRESHOLDS_DEG.map(|threshold| {
            let area: f64 = errors_deg.iter().map(|error| (threshold - error).max(0.0)).sum();
            100.0 * area / (errors_deg.len() as f64 * threshold)
        })
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::Sim3;
    use nalgebra::UnitQuaternion;

    fn ring(n: usize) -> BTreeMap<String, Rigid3> {
        (0..n)
            .map(|k| {
                let angle = std::f64::consts::TAU * k as f64 / n as f64;
                let center = Vector3::new(angle.cos(), angle.sin(), 0.1 * (3.0 * angle).sin());
                let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, angle, -0.2));
                (format!("{k:02}"), Rigid3::from_center(rotation, &center))
            })
            .collect()
    }

    fn moved(poses: &BTreeMap<String, Rigid3>) -> BTreeMap<String, Rigid3> {
        let sim = Sim3 {
            scale: 0.2,
            rotation: UnitQuaternion::from_scaled_axis(Vector3::new(1.0, 0.4, -0.8)),
            translation: Vector3::new(3.0, 2.0, 1.0),
        };
        poses.iter().map(|(name, pose)| (name.clone(), sim.transform_pose(pose))).collect()
    }

    #[test]
    fn a_similar_model_is_perfect() {
        let accuracy = pose_accuracy(&moved(&ring(10)), &ring(10));
        let aligned = accuracy.aligned.unwrap();
        assert!(aligned.center.max < 1e-9 && aligned.rotation_deg.max < 1e-5);
        assert!(accuracy.auc_percent.unwrap().iter().all(|auc| *auc > 99.99));
        assert_eq!((accuracy.reference_images, accuracy.registered, accuracy.extra), (10, 10, 0));
    }

    #[test]
    fn missing_images_fail_all_their_pairs() {
        let mut model = moved(&ring(10));
        model.remove("03");
        model.insert("stray".into(), Rigid3::identity());
        let accuracy = pose_accuracy(&model, &ring(10));
        assert_eq!((accuracy.registered, accuracy.extra), (9, 1));
        assert!((accuracy.auc_percent.unwrap()[2] - 80.0).abs() < 0.01, "36 of 45 pairs");
    }

    #[test]
    fn a_turned_camera_counts_by_its_angle() {
        let mut model = ring(10);
        let pose = model["04"];
        let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 0.0, 2f64.to_radians()));
        model.insert("04".into(), Rigid3::from_center(turn * pose.rotation, &pose.target_origin_in_source()));
        let accuracy = pose_accuracy(&model, &ring(10));
        let aligned = accuracy.aligned.unwrap();
        assert!((aligned.rotation_deg.max - 2.0).abs() < 1e-6 && aligned.rotation_deg.median < 1e-5);
        // 9 of 45 pairs are off by 2 degrees (their directions by less).
        assert!((accuracy.auc_percent.unwrap()[2] - 100.0 * (36.0 + 9.0 * 0.6) / 45.0).abs() < 0.01);
        assert_eq!(accuracy.auc_percent.unwrap()[0].round(), 80.0);
    }

    #[test]
    fn few_images_have_no_alignment() {
        let accuracy = pose_accuracy(&ring(2), &ring(2));
        assert!(accuracy.aligned.is_none() && accuracy.auc_percent.is_some());
        let accuracy = pose_accuracy(&BTreeMap::new(), &BTreeMap::new());
        assert!(accuracy.aligned.is_none() && accuracy.auc_percent.is_none());
    }
}
