//! Masks: pictures that say which parts of a photograph to ignore, such as the background of an object on a turntable.
//!
//! The mask of `sub/a.jpg` is `masks/sub/a.png` or `masks/sub/a.jpg.png` in the input folder. It has the photograph's
//! shape, at any resolution; where it is zero no feature is kept. A picture under `masks/` that belongs to no
//! photograph is a photograph itself.

use std::collections::BTreeMap;
use std::path::Path;

use serde::{Deserialize, Serialize};

use super::intake::{InputFile, Refusal};
use super::runner::io_error;
use super::{PipelineError, Stage};
use crate::formats::photograph::{Photograph, PhotographLimits};
use crate::scene::GrayImage;

/// The folder of masks in the input folder.
const FOLDER: &str = "masks/";
/// Largest difference between the aspect ratios of a photograph and its mask, as a share: rounding of a reduced mask's size.
const MAX_ASPECT_DIFFERENCE: f64 = 0.02;

/// The mask of a photograph.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct MaskFile {
    /// Path relative to the input folder, with `/`.
    pub name: String,
    /// SHA-256 of its bytes in hexadecimal.
    pub sha256: String,
}

/// Gives photographs their masks. A mask is then no photograph any more; a photograph whose mask can't be used is refused, or
/// what its owner wanted ignored would be taken for part of the scene.
pub fn assign(files: &mut [InputFile]) {
    let place: BTreeMap<String, usize> = files.iter().enumerate().map(|(at, file)| (file.name.clone(), at)).collect();
    for at in 0..files.len() {
        if files[at].name.starts_with(FOLDER) || files[at].photograph.is_err() {
            continue;
        }
        let name = files[at].name.clone();
        let stem = name.rsplit_once('.').map_or(name.as_str(), |(stem, _)| stem);
        let masks = [format!("{FOLDER}{name}.png"), format!("{FOLDER}{stem}.png")];
        let Some(&mask) = masks.iter().find_map(|mask| place.get(mask)) else { continue };
        match usable(&files[at], &files[mask]) {
            Ok(found) => files[at].mask = Some(found),
            Err(refusal) => files[at].photograph = Err(refusal),
        }
        files[mask].photograph = Err(Refusal {
            code: "mask".to_owned(),
            advice: format!("Not a photograph but the mask of {name}: what it shows black is ignored there."),
        });
    }
}

fn usable(photograph: &InputFile, mask: &InputFile) -> Result<MaskFile, Refusal> {
    let refused = |code: &str, advice: String| Err(Refusal { code: code.to_owned(), advice });
    let (Some(sha256), Some(size), Some(mask_size)) = (&mask.sha256, photograph.size, mask.size) else {
        return refused(
            "mask_unreadable",
            format!("Its mask {} could not be read: save the mask again as PNG, or leave it out.", mask.name),
        );
    };
    let aspect = |(width, height): (u32, u32)| f64::from(width) / f64::from(height);
    if (aspect(size) / aspect(mask_size) - 1.0).abs() > MAX_ASPECT_DIFFERENCE {
        return refused(
            "mask_mismatch",
            format!(
                "Its mask {} has {} x {} pixels, the photograph {} x {}: give the mask the photograph's shape.",
                mask.name, mask_size.0, mask_size.1, size.0, size.1
            ),
        );
    }
    Ok(MaskFile { name: mask.name.clone(), sha256: sha256.clone() })
}

/// A mask in memory.
pub struct Mask(GrayImage);

impl Mask {
    /// Reads a mask file.
    ///
    /// # Errors
    /// When the file can't be read; within, why it can't be decoded.
    pub fn read(path: &Path, limits: &PhotographLimits) -> Result<Result<Self, Refusal>, PipelineError> {
        let bytes = std::fs::read(path).map_err(|source| io_error(Stage::Features, path, source))?;
        let decoded = Photograph::open(&bytes, limits).and_then(|picture| picture.decode_gray(None));
        Ok(decoded.map(|decoded| Self(decoded.image)).map_err(|error| Refusal {
            code: "mask_unreadable".to_owned(),
            advice: format!("Its mask could not be read ({error}): save the mask again as PNG, or leave it out."),
        }))
    }

    /// Whether the mask keeps the place `(x, y)`, each a share of the picture's width and height.
    pub fn keeps(&self, x: f64, y: f64) -> bool {
        let Self(GrayImage { width, height, data }) = self;
        let at = |share: f64, size: usize| ((share * size as f64).max(0.0) as usize).min(size - 1);
        data[at(y, *height) * width + at(x, *width)] != 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::formats::exif::Exif;
    use crate::pipeline::intake::Photograph;
    use crate::scene::CameraId;

    fn file(name: &str, (width, height): (u32, u32)) -> InputFile {
        InputFile {
            name: name.to_owned(),
            sha256: Some(format!("hash of {name}")),
            size: Some((width, height)),
            photograph: Ok(Photograph { width, height, camera: CameraId(0), exif: Exif::default() }),
            mask: None,
        }
    }

    #[test]
    fn masks_find_their_photographs() {
        let mut files = [
            file("a.jpg", (300, 200)),
            file("masks/a.png", (150, 100)),
            file("masks/b.png", (300, 200)),
            file("masks/sub/c.jpg.png", (300, 200)),
            file("masks/sub/d.png", (200, 300)),
            file("sub/c.jpg", (300, 200)),
            file("sub/d.jpg", (300, 200)),
        ];
        assign(&mut files);
        let mask = |at: usize| files[at].mask.as_ref().map(|mask| mask.name.as_str());
        let code = |at: usize| files[at].photograph.as_ref().err().map(|refusal| refusal.code.as_str());
        assert_eq!((mask(0), code(0)), (Some("masks/a.png"), None));
        assert_eq!((mask(5), code(5)), (Some("masks/sub/c.jpg.png"), None));
        assert_eq!((mask(6), code(6)), (None, Some("mask_mismatch")), "the mask is upright, the photograph lies");
        assert_eq!([code(1), code(3), code(4)], [Some("mask"); 3]);
        assert_eq!((mask(2), code(2)), (None, None), "the mask of nothing is a photograph");
    }

    #[test]
    fn a_mask_of_another_resolution_keeps_the_same_part() {
        let mask = Mask(GrayImage::new(4, 2, vec![0, 0, 255, 255, 0, 0, 0, 1]));
        assert!(!mask.keeps(0.1, 0.1) && !mask.keeps(0.6, 0.9));
        assert!(mask.keeps(0.5, 0.0) && mask.keeps(0.99, 0.99) && mask.keeps(1.0, 1.0));
    }
}
