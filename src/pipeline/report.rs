//! Fills in the report of a run.

use std::collections::BTreeMap;

use super::features::ImageFeatures;
use super::intake::Intake;
use super::measure::{Stopwatch, peak_rss_bytes};
use super::options::ReconstructionOptions;
use super::state::{ModelState, PipelineState, mean_and_median};
use super::{Context, verdict};
use crate::camera::{Camera, FocalSource};
use crate::coarse::look_alikes::CutPair;
use crate::formats::report::{InputSummary, LookAlikePair, ModelReport, Report, Software, StageReport};
use crate::geometry::focal_voting::FocalVotingOptions;
use crate::scene::ImageId;

/// The report of a finished run.
#[expect(clippy::too_many_arguments, reason = "a report gathers everything a run knows")]
pub fn build(
    options: &ReconstructionOptions,
    context: &Context,
    intake: &Intake,
    features: &BTreeMap<ImageId, ImageFeatures>,
    state: &PipelineState,
    stages: Vec<StageReport>,
    notes: Vec<String>,
    cut: &[CutPair],
    watch: &Stopwatch,
) -> Report {
    let pixels: f64 = intake.files.iter().filter_map(|file| file.size).map(|(w, h)| f64::from(w) * f64::from(h)).sum();
    Report {
        software: Software { name: env!("CARGO_PKG_NAME").to_owned(), version: env!("CARGO_PKG_VERSION").to_owned() },
        seed: context.seed,
        threads: context.threads,
        options: serde_json::to_value(options).expect("options serialise"),
        input: InputSummary { images: intake.files.len(), megapixels: pixels / 1e6 },
        wall_s: watch.wall_s(),
        cpu_s: watch.cpu_s(),
        peak_rss_bytes: peak_rss_bytes(),
        stages,
        models: state.models.iter().enumerate().map(|(id, account)| model_report(id, account)).collect(),
        images: verdict::verdicts(intake, features, state),
        look_alikes: cut.iter().map(|cut| look_alike_pair(intake, cut)).collect(),
        notes,
    }
}

/// Tells of principal points found so far from the middle that programs which hold them there disagree with the model. `models`
/// are in their final order.
pub fn principal_point_notes(models: &[ModelState]) -> Vec<String> {
    let refined = used_cameras(models).filter(|(_, camera)| camera.focal_source != FocalSource::Known);
    let notes = refined.filter_map(|(at, camera)| {
        let center = camera.principal_point().0;
        let (dx, dy) = (center.x - 0.5 * f64::from(camera.width), center.y - 0.5 * f64::from(camera.height));
        let turn_deg = (dx.hypot(dy) / camera.mean_focal_px()).atan().to_degrees();
        (turn_deg > NOTED_TURN_DEG).then(|| {
            format!(
                "Model {at}: the principal point of the {} x {} camera was found {dx:+.1}, {dy:+.1} pixels from the middle of the \
                 picture. Programs that hold it in the middle turn every camera by {turn_deg:.2} degrees against this model; \
                 the option coarse.mapper.intrinsics.principal_point = \"middle\" does so here, too.",
                camera.width, camera.height
            )
        })
    });
    notes.collect()
}

/// Tells of focal lengths, not from EXIF, that hardly any lens has: the photographs left them open, and the shape of
/// the model with them.
pub fn focal_notes(models: &[ModelState], plausible: &FocalVotingOptions) -> Vec<String> {
    let told = used_cameras(models).filter(|(_, camera)| camera.focal_source.is_told_by_photographs());
    let notes = told.filter_map(|(at, camera)| {
        let ratio = camera.mean_focal_px() / f64::from(camera.width.max(camera.height));
        (!(plausible.min_focal_ratio..=plausible.max_focal_ratio).contains(&ratio)).then(|| {
            format!(
                "Model {at}: the focal length of a {} x {} camera was found at {ratio:.2} times the longer side of the picture, \
                 which hardly any lens has. These photographs do not tell it, and the model may be bent: photographs with EXIF, \
                 or from more directions would, or the option intake.camera.",
                camera.width, camera.height
            )
        })
    });
    notes.collect()
}

/// The cameras that images use, with the number of their model.
fn used_cameras(models: &[ModelState]) -> impl Iterator<Item = (usize, &Camera)> {
    let models = models.iter().enumerate();
    models.flat_map(|(at, account)| account.model.used_cameras().into_values().map(move |camera| (at, camera)))
}

/// A principal point that far from the middle, seen as an angle, is worth a note.
const NOTED_TURN_DEG: f64 = 0.25;

fn look_alike_pair(intake: &Intake, cut: &CutPair) -> LookAlikePair {
    LookAlikePair {
        first: intake.name(cut.images.0).to_owned(),
        second: intake.name(cut.images.1).to_owned(),
        matches: cut.matches,
        agreeing: cut.agreeing,
        strength: cut.strength,
        chain_strength: cut.chain_strength,
        displacement: cut.displacement,
        apart: cut.apart,
    }
}

fn model_report(id: usize, ModelState { model, history, .. }: &ModelState) -> ModelReport {
    let (mean, median) = mean_and_median(model.reprojection_errors_px());
    let (points, observations) = (model.num_points(), model.num_observations());
    ModelReport {
        id,
        images: model.images().len(),
        points,
        points_3plus: model.num_points_3plus(),
        observations,
        mean_track_length: (points > 0).then(|| observations as f64 / points as f64),
        mean_reprojection_error_px: mean,
        median_reprojection_error_px: median,
        stages: history.clone(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::CameraModel;
    use crate::geometry::Rigid3;
    use crate::scene::{CameraId, Reconstruction};

    #[test]
    fn a_focal_length_that_no_lens_has_is_told() {
        let sources = [FocalSource::Guess, FocalSource::Estimated, FocalSource::Exif, FocalSource::Known];
        for (source, noted) in sources.into_iter().zip([true, true, false, false]) {
            for (focal_px, far) in [(900.0, false), (90.0, true), (5000.0, true)] {
                let camera = Camera::centered(CameraModel::SimpleRadial, 1000, 800, focal_px, source);
                let mut model = Reconstruction::new([(CameraId(0), camera.clone()), (CameraId(1), camera)].into());
                model.register(ImageId(0), CameraId(0), Rigid3::identity(), [].into());
                let states = [ModelState::new(model)];
                let notes = focal_notes(&states, &FocalVotingOptions::default());
                assert_eq!(notes.len(), usize::from(noted && far), "{source:?} {focal_px}: {notes:?}");
            }
        }
    }
}
