//! Photographs whose focal length is not what it seems: zoomed without EXIF, or cropped with the EXIF of the original.

use std::collections::BTreeMap;
use std::path::Path;

use multistage::formats::report::{ImageState, Report};
use serde_json::{Value, json};

use super::multistage;

const WIDTH_PX: f64 = 640.0;
const FOCAL_RATIO: f64 = 0.86;

/// Renders 14 photographs of the temple with these further options and reconstructs them.
fn reconstructed(options: Value) -> Report {
    let folder = tempfile::tempdir().unwrap();
    let mut spec = json!({
        "scene": "temple", "num_images": 14, "arc_deg": 150, "width": 640, "height": 480, "focal_ratio": FOCAL_RATIO,
    });
    spec.as_object_mut().unwrap().extend(options.as_object().unwrap().clone());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(path("spec.json"), spec.to_string()).unwrap();
    for args in [
        vec!["synthesize".to_owned(), path("spec.json"), "--out".to_owned(), path("")],
        vec!["reconstruct".to_owned(), path("images"), "--out".to_owned(), path("out")],
    ] {
        let run = multistage(&args.iter().map(String::as_str).collect::<Vec<_>>());
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    }
    serde_json::from_slice(&std::fs::read(Path::new(&path("out")).join("report.json")).unwrap()).unwrap()
}

/// The focal length found for every photograph, by name.
fn focals_px(report: &Report) -> BTreeMap<&str, f64> {
    assert!(report.images.iter().all(|image| image.state == ImageState::Registered), "{:?}", report.images);
    assert_eq!(report.models.len(), 1);
    report.images.iter().map(|image| (image.name.as_str(), image.focal_px.unwrap())).collect()
}

#[test]
fn two_zooms_of_one_camera_without_exif_are_told_apart() {
    let zoom = 1.35;
    let report = reconstructed(json!({ "zoom": zoom, "exif_focal_factor": null }));
    for (at, (name, focal_px)) in focals_px(&report).into_iter().enumerate() {
        let truth_px = WIDTH_PX * FOCAL_RATIO * if at % 2 == 0 { 1.0 } else { zoom };
        assert!((focal_px / truth_px - 1.0).abs() < 0.02, "{name}: {focal_px} px, not {truth_px}");
    }
}

#[test]
fn an_exif_focal_length_that_is_off_by_two_is_not_believed() {
    for factor in [0.5, 2.0] {
        let report = reconstructed(json!({ "exif_focal_factor": factor }));
        for (name, focal_px) in focals_px(&report) {
            let truth_px = WIDTH_PX * FOCAL_RATIO;
            assert!((focal_px / truth_px - 1.0).abs() < 0.02, "{name}: {focal_px} px, not {truth_px}");
        }
    }
}
