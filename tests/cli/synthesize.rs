//! Features without pictures: made, reconstructed, and compared with the truth.

use std::fs;

use multistage::formats::report::Report;

use super::multistage;

#[test]
fn a_set_of_features_gives_a_model_that_agrees_with_its_truth() {
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let spec = r#"{"scene": "features", "layout": "street", "num_images": 12, "num_points": 4000,
                   "pixel_noise_px": 0.3, "descriptor_noise": 0.2}"#;
    fs::write(at("spec.json"), spec).unwrap();
    let made = multistage(&["synthesize", &at("spec.json"), "--out", &at("scene")]);
    assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));

    let reconstruct = |input: &str, extra: &[&str]| {
        let out = at("out");
        let mut args = vec!["reconstruct", input, "--out", &out, "--quiet", "--set", "intake.ready_features=true"];
        args.extend(extra);
        multistage(&args)
    };
    let run = reconstruct(&at("scene/features"), &[]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let report: Report = serde_json::from_slice(&fs::read(at("out/report.json")).unwrap()).unwrap();
    assert_eq!(report.models[0].images, 12);
    let evaluated = multistage(&["evaluate", &at("out"), &at("scene/gt"), "--json"]);
    let accuracy: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let auc_at_1 = accuracy["auc_percent"][0].as_f64().unwrap();
    assert!(auc_at_1 > 90.0, "{accuracy}");

    // A folder without an index, and one whose features are cut short.
    assert_eq!(reconstruct(&at("scene"), &[]).status.code(), Some(2));
    let file = at("scene/features/image_0003.msfeat");
    let whole = fs::read(&file).unwrap();
    fs::write(&file, &whole[..whole.len() - 5]).unwrap();
    assert!(reconstruct(&at("scene/features"), &[]).status.success());
    let report: Report = serde_json::from_slice(&fs::read(at("out/report.json")).unwrap()).unwrap();
    assert_eq!((report.models[0].images, report.images[3].reason.as_deref()), (11, Some("unreadable")));
}
