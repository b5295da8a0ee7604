//! Small pictures of photographs, made when they are first asked for and kept beside the job.

use std::path::{Path, PathBuf};

use image::DynamicImage;
use image::metadata::Orientation;

use crate::formats::photograph::{Photograph, PhotographError, PhotographLimits, encode_jpeg};
use crate::scene::RgbImage;
use crate::store::{StoreError, atomic};

/// Longer side of a thumbnail.
pub(super) const LONG_SIDE_PX: u32 = 320;
/// Quality of its JPEG.
const QUALITY: u8 = 82;

/// Why there is no thumbnail.
#[derive(Debug, thiserror::Error)]
pub(super) enum ThumbnailError {
    #[error(transparent)]
    Photograph(#[from] PhotographError),
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<std::io::Error> for ThumbnailError {
    fn from(error: std::io::Error) -> Self {
        Self::Store(error.into())
    }
}

/// The thumbnail of a photograph with this hash in `folder`, made from `photograph` when it is not there. Blocking.
pub(super) fn find_or_make(
    folder: &Path,
    scratch: &Path,
    photograph: &Path,
    sha256: &str,
) -> Result<PathBuf, ThumbnailError> {
    let path = folder.join(format!("{sha256}.jpg"));
    if !path.is_file() {
        let bytes = make(&std::fs::read(photograph)?)?;
        std::fs::create_dir_all(folder)?;
        atomic::write_atomic(&path, scratch, &[&bytes])?;
    }
    Ok(path)
}

/// A small JPEG of a photograph, turned as its orientation tag says.
fn make(bytes: &[u8]) -> Result<Vec<u8>, PhotographError> {
    let limits = PhotographLimits { min_side_px: 1, ..PhotographLimits::default() };
    let photograph = Photograph::open(bytes, &limits)?;
    let small = photograph.decode_rgb(Some(LONG_SIDE_PX))?.image;
    let orientation = photograph.info().exif.orientation.and_then(Orientation::from_exif);
    encode_jpeg(&turned(small, orientation), QUALITY)
}

fn turned(image: RgbImage, orientation: Option<Orientation>) -> RgbImage {
    let Some(orientation) = orientation.filter(|orientation| *orientation != Orientation::NoTransforms) else {
        return image;
    };
    // The raster has exactly the bytes its sides ask for, and sides of a few hundred pixels.
    let buffer = image::RgbImage::from_raw(image.width as u32, image.height as u32, image.data)
        .expect("a raster has three bytes for each pixel");
    let mut dynamic = DynamicImage::ImageRgb8(buffer);
    dynamic.apply_orientation(orientation);
    let turned = dynamic.into_rgb8();
    RgbImage { width: turned.width() as usize, height: turned.height() as usize, data: turned.into_raw() }
}
