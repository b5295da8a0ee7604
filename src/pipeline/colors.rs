//! Colours of the points and thumbnails of the photographs, from what the features stage saw when it decoded them.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::features::ImageFeatures;
use super::runner::{StageProgress, io_error};
use super::state::PipelineState;
use super::{Context, PipelineError, Stage};
use crate::formats::photograph::{self, Colors};
use crate::scene::{Features, ImageId};
use crate::store::ArtifactStore;

/// Small JPEGs by image.
pub type Thumbnails = BTreeMap<ImageId, Vec<u8>>;

/// Least long side of a raster for colours: finer detail than this does not change a point's colour.
pub(super) const COLOR_LONG_SIDE_PX: u32 = 1600;
/// Long side of a thumbnail.
const THUMBNAIL_LONG_SIDE_PX: u32 = 240;
/// JPEG quality of a thumbnail.
const THUMBNAIL_QUALITY: u8 = 75;

/// What is kept of a photograph's colours.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Look {
    /// Colour at every feature.
    colors: Vec<[u8; 3]>,
    /// A small JPEG.
    thumbnail: Vec<u8>,
}

impl Look {
    /// Of a decoded photograph, at its features (in pixels of the original).
    pub(super) fn of(picture: Colors, features: &Features) -> Self {
        let at = |x: f32, y: f32| picture.at(f64::from(x), f64::from(y));
        let colors = features.keypoints.iter().map(|keypoint| at(keypoint.x, keypoint.y)).collect();
        let small = picture.thumbnail(THUMBNAIL_LONG_SIDE_PX);
        // Encoding into memory has no reason to fail; without a thumbnail the report shows a blank.
        Self { colors, thumbnail: photograph::encode_jpeg(&small, THUMBNAIL_QUALITY).unwrap_or_default() }
    }

    /// As bytes.
    pub(super) fn to_bytes(&self) -> Vec<u8> {
        postcard::to_stdvec(self).expect("plain data serialise")
    }

    fn from_bytes(bytes: &[u8]) -> Option<Self> {
        postcard::from_bytes(bytes).ok()
    }
}

/// Gives every point the mean colour of its sightings and collects the thumbnails. Images without a look (ready features
/// have none) leave their share out.
///
/// # Errors
/// Cancellation, and looks that can't be read back.
pub fn run(
    store: &ArtifactStore,
    found: &BTreeMap<ImageId, ImageFeatures>,
    state: &mut PipelineState,
    context: &Context,
    progress: &StageProgress<'_>,
) -> Result<Thumbnails, PipelineError> {
    let looks: Vec<(ImageId, Option<Look>)> = found
        .par_iter()
        .map(|(&id, image)| {
            context.check_cancelled()?;
            let look = match &image.look_key {
                Some(key) => {
                    let bytes = store.get(key).map_err(|source| io_error(Stage::Export, Path::new(key), source))?;
                    bytes.and_then(|bytes| Look::from_bytes(&bytes))
                }
                None => None,
            };
            progress.tick();
            Ok((id, look))
        })
        .collect::<Result<_, PipelineError>>()?;
    let looks: BTreeMap<ImageId, Look> = looks.into_iter().filter_map(|(id, look)| Some((id, look?))).collect();
    for account in &mut state.models {
        let mut colors = Vec::with_capacity(account.model.num_points());
        for (id, point) in account.model.points() {
            let (mut sum, mut count) = ([0u32; 3], 0u32);
            for seen in &point.track {
                let color = looks.get(&seen.image).and_then(|look| look.colors.get(seen.keypoint.index()));
                let Some(color) = color else { continue };
                for (total, &value) in sum.iter_mut().zip(color) {
                    *total += u32::from(value);
                }
                count += 1;
            }
            if count > 0 {
                colors.push((id, sum.map(|total| ((total + count / 2) / count) as u8)));
            }
        }
        for (id, color) in colors {
            account.model.set_color(id, color);
        }
    }
    Ok(looks
        .into_iter()
        .filter(|(_, look)| !look.thumbnail.is_empty())
        .map(|(id, look)| (id, look.thumbnail))
        .collect())
}
