//! JPEG: the size from the frame header, completeness from the markers, pixels from zune-jpeg.
//!
//! A grey decode asks zune-jpeg for luma alone, which skips the chroma planes; where both grey and colour are wanted, luma and
//! chroma come from one pass over the entropy-coded data, the dearest part of decoding. Markers are as in ITU-T T.81, annex B.

use zune_jpeg::JpegDecoder;
use zune_jpeg::errors::DecodeErrors;
use zune_jpeg::zune_core::bytestream::ZCursor;
use zune_jpeg::zune_core::colorspace::ColorSpace;
use zune_jpeg::zune_core::options::DecoderOptions;

use super::colors::StoredAs;
use super::{PhotographError, convert};
use crate::scene::{GrayImage, RgbImage};

/// What the frame header says.
pub(super) struct Header {
    pub width: u32,
    pub height: u32,
}

const START_OF_SCAN: u8 = 0xda;
const END_OF_IMAGE: u8 = 0xd9;

/// One marker with the content of its segment.
struct Segment<'a> {
    marker: u8,
    content: &'a [u8],
}

/// The segments of a JPEG in order; entropy-coded data after a scan's header are passed over. Ends with the last whole
/// segment, which is the end marker in a complete file.
struct Segments<'a> {
    bytes: &'a [u8],
    at: usize,
}

impl<'a> Iterator for Segments<'a> {
    type Item = Segment<'a>;

    fn next(&mut self) -> Option<Self::Item> {
        let marker = loop {
            let rest = self.bytes.get(self.at..)?;
            self.at += rest.iter().position(|&byte| byte == 0xff)? + 1;
            match *self.bytes.get(self.at)? {
                // A fill byte: the marker's code is still to come.
                0xff => {}
                // A data byte 0xff within a scan, a restart marker, or a lone marker without a segment.
                0x00 | 0x01 | 0xd0..=0xd8 => self.at += 1,
                marker => break marker,
            }
        };
        self.at += 1;
        if marker == END_OF_IMAGE {
            self.at = self.bytes.len();
            return Some(Segment { marker, content: &[] });
        }
        let len = usize::from(u16::from_be_bytes(*self.bytes.get(self.at..)?.first_chunk()?));
        let content = self.bytes.get(self.at + 2..self.at + len)?;
        self.at += len;
        Some(Segment { marker, content })
    }
}

fn segments(bytes: &[u8]) -> Segments<'_> {
    Segments { bytes, at: 2 }
}

/// Reads the size from the frame header.
pub(super) fn header(bytes: &[u8]) -> Result<Header, PhotographError> {
    let cut_short = || PhotographError::Truncated("the frame header is missing".into());
    for Segment { marker, content } in segments(bytes) {
        match marker {
            0xc0..=0xc2 => {
                let fields: [u8; 5] = *content.first_chunk().ok_or_else(cut_short)?;
                if fields[0] != 8 {
                    let message = format!("a JPEG of {} bits a sample", fields[0]);
                    return Err(PhotographError::UnsupportedFormat(message));
                }
                let height = u32::from(u16::from_be_bytes([fields[1], fields[2]]));
                let width = u32::from(u16::from_be_bytes([fields[3], fields[4]]));
                return Ok(Header { width, height });
            }
            0xc3 | 0xc5..=0xc7 | 0xc9..=0xcb | 0xcd..=0xcf => {
                return Err(PhotographError::UnsupportedFormat("lossless, hierarchical or arithmetic JPEG".into()));
            }
            START_OF_SCAN | END_OF_IMAGE => {
                return Err(PhotographError::Unreadable("a JPEG without a frame header".into()));
            }
            _ => {}
        }
    }
    Err(cut_short())
}

/// Whether the end marker follows a scan.
pub(super) fn has_end(bytes: &[u8]) -> bool {
    let mut seen_scan = false;
    for Segment { marker, .. } in segments(bytes) {
        match marker {
            START_OF_SCAN => seen_scan = true,
            END_OF_IMAGE => return seen_scan,
            _ => {}
        }
    }
    false
}

/// Luma.
pub(super) fn decode_gray(bytes: &[u8]) -> Result<GrayImage, PhotographError> {
    match decode(bytes, |stored| if has_luma(stored) { ColorSpace::Luma } else { ColorSpace::RGB })? {
        (ColorSpace::Luma, width, height, data) => Ok(GrayImage::new(width, height, data)),
        (_, width, height, data) => Ok(convert::rgb_to_gray(&RgbImage::new(width, height, data))),
    }
}

/// Colour.
pub(super) fn decode_rgb(bytes: &[u8]) -> Result<RgbImage, PhotographError> {
    let (_, width, height, data) = decode(bytes, |_| ColorSpace::RGB)?;
    Ok(RgbImage::new(width, height, data))
}

/// Luma, and colours as they are stored where those are YCbCr; both in full size.
pub(super) fn decode_gray_and_colors(bytes: &[u8]) -> Result<(GrayImage, RgbImage, StoredAs), PhotographError> {
    let wanted = |stored| match stored {
        Some(as_stored @ (ColorSpace::YCbCr | ColorSpace::Luma)) => as_stored,
        _ => ColorSpace::RGB,
    };
    match decode(bytes, wanted)? {
        (ColorSpace::Luma, width, height, data) => {
            let gray = GrayImage::new(width, height, data);
            let rgb = convert::gray_to_rgb(&gray);
            Ok((gray, rgb, StoredAs::Rgb))
        }
        (ColorSpace::YCbCr, width, height, data) => {
            let gray = GrayImage::new(width, height, data.as_chunks::<3>().0.iter().map(|pixel| pixel[0]).collect());
            Ok((gray, RgbImage::new(width, height, data), StoredAs::YCbCr))
        }
        (_, width, height, data) => {
            let rgb = RgbImage::new(width, height, data);
            Ok((convert::rgb_to_gray(&rgb), rgb, StoredAs::Rgb))
        }
    }
}

fn has_luma(stored: Option<ColorSpace>) -> bool {
    matches!(stored, Some(ColorSpace::YCbCr | ColorSpace::Luma))
}

/// Decodes to the colours that `wanted` names, given those stored; tells which they were.
fn decode(
    bytes: &[u8],
    wanted: impl FnOnce(Option<ColorSpace>) -> ColorSpace,
) -> Result<(ColorSpace, usize, usize, Vec<u8>), PhotographError> {
    let options = DecoderOptions::default()
        .set_max_width(usize::from(u16::MAX))
        .set_max_height(usize::from(u16::MAX))
        .set_strict_mode(false);
    let mut decoder = JpegDecoder::new_with_options(ZCursor::new(bytes), options);
    decoder.decode_headers().map_err(from_decode_error)?;
    let colorspace = wanted(decoder.input_colorspace());
    decoder.set_options(options.jpeg_set_out_colorspace(colorspace));
    let data = decoder.decode().map_err(from_decode_error)?;
    let (width, height) =
        decoder.dimensions().ok_or_else(|| PhotographError::Unreadable("a JPEG without a size".into()))?;
    if data.len() != width * height * colorspace.num_components() {
        return Err(PhotographError::Unreadable("the decoder gave a raster of the wrong size".into()));
    }
    Ok((colorspace, width, height, data))
}

fn from_decode_error(error: DecodeErrors) -> PhotographError {
    let message = error.to_string();
    match error {
        DecodeErrors::ExhaustedData => PhotographError::Truncated(message),
        DecodeErrors::Unsupported(_) => PhotographError::UnsupportedFormat(message),
        _ => PhotographError::Unreadable(message),
    }
}
