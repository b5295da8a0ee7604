//! What feature extraction leaves of an image.

use bytemuck::{Pod, Zeroable};

/// Length of a SIFT descriptor.
pub const DESCRIPTOR_LEN: usize = 128;

/// A RootSIFT descriptor quantised to bytes: `round(512 * sqrt(v / |v|_1))`, capped at 255, so its squared length is
/// about 512^2.
pub type Descriptor = [u8; DESCRIPTOR_LEN];

/// A scale-space keypoint in pixels of the original image (first pixel centre at 0.5, 0.5).
#[derive(Clone, Copy, Debug, PartialEq, Pod, Zeroable)]
#[repr(C)]
pub struct Keypoint {
    /// Column, to the right.
    pub x: f32,
    /// Row, downwards.
    pub y: f32,
    /// Scale (sigma of the scale-space level), in pixels of the original image.
    pub scale: f32,
    /// Orientation in radians, in [0, 2 pi), turning from +x to +y (clockwise on the screen).
    pub orientation: f32,
}

/// All features of one image, sorted by descending scale (ties by y, x, orientation), as the paper's section 4 needs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Features {
    /// The keypoints.
    pub keypoints: Vec<Keypoint>,
    /// The descriptor of each keypoint.
    pub descriptors: Vec<Descriptor>,
}

impl Features {
    /// Number of features.
    pub fn len(&self) -> usize {
        self.keypoints.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.keypoints.is_empty()
    }
}
