//! The camera models, in COLMAP's numbering and parameter order.

use serde::{Deserialize, Serialize};

/// The most parameters any model has.
pub const MAX_PARAMS: usize = 8;

/// A camera model. Names and parameter order are COLMAP's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(rename_all = "SCREAMING_SNAKE_CASE")]
pub enum CameraModel {
    /// `f, cx, cy`
    SimplePinhole,
    /// `fx, fy, cx, cy`
    Pinhole,
    /// `f, cx, cy, k1`
    SimpleRadial,
    /// `f, cx, cy, k1, k2`
    Radial,
    /// `fx, fy, cx, cy, k1, k2, p1, p2`
    #[serde(rename = "OPENCV")]
    OpenCv,
}

impl CameraModel {
    /// Every model.
    pub const ALL: [Self; 5] = [Self::SimplePinhole, Self::Pinhole, Self::SimpleRadial, Self::Radial, Self::OpenCv];

    /// COLMAP's number of the model.
    pub fn colmap_id(self) -> i32 {
        self as i32
    }

    /// The model of COLMAP's number.
    pub fn from_colmap_id(id: i32) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.colmap_id() == id)
    }

    /// COLMAP's name of the model.
    pub fn colmap_name(self) -> &'static str {
        match self {
            Self::SimplePinhole => "SIMPLE_PINHOLE",
            Self::Pinhole => "PINHOLE",
            Self::SimpleRadial => "SIMPLE_RADIAL",
            Self::Radial => "RADIAL",
            Self::OpenCv => "OPENCV",
        }
    }

    /// The model of COLMAP's name.
    pub fn from_colmap_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|model| model.colmap_name() == name)
    }

    /// Number of parameters.
    pub fn num_params(self) -> usize {
        match self {
            Self::SimplePinhole => 3,
            Self::Pinhole | Self::SimpleRadial => 4,
            Self::Radial => 5,
            Self::OpenCv => 8,
        }
    }

    /// Whether fx and fy are separate parameters (0 and 1); otherwise parameter 0 is both.
    pub fn has_two_focals(self) -> bool {
        matches!(self, Self::Pinhole | Self::OpenCv)
    }

    /// Index of cx; cy follows.
    pub fn principal_point_index(self) -> usize {
        if self.has_two_focals() { 2 } else { 1 }
    }

    /// Index of the first distortion coefficient (equal to `num_params` where there is none).
    pub fn distortion_index(self) -> usize {
        self.principal_point_index() + 2
    }
}
