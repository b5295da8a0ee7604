//! Descriptor matching: exact nearest neighbours among descriptors, ratio test and cross-check.

pub mod cells;
pub mod clusters;
pub mod descriptor;
mod mutual;
pub mod standing;
pub mod two_view;

pub use mutual::{MatchOptions, RatioTest, match_mutual, match_mutual_packed, mutual_matches};
