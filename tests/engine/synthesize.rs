//! Features without pictures: made, reconstructed, and compared with the truth.

use std::fs;

use super::feature_street::FeatureStreet;
use super::multistage;

#[test]
fn a_set_of_features_gives_a_model_that_agrees_with_its_truth() {
    let street = FeatureStreet::new(12, 4000);
    assert_eq!(street.reconstruct("out", &[]).models[0].images, 12);
    let evaluated = multistage(&["evaluate", &street.text("out"), &street.text("scene/gt"), "--json"]);
    let accuracy: serde_json::Value = serde_json::from_slice(&evaluated.stdout).unwrap();
    let auc_at_1 = accuracy["auc_percent"][0].as_f64().unwrap();
    assert!(auc_at_1 > 90.0, "{accuracy}");

    // A folder without an index, and one whose features are cut short.
    assert_eq!(street.try_reconstruct("scene", "none", &[]).status.code(), Some(2));
    let file = street.path("scene/features/image_0003.msfeat");
    let whole = fs::read(&file).unwrap();
    fs::write(&file, &whole[..whole.len() - 5]).unwrap();
    let report = street.reconstruct("out", &[]);
    assert_eq!((report.models[0].images, report.images[3].reason.as_deref()), (11, Some("unreadable")));
}
