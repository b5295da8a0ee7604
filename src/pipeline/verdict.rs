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

/// Likenesses of a picture's features with points of the model from which on it is worth saying why they may mislead.
const MANY_LIKENESSES: usize = 30;

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
                let most_alike = state.most_alike.get(&id).map(|&other| intake.name(other));
                let why = state.unregistered.get(&id).unwrap_or(&Unregistered::NoPairs);
                let reason = reason(report.features.unwrap_or(0), why, most_alike);
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
    let errors: Vec<f64> = account.model.errors_of_image_px(id).map(|(_, error_px)| error_px).collect();
    report.state = ImageState::Registered;
    report.model = Some(model);
    report.registered_in = account.registered_in.get(&id).cloned();
    report.inliers = Some(errors.len());
    report.mean_reprojection_error_px = (!errors.is_empty()).then(|| errors.iter().sum::<f64>() / errors.len() as f64);
    report.focal_px = Some(account.model.camera_of(id).mean_focal_px());
}

/// The reason for a picture with so many features; `most_alike` is the name of the one it matches best.
fn reason(features: usize, why: &Unregistered, most_alike: Option<&str>) -> Reason {
    if features < FEW_FEATURES {
        let found = match features {
            0 => "No distinctive spot was found: the picture is black, overexposed, blurred or plain.".to_owned(),
            few => format!("Only {few} distinctive spots were found: the picture is too dark, blurred or plain."),
        };
        let advice = format!("{found} Take it again in even light and in focus.");
        return Reason { code: "too_few_features", advice };
    }
    let lead_over = match most_alike {
        Some(name) => format!("It matches {name} best: add photographs taken between the two."),
        None => "Add photographs that lead over from the model to it.".to_owned(),
    };
    match *why {
        Unregistered::NoPairs => Reason {
            code: "no_matching_image",
            advice: "No other photograph matches it: none shows enough of the same place from a similar side and in \
                     similar light. If it belongs here, add photographs taken between it and its neighbours, with two \
                     thirds overlap."
                .to_owned(),
        },
        Unregistered::TooFewTogether { images } => Reason {
            code: "too_few_matching_images",
            advice: format!(
                "It matches {} alone, which is too little for a model. Add photographs taken around and between them, with two \
                 thirds overlap.",
                match (images, most_alike) {
                    (2, Some(name)) => name.to_owned(),
                    _ => format!("{} other photographs", images.saturating_sub(1)),
                }
            ),
        },
        Unregistered::NoInitialPair => Reason {
            code: "no_initial_pair",
            advice: "It matches other photographs, but no two of them were taken far enough apart to measure depth. \
                     Take more photographs from different standpoints instead of turning on the spot. If an object was \
                     turned in front of a still background, mask the background."
                .to_owned(),
        },
        Unregistered::TooFewPoints { visible } => Reason {
            code: "too_few_model_points",
            advice: match visible {
                0 => format!("It sees no point of the model. {lead_over}"),
                1 => format!("It sees only one point of the model. {lead_over}"),
                few => format!("It sees only {few} points of the model. {lead_over}"),
            },
        },
        Unregistered::TurnedOtherwise { inliers, .. } => Reason {
            code: "pose_not_found",
            advice: format!(
                "A camera position fits {inliers} points of the model, but the photographs it matches best say that it was turned \
                 another way: what it shares with the model may be a look-alike or a repeated pattern. {lead_over}"
            ),
        },
        Unregistered::PoseFailed { visible, inliers } => Reason {
            code: "pose_not_found",
            advice: {
                let agree = match inliers {
                    0 => "no camera position fits them".to_owned(),
                    few => format!("no camera position fits more than {few} of them"),
                };
                let suspicion = if visible >= MANY_LIKENESSES {
                    " It may show a look-alike part, or something that moved."
                } else {
                    ""
                };
                format!(
                    "Of its {features} features {visible} look like points of the model, and {agree}.{suspicion} {lead_over}"
                )
            },
        },
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn advice_is_specific() {
        let advice = |features, why: &Unregistered, alike| reason(features, why, alike).advice;
        let failed = |visible, inliers| Unregistered::PoseFailed { visible, inliers };
        let few = advice(7000, &failed(14, 0), Some("a/25.jpg"));
        assert!(few.contains("Of its 7000 features 14 look like"), "{few}");
        assert!(few.contains("no camera position fits them") && !few.contains("look-alike"), "{few}");
        assert!(few.ends_with("It matches a/25.jpg best: add photographs taken between the two."), "{few}");
        let many = advice(7000, &failed(140, 11), None);
        assert!(many.contains("more than 11 of them") && many.contains("look-alike"), "{many}");
        assert!(many.ends_with("Add photographs that lead over from the model to it."), "{many}");
        assert!(advice(7000, &Unregistered::TooFewPoints { visible: 1 }, None).starts_with("It sees only one point"));
        let two = advice(7000, &Unregistered::TooFewTogether { images: 2 }, Some("a/25.jpg"));
        assert!(two.starts_with("It matches a/25.jpg alone, which is too little for a model."), "{two}");
        let turned = advice(7000, &Unregistered::TurnedOtherwise { visible: 30, inliers: 18 }, Some("a/25.jpg"));
        assert!(turned.contains("fits 18 points") && turned.contains("repeated pattern"), "{turned}");
        // Nothing can be said of matches where there is nothing to match.
        let black = reason(0, &Unregistered::NoPairs, None);
        assert_eq!(black.code, "too_few_features");
        assert!(black.advice.starts_with("No distinctive spot was found: the picture is black"), "{}", black.advice);
    }
}
