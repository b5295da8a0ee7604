//! The trial with few features: taken where it places the photographs, and forgotten where it does not.

use std::fs;

use multistage::formats::report::Report;

use super::feature_street::FeatureStreet;

const IMAGES: usize = 26;

/// Features that each round of coarse matching used.
fn selected(report: &Report) -> Vec<usize> {
    let rounds = report.stages.iter().filter(|stage| stage.name == "coarse_match");
    rounds.map(|stage| stage.counts["features_selected"] as usize).collect()
}

#[test]
fn a_trial_with_few_features_is_enough_or_leaves_no_trace() {
    let street = FeatureStreet::new(IMAGES, 12_000);
    let reconstruct = |out: &str, trial: &str| {
        street.reconstruct(out, &["--set", &format!("coarse.selection.trial_max_features={trial}")])
    };
    let without = reconstruct("without", "null");
    let enough = reconstruct("enough", "1280");
    let too_few = reconstruct("too-few", "12");
    for report in [&without, &enough, &too_few] {
        assert_eq!(report.models[0].images, IMAGES);
    }
    let full = selected(&without);
    assert!(full.len() == 1 && full[0] > 1280 * IMAGES, "{full:?}");
    assert_eq!(selected(&enough), [1280 * IMAGES]);
    assert_eq!(selected(&too_few), [12 * IMAGES, full[0]]);
    assert!(too_few.notes.iter().any(|note| note.contains("at most 12 a photograph")), "{:?}", too_few.notes);
    let points = |out: &str| fs::read(street.path(out).join("sparse/0/points3D.bin")).unwrap();
    assert_eq!(points("too-few"), points("without"));
    assert_ne!(points("enough"), points("without"));
}
