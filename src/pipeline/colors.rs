//! Colours of the points and thumbnails of the photographs, from one colour decoding of each.

use std::collections::BTreeMap;
use std::path::Path;

use rayon::prelude::*;

use super::intake::Intake;
use super::runner::StageProgress;
use super::state::PipelineState;
use super::{Context, PipelineError};
use crate::formats::photograph::{self, Photograph, PhotographLimits};
use crate::scene::{ImageId, Point3dId, RgbImage};

/// Small JPEGs by image.
pub type Thumbnails = BTreeMap<ImageId, Vec<u8>>;

/// Long side of a decoding for colours: finer detail than this does not change a point's colour.
const COLOR_LONG_SIDE_PX: u32 = 1600;
/// Long side of a thumbnail.
const THUMBNAIL_LONG_SIDE_PX: u32 = 240;
/// JPEG quality of a thumbnail.
const THUMBNAIL_QUALITY: u8 = 75;

/// What one photograph gives: its sightings' colours by model and point, and its thumbnail.
type Seen = (Option<(usize, Vec<(Point3dId, [u8; 3])>)>, Option<Vec<u8>>);

/// Gives every point the mean colour of its sightings and makes the thumbnails. A photograph that can't be decoded again
/// leaves its share out.
pub fn run(
    folder: &Path,
    intake: &Intake,
    limits: &PhotographLimits,
    state: &mut PipelineState,
    context: &Context,
    progress: &StageProgress<'_>,
) -> Result<Thumbnails, PipelineError> {
    let located = state.located();
    let photographs: Vec<_> = intake.photographs().map(|(id, file, _)| (id, folder.join(&file.name))).collect();
    let seen: Vec<(ImageId, Seen)> = photographs
        .par_iter()
        .map(|(id, path)| {
            context.check_cancelled()?;
            let picture = std::fs::read(path).ok().and_then(|bytes| {
                Photograph::open(&bytes, limits)
                    .and_then(|photograph| photograph.decode_rgb(Some(COLOR_LONG_SIDE_PX)))
                    .ok()
            });
            progress.tick();
            let Some(picture) = picture else { return Ok((*id, (None, None))) };
            let colors = located
                .get(id)
                .map(|&rank| (rank, sightings(&state.models[rank].model, *id, &picture.image, picture.to_original)));
            let small = photograph::shrink_rgb(picture.image, Some(THUMBNAIL_LONG_SIDE_PX)).image;
            Ok((*id, (colors, photograph::encode_jpeg(&small, THUMBNAIL_QUALITY).ok())))
        })
        .collect::<Result<_, PipelineError>>()?;
    let mut sums: Vec<BTreeMap<Point3dId, ([u32; 3], u32)>> = vec![BTreeMap::new(); state.models.len()];
    let mut thumbnails = Thumbnails::new();
    for (id, (colors, thumbnail)) in seen {
        for (rank, (point, color)) in
            colors.into_iter().flat_map(|(rank, colors)| colors.into_iter().map(move |seen| (rank, seen)))
        {
            let (sum, count) = sums[rank].entry(point).or_insert(([0; 3], 0));
            for (total, value) in sum.iter_mut().zip(color) {
                *total += u32::from(value);
            }
            *count += 1;
        }
        if let Some(thumbnail) = thumbnail {
            thumbnails.insert(id, thumbnail);
        }
    }
    for (account, sums) in state.models.iter_mut().zip(sums) {
        for (point, (sum, count)) in sums {
            account.model.set_color(point, sum.map(|total| ((total + count / 2) / count) as u8));
        }
    }
    Ok(thumbnails)
}

/// The colour of every point an image sees.
fn sightings(
    model: &crate::scene::Reconstruction,
    id: ImageId,
    picture: &RgbImage,
    to_original: [f64; 2],
) -> Vec<(Point3dId, [u8; 3])> {
    let image = &model.images()[&id];
    image
        .points()
        .iter()
        .zip(image.keypoints.iter())
        .filter_map(|(point, pixel)| {
            Some(((*point)?, picture.at(pixel.0.x / to_original[0], pixel.0.y / to_original[1])))
        })
        .collect()
}
