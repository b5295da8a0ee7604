//! Sets of ready features in place of photographs: for scenes that were never rendered, and for features made elsewhere.

use std::path::Path;

use rayon::prelude::*;
use sha2::{Digest, Sha256};

use super::intake::{InputFile, Photograph, Refusal, hex};
use super::runner::io_error;
use super::{PipelineError, Stage};
use crate::formats::features::{self, FEATURE_SET_INDEX, FeatureSet, FeatureSetImage};
use crate::scene::{CameraId, Features};

/// The index of the set in `folder`, in name order.
///
/// # Errors
/// When there is none, or it names no image or one twice.
pub fn index(folder: &Path) -> Result<Vec<FeatureSetImage>, PipelineError> {
    let path = folder.join(FEATURE_SET_INDEX);
    let unusable = |message: String| PipelineError::InvalidInput { path: path.clone(), message };
    let bytes = std::fs::read(&path).map_err(|error| unusable(error.to_string()))?;
    let set: FeatureSet = serde_json::from_slice(&bytes).map_err(|error| unusable(error.to_string()))?;
    let mut images = set.images;
    images.sort_by(|a, b| a.name.cmp(&b.name));
    if images.is_empty() {
        return Err(unusable("it names no image".to_owned()));
    }
    if let Some(pair) = images.windows(2).find(|pair| pair[0].name == pair[1].name) {
        return Err(unusable(format!("it names {} twice", pair[0].name)));
    }
    Ok(images)
}

/// The images of the set in `folder` as intake knows photographs; their cameras are filled in later.
///
/// # Errors
/// Those of [`index`].
pub fn inspect(folder: &Path) -> Result<Vec<InputFile>, PipelineError> {
    let images = index(folder)?;
    let inspect_one = |image: FeatureSetImage| {
        let FeatureSetImage { name, file, width, height, exif } = image;
        let digest = std::fs::read(folder.join(file)).map(|bytes| hex(&Sha256::digest(&bytes)));
        let photograph = match &digest {
            Ok(_) => Ok(Photograph { width, height, camera: CameraId(0), exif }),
            Err(error) => Err(refusal(&format!("The features could not be read: {error}."))),
        };
        InputFile { name, sha256: digest.ok(), size: Some((width, height)), photograph, mask: None }
    };
    Ok(images.into_par_iter().map(inspect_one).collect())
}

/// The features of one image of the set.
///
/// # Errors
/// When the file can't be read.
pub fn read(path: &Path) -> Result<Result<Features, Refusal>, PipelineError> {
    let bytes = std::fs::read(path).map_err(|source| io_error(Stage::Features, path, source))?;
    let checked = features::from_bytes(&bytes, None).and_then(|found| features::check_order(&found).map(|()| found));
    Ok(checked.map_err(|error| refusal(&format!("The feature file can't be used: {error}."))))
}

fn refusal(advice: &str) -> Refusal {
    Refusal { code: "unreadable".to_owned(), advice: advice.to_owned() }
}
