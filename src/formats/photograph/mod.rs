//! Photographs: JPEG, PNG, TIFF (8 and 16 bit) and WebP to 8-bit rasters.
//!
//! A file is judged by its content, never by its name, and before any of its pixels is decoded: format, size and
//! completeness come from the headers and the container's structure. Decoders run behind a panic guard, as their authors'
//! fuzzers still find panics in them. The rasters stay in the sensor's frame: the orientation tag is never applied.

mod colors;
mod convert;
mod jpeg;
mod sniff;

use std::io::{self, Cursor};
use std::panic::{AssertUnwindSafe, catch_unwind};

use image::{DynamicImage, ImageDecoder, ImageError, ImageReader};
use serde::{Deserialize, Serialize};

use super::exif::Exif;
use crate::scene::{GrayImage, RgbImage};

use colors::StoredAs;

pub use colors::Colors;

/// A file format, recognised by content.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum PhotographFormat {
    /// JPEG, baseline or progressive; grey, colour or CMYK.
    Jpeg,
    /// PNG.
    Png,
    /// TIFF.
    Tiff,
    /// WebP, lossy or lossless.
    Webp,
}

/// Which sizes are accepted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PhotographLimits {
    /// Shorter sides below this many pixels are too small to hold features worth matching.
    pub min_side_px: u32,
    /// Photographs of more than this many million pixels are refused; the largest sensors have 200.
    pub max_megapixels: f64,
}

impl Default for PhotographLimits {
    fn default() -> Self {
        Self { min_side_px: 64, max_megapixels: 250.0 }
    }
}

impl PhotographLimits {
    /// Adds what is wrong with the values to `errors`.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if self.min_side_px == 0 {
            errors.push("min_side_px must be at least 1".into());
        }
        // Above this, byte counts of intermediate rasters would no longer be safe to compute with.
        if !(self.max_megapixels > 0.0 && self.max_megapixels <= 4000.0) {
            errors.push("max_megapixels must be above 0 and at most 4000".into());
        }
    }
}

/// What the headers of a photograph say.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PhotographInfo {
    /// The format of the file.
    pub format: PhotographFormat,
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// How it was taken, as far as known.
    pub exif: Exif,
}

/// Why a file is no usable photograph.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum PhotographError {
    /// It is no image, or a damaged one.
    #[error("the file is not a readable image: {0}")]
    Unreadable(String),
    /// It ends too early.
    #[error("the file is cut short: {0}")]
    Truncated(String),
    /// Its shorter side is below the limit.
    #[error("the picture has only {width} x {height} pixels; the shorter side must have at least {min_side_px}")]
    TooSmall {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// The limit.
        min_side_px: u32,
    },
    /// It has more pixels than the limit.
    #[error("the picture has {width} x {height} pixels; at most {max_megapixels} million are accepted")]
    TooLarge {
        /// Columns.
        width: u32,
        /// Rows.
        height: u32,
        /// The limit.
        max_megapixels: f64,
    },
    /// It is an image of a kind that can't be read here.
    #[error("the image format is not supported: {0}")]
    UnsupportedFormat(String),
}

impl PhotographError {
    /// A stable, machine-readable code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Unreadable(_) => "unreadable",
            Self::Truncated(_) => "truncated",
            Self::TooSmall { .. } => "too_small",
            Self::TooLarge { .. } => "too_large",
            Self::UnsupportedFormat(_) => "unsupported_format",
        }
    }
}

/// A raster and how its pixels map back to the file's.
#[derive(Clone, Debug, PartialEq)]
pub struct Decoded<T> {
    /// The pixels.
    pub image: T,
    /// Columns of the original for one column of the raster, and likewise rows: `x_original = x * to_original[0]`. At
    /// least 1, and 1 when nothing was scaled. (They may differ slightly, as both sides are rounded to whole pixels.)
    pub to_original: [f64; 2],
}

/// A file whose headers passed.
#[derive(Clone, Debug)]
pub struct Photograph<'a> {
    bytes: &'a [u8],
    info: PhotographInfo,
}

/// The headers of a photograph, when it passes; no pixel is decoded.
///
/// # Errors
/// Why it does not.
pub fn inspect(bytes: &[u8], limits: &PhotographLimits) -> Result<PhotographInfo, PhotographError> {
    Ok(Photograph::open(bytes, limits)?.info)
}

impl<'a> Photograph<'a> {
    /// Judges a file by its headers and its container's structure.
    ///
    /// # Errors
    /// Why it is no usable photograph.
    pub fn open(bytes: &'a [u8], limits: &PhotographLimits) -> Result<Self, PhotographError> {
        let format = sniff::format(bytes)?;
        let (width, height) = guarded(|| match format {
            PhotographFormat::Jpeg => jpeg::header(bytes).map(|header| (header.width, header.height)),
            _ => Ok(decoder(bytes, format, MAX_HEADER_BYTES)?.dimensions()),
        })?;
        let &PhotographLimits { min_side_px, max_megapixels } = limits;
        if width.min(height) < min_side_px.max(1) {
            return Err(PhotographError::TooSmall { width, height, min_side_px });
        }
        if f64::from(width) * f64::from(height) > max_megapixels * 1e6 {
            return Err(PhotographError::TooLarge { width, height, max_megapixels });
        }
        sniff::check_complete(bytes, format)?;
        Ok(Self { bytes, info: PhotographInfo { format, width, height, exif: Exif::read(bytes) } })
    }

    /// What the headers say.
    pub fn info(&self) -> &PhotographInfo {
        &self.info
    }

    /// The photograph in grey (ITU-R BT.601 luma), its longer side reduced to `max_long_side` where it is longer.
    ///
    /// # Errors
    /// When the pixels can't be decoded.
    pub fn decode_gray(&self, max_long_side: Option<u32>) -> Result<Decoded<GrayImage>, PhotographError> {
        let image = guarded(|| match self.info.format {
            PhotographFormat::Jpeg => jpeg::decode_gray(self.bytes),
            _ => Ok(convert::to_gray(&self.decode_dynamic()?)),
        })?;
        Ok(convert::shrink_gray(image, max_long_side))
    }

    /// The photograph in colour, its longer side reduced to `max_long_side` where it is longer.
    ///
    /// # Errors
    /// When the pixels can't be decoded.
    pub fn decode_rgb(&self, max_long_side: Option<u32>) -> Result<Decoded<RgbImage>, PhotographError> {
        let image = guarded(|| match self.info.format {
            PhotographFormat::Jpeg => jpeg::decode_rgb(self.bytes),
            _ => Ok(convert::to_rgb(&self.decode_dynamic()?)),
        })?;
        Ok(convert::shrink_rgb(image, max_long_side))
    }

    /// [`Photograph::decode_gray`] and the colours from one reading of the file. The colours are reduced by the largest whole
    /// number that leaves their longer side at least `least_long_side_colors`.
    ///
    /// # Errors
    /// When the pixels can't be decoded.
    pub fn decode_gray_and_colors(
        &self,
        max_long_side_gray: Option<u32>,
        least_long_side_colors: Option<u32>,
    ) -> Result<(Decoded<GrayImage>, Colors), PhotographError> {
        let (gray, raster, stored_as) = guarded(|| match self.info.format {
            PhotographFormat::Jpeg => jpeg::decode_gray_and_colors(self.bytes),
            _ => {
                let image = self.decode_dynamic()?;
                Ok((convert::to_gray(&image), convert::to_rgb(&image), StoredAs::Rgb))
            }
        })?;
        let colors = Colors::new(raster, stored_as, least_long_side_colors);
        Ok((convert::shrink_gray(gray, max_long_side_gray), colors))
    }

    fn decode_dynamic(&self) -> Result<DynamicImage, PhotographError> {
        let pixels = u64::from(self.info.width) * u64::from(self.info.height);
        let decoder = decoder(self.bytes, self.info.format, MAX_HEADER_BYTES + MAX_DECODED_BYTES_PER_PIXEL * pixels)?;
        DynamicImage::from_decoder(decoder).map_err(from_image_error)
    }
}

/// A raster as a JPEG; `quality` is 1 to 100.
///
/// # Errors
/// When the pixels can't be encoded.
pub fn encode_jpeg(image: &RgbImage, quality: u8) -> Result<Vec<u8>, PhotographError> {
    let mut bytes = Vec::new();
    let mut encoder = image::codecs::jpeg::JpegEncoder::new_with_quality(&mut bytes, quality);
    encoder
        .encode(&image.data, image.width as u32, image.height as u32, image::ExtendedColorType::Rgb8)
        .map_err(from_image_error)?;
    Ok(bytes)
}

/// Memory a decoder may take for headers and tables.
const MAX_HEADER_BYTES: u64 = 64 << 20;

/// Memory a decoder may take for each pixel: the widest kind has 4 channels of 4 bytes, and a copy.
const MAX_DECODED_BYTES_PER_PIXEL: u64 = 32;

fn decoder(bytes: &[u8], format: PhotographFormat, max_alloc: u64) -> Result<impl ImageDecoder, PhotographError> {
    let format = match format {
        PhotographFormat::Jpeg => image::ImageFormat::Jpeg,
        PhotographFormat::Png => image::ImageFormat::Png,
        PhotographFormat::Tiff => image::ImageFormat::Tiff,
        PhotographFormat::Webp => image::ImageFormat::WebP,
    };
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    let mut limits = image::Limits::default();
    limits.max_alloc = Some(max_alloc);
    reader.limits(limits);
    reader.into_decoder().map_err(from_image_error)
}

fn from_image_error(error: ImageError) -> PhotographError {
    let message = error.to_string();
    match error {
        ImageError::Unsupported(_) => PhotographError::UnsupportedFormat(message),
        ImageError::IoError(source) if source.kind() == io::ErrorKind::UnexpectedEof => {
            PhotographError::Truncated(message)
        }
        _ if ends_early(&error) => PhotographError::Truncated(message),
        _ => PhotographError::Unreadable(message),
    }
}

/// Whether an unexpected end of the file is among the causes of an error.
fn ends_early(error: &(dyn std::error::Error + 'static)) -> bool {
    let is_end = error.downcast_ref::<io::Error>().is_some_and(|e| e.kind() == io::ErrorKind::UnexpectedEof);
    is_end || error.source().is_some_and(ends_early)
}

/// Runs a decoder; a panic in it becomes an error.
fn guarded<T>(decode: impl FnOnce() -> Result<T, PhotographError>) -> Result<T, PhotographError> {
    catch_unwind(AssertUnwindSafe(decode))
        .unwrap_or_else(|_| Err(PhotographError::Unreadable("the decoder gave up on damaged data".into())))
}
