//! Plain 8-bit rasters, row-major, without padding.

/// A grey image, one byte a pixel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GrayImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `width * height` grey values, row by row.
    pub data: Vec<u8>,
}

/// A colour image, three bytes (red, green, blue) a pixel.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct RgbImage {
    /// Columns.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// `3 * width * height` values, row by row.
    pub data: Vec<u8>,
}

impl GrayImage {
    /// Wraps `data`, which must hold `width * height` bytes.
    ///
    /// # Panics
    /// When the length does not match.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Self {
        assert_eq!(data.len(), width * height, "grey raster of the wrong length");
        Self { width, height, data }
    }
}

impl RgbImage {
    /// Wraps `data`, which must hold `3 * width * height` bytes.
    ///
    /// # Panics
    /// When the length does not match.
    pub fn new(width: usize, height: usize, data: Vec<u8>) -> Self {
        assert_eq!(data.len(), 3 * width * height, "colour raster of the wrong length");
        Self { width, height, data }
    }

    /// The colour of the pixel that holds `(x, y)` (pixel coordinates, first pixel centre at 0.5, 0.5), clamped to the
    /// border.
    pub fn at(&self, x: f64, y: f64) -> [u8; 3] {
        let column = (x.max(0.0) as usize).min(self.width - 1);
        let row = (y.max(0.0) as usize).min(self.height - 1);
        let offset = 3 * (row * self.width + column);
        [self.data[offset], self.data[offset + 1], self.data[offset + 2]]
    }
}
