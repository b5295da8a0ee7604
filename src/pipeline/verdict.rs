//! The verdict on every photograph: its state, and for one without a pose a stable reason and a sentence of advice.

use std::collections::BTreeMap;

use super::features::ImageFeatures;
use super::intake::Intake;
use super::state::PipelineState;
use crate::coarse::Unregistered;
use crate::formats::report::{ImageReport, ImageState};
use crate::scene::ImageId;

/// Features below which a picture is called featureless: too few for any pair to be verified.
const FEW_FEATURES: usize = 50;

/// Why an image has no pose.
#[derive(Clone, Debug, PartialEq)]
pub struct Reason {
    /// Stable code.
    pub code: &'static str,
    /// What happened and what to do about it.
    pub advice: String,
}

/// The verdict on every input file, in name order.
pub fn verdicts(
    intake: &Intake,
    features: &BTreeMap<ImageId, ImageFeatures>,
    state: &PipelineState,
) -> Vec<ImageReport> {
    let located = state.located();
    (0u32..)
        .map(ImageId)
        .zip(&intake.files)
        .map(|(id, file)| {
            let mut report = ImageReport {
                name: file.name.clone(),
                sha256: file.sha256.clone(),
                width: file.size.map(|size| size.0),
                height: file.size.map(|size| size.1),
                state: ImageState::Rejected,
                model: None,
                features: None,
                registered_in: None,
                inliers: None,
                mean_reprojection_error_px: None,
                focal_px: None,
                reason: None,
                advice: None,
            };
            let refusal = match (&file.photograph, features.get(&id).map(|image| &image.count)) {
                (Err(refusal), _) | (Ok(_), Some(Err(refusal))) => Some(refusal.clone()),
                (Ok(_), Some(Ok(count))) => {
                    report.features = Some(*count);
                    None
                }
                (Ok(_), None) => None,
            };
            if let Some(refusal) = refusal {
                report.reason = Some(refusal.code);
                report.advice = Some(refusal.advice);
            } else if let Some(&model) = located.get(&id) {
                registered(&mut report, id, model, state);
            } else {
                let reason = reason(id, report.features.unwrap_or(0), state);
                report.state = ImageState::Unregistered;
                report.reason = Some(reason.code.to_owned());
                report.advice = Some(reason.advice);
            }
            report
        })
        .collect()
}

fn registered(report: &mut ImageReport, id: ImageId, model: usize, state: &PipelineState) {
    let account = &state.models[model];
    let image = &account.model.images()[&id];
    let errors: Vec<f64> = (0u32..)
        .map(crate::scene::KeypointIdx)
        .zip(image.points())
        .filter_map(|(keypoint, point)| {
            point.map(|point| {
                account.model.reprojection_error_px(point, crate::scene::Observation { image: id, keypoint })
            })
        })
        .collect();
    report.state = ImageState::Registered;
    report.model = Some(model);
    report.registered_in = account.registered_in.get(&id).cloned();
    report.inliers = Some(errors.len());
    report.mean_reprojection_error_px = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
    report.focal_px = Some(account.model.camera_of(id).mean_focal_px());
}

fn reason(id: ImageId, features: usize, state: &PipelineState) -> Reason {
    if features < FEW_FEATURES {
        return Reason {
            code: "too_few_features",
            advice: format!(
                "Only {features} distinctive spots were found: the picture is too dark, blurred or plain. \
                 Take it again in even light and in focus."
            ),
        };
    }
    match state.unregistered.get(&id).unwrap_or(&Unregistered::NoPairs) {
        Unregistered::NoPairs => Reason {
            code: "no_matching_image",
            advice:
                "It shows nothing that another photograph shows as well. If it belongs here, add photographs taken \
                     between it and its neighbours, with two thirds overlap."
                    .to_owned(),
        },
        Unregistered::NoInitialPair => Reason {
            code: "no_initial_pair",
            advice: "It matches other photographs, but no two of them were taken far enough apart to measure depth. \
                     Take more photographs from different standpoints instead of turning on the spot."
                .to_owned(),
        },
        Unregistered::TooFewPoints { visible } => Reason {
            code: "too_few_model_points",
            advice: format!(
                "It sees only {visible} points of the model. Add photographs that lead over from its neighbours to it."
            ),
        },
        Unregistered::PoseFailed { visible, inliers } => Reason {
            code: "pose_not_found",
            advice: format!(
                "It seems to see {visible} points of the model, but no camera position agrees with more than {inliers} of \
                 them: it may show a look-alike part or something that moved. Add photographs near it."
            ),
        },
    }
}
