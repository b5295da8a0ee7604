//! Rigid and similar transforms, two-view algebra, triangulation and alignment.
//!
//! Frames: a camera looks along +z, x to the right, y down. Poses are `target_from_source`; points `x_in_frame`.
//! Angles are radians unless a name ends in `_deg`.

mod alignment;
pub mod epipolar;
pub mod focal_voting;
pub mod homography;
mod pose_accuracy;
mod rigid3;
pub mod triangulation;

pub use alignment::{Sim3, align, align_robustly};
pub use pose_accuracy::{AUC_THRESHOLDS_DEG, AlignedErrors, PoseAccuracy, Spread, pose_accuracy};
pub use rigid3::Rigid3;
