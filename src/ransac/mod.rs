//! Robust estimation: a loop that knows no geometry, and its estimators.

pub mod absolute_pose;
mod driver;
mod sampson;
mod two_view;

pub use driver::{Estimator, MAX_MODELS, Models, RansacOptions, RansacReport, ransac};
pub use two_view::{
    EssentialEstimator, FundamentalEstimator, HomographyEstimator, HomographyModel, PlaneAndParallaxEstimator,
    PointPair,
};
