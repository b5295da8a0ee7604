//! The colours of a photograph, changed to RGB only where they are asked for.

use super::{Decoded, convert};
use crate::scene::RgbImage;

/// What the three bytes of a pixel are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum StoredAs {
    /// Red, green and blue.
    Rgb,
    /// Luma and two differences, as in JPEG files.
    YCbCr,
}

/// The colours of a photograph. A JPEG's are kept as the file has them: a cloud asks for a few thousand, and a change of all
/// costs as much as finding the features of the coarser octaves. Averages are the same before and after it, as it is linear.
#[derive(Clone, Debug, PartialEq)]
pub struct Colors {
    raster: Decoded<RgbImage>,
    stored_as: StoredAs,
}

impl Colors {
    /// Of a full-size raster, reduced by the largest whole number that leaves the longer side at least `least_long_side`.
    pub(super) fn new(raster: RgbImage, stored_as: StoredAs, least_long_side: Option<u32>) -> Self {
        Self { raster: convert::shrink_rgb_by_whole(raster, least_long_side), stored_as }
    }

    /// Columns and rows that are kept.
    pub fn size(&self) -> (usize, usize) {
        (self.raster.image.width, self.raster.image.height)
    }

    /// The colour at a position in pixels of the original (first pixel centre at 0.5, 0.5); beyond the border that of the
    /// nearest pixel.
    pub fn at(&self, x: f64, y: f64) -> [u8; 3] {
        let [across, down] = self.raster.to_original;
        self.stored_as.to_rgb(self.raster.image.at(x / across, y / down))
    }

    /// The whole photograph in RGB, its longer side reduced to `max_long_side` where it is longer.
    pub fn thumbnail(self, max_long_side: u32) -> RgbImage {
        let stored_as = self.stored_as;
        let mut small = convert::shrink_rgb(self.raster.image, Some(max_long_side)).image;
        for pixel in small.data.as_chunks_mut::<3>().0 {
            *pixel = stored_as.to_rgb(*pixel);
        }
        small
    }
}

impl StoredAs {
    fn to_rgb(self, color: [u8; 3]) -> [u8; 3] {
        match self {
            Self::Rgb => color,
            Self::YCbCr => convert::ycbcr_to_rgb(color),
        }
    }
}
