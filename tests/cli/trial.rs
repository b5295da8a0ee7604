//! The trial with few features: taken where it places the photographs, and forgotten where it does not.

use std::fs;
use std::path::Path;

use multistage::formats::report::Report;

use super::multistage;

const IMAGES: usize = 26;

fn reconstruct(folder: &Path, name: &str, trial: &str) -> Report {
    let at = |name: &str| folder.join(name).to_str().unwrap().to_owned();
    let trial = format!("coarse.selection.trial_max_features={trial}");
    let (features, out) = (at("scene/features"), at(name));
    let run = multistage(&[
        "reconstruct",
        &features,
        "--out",
        &out,
        "--quiet",
        "--set",
        "intake.ready_features=true",
        "--set",
        &trial,
    ]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    serde_json::from_slice(&fs::read(folder.join(name).join("report.json")).unwrap()).unwrap()
}

/// Features that each round of coarse matching used.
fn selected(report: &Report) -> Vec<usize> {
    let rounds = report.stages.iter().filter(|stage| stage.name == "coarse_match");
    rounds.map(|stage| stage.counts["features_selected"] as usize).collect()
}

#[test]
fn a_trial_with_few_features_is_enough_or_leaves_no_trace() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let spec = format!(
        r#"{{"scene": "features", "layout": "street", "num_images": {IMAGES}, "num_points": 12000,
            "pixel_noise_px": 0.3, "descriptor_noise": 0.2}}"#
    );
    fs::write(at("spec.json"), spec).unwrap();
    let made = multistage(&["synthesize", &at("spec.json"), "--out", &at("scene")]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));

    let without = reconstruct(folder.path(), "without", "null");
    let enough = reconstruct(folder.path(), "enough", "1280");
    let too_few = reconstruct(folder.path(), "too-few", "12");
    for report in [&without, &enough, &too_few] {
        assert_eq!(report.models[0].images, IMAGES);
    }
    let full = selected(&without);
    assert!(full.len() == 1 && full[0] > 1280 * IMAGES, "{full:?}");
    assert_eq!(selected(&enough), [1280 * IMAGES]);
    assert_eq!(selected(&too_few), [12 * IMAGES, full[0]]);
    assert!(too_few.notes.iter().any(|note| note.contains("at most 12 a photograph")), "{:?}", too_few.notes);
    let points = |name: &str| fs::read(folder.path().join(name).join("sparse/0/points3D.bin")).unwrap();
    assert_eq!(points("too-few"), points("without"));
    assert_ne!(points("enough"), points("without"));
}
