//! The page for people: whole, self-contained, and proof against odd names.

use std::collections::BTreeMap;

use multistage::formats::report::{
    ImageReport, ImageState, InputSummary, ModelReport, ModelStage, Report, Software, StageReport,
};
use multistage::formats::report_html;
use multistage::scene::Reconstruction;
use multistage::synthetic::{SceneOptions, generate};

const NASTY: &str = "<script>alert('x')</script> & \"friends\".jpg";

fn image(name: &str, state: ImageState) -> ImageReport {
    let placed = state == ImageState::Registered;
    ImageReport {
        name: name.into(),
        sha256: None,
        width: Some(1000),
        height: Some(800),
        state,
        model: placed.then_some(0),
        features: Some(1234),
        registered_in: placed.then(|| "add_cameras/1".into()),
        inliers: placed.then_some(567),
        mean_reprojection_error_px: placed.then_some(0.4321),
        focal_px: placed.then_some(1100.0),
        reason: (!placed).then(|| "too_few_matches".into()),
        advice: (!placed).then(|| "Take a picture <between> this one & its neighbours.".into()),
    }
}

fn report(model: &Reconstruction) -> Report {
    let mut images: Vec<ImageReport> =
        model.images().keys().map(|id| image(&format!("IMG_{}.jpg", id.0), ImageState::Registered)).collect();
    images[2].name = NASTY.into();
    images.push(image("left.jpg", ImageState::Unregistered));
    images.push(image("broken.jpg", ImageState::Rejected));
    Report {
        software: Software { name: "multistage".into(), version: "0.1.0".into() },
        seed: 0,
        threads: 2,
        options: serde_json::json!({"text": NASTY}),
        input: InputSummary { images: images.len(), megapixels: 8.0 },
        wall_s: 83.2,
        cpu_s: 150.0,
        peak_rss_bytes: Some(700 << 20),
        stages: vec![StageReport {
            name: "add_points".into(),
            iteration: Some(2),
            wall_s: 12.0,
            cpu_s: 20.0,
            reused: true,
            counts: BTreeMap::from([("pairs_tried".into(), 4321.0), ("share".into(), 0.25)]),
        }],
        models: vec![ModelReport {
            id: 0,
            images: model.images().len(),
            points: model.num_points(),
            points_3plus: model.num_points_3plus(),
            observations: model.num_observations(),
            mean_track_length: Some(3.2),
            mean_reprojection_error_px: Some(0.512),
            median_reprojection_error_px: None,
            stages: vec![ModelStage {
                stage: "coarse_model".into(),
                images: 3,
                points: 20,
                points_3plus: 10,
                mean_reprojection_error_px: Some(0.6),
                median_reprojection_error_px: None,
            }],
        }],
        images,
        look_alikes: Vec::new(),
        notes: vec!["Widened to 40 % & more.".into()],
    }
}

fn page(report: &Report, models: &[&Reconstruction], thumbnails: &BTreeMap<String, Vec<u8>>) -> String {
    let mut page = Vec::new();
    report_html::write(report, models, thumbnails, &mut page).unwrap();
    String::from_utf8(page).unwrap()
}

#[test]
fn the_page_is_whole_and_self_contained() {
    let model = generate(&SceneOptions::default()).truth;
    let report = report(&model);
    let page = page(&report, &[&model], &BTreeMap::from([(NASTY.to_owned(), vec![1, 2, 3])]));
    assert!(page.starts_with("<!doctype html>") && page.trim_end().ends_with("</html>"));
    for outside in ["http://", "https://", "<script", "src=\"/", "@import", "url("] {
        assert!(!page.contains(outside), "{outside}");
    }
    assert!(page.contains("data:image/jpeg;base64,AQID"));
    assert_eq!(page.matches("<svg").count(), 2, "a top and a side view");
    assert_eq!(page.matches("<title>").count(), 1 + 2 * model.images().len(), "every camera is named in both views");
    assert_eq!(page.matches("class=\"card ").count(), report.images.len());
    assert!(page.contains("10 of 12") && page.contains("0.51 px") && page.contains("1 min 23 s"));
    assert!(page.contains("Take a picture &lt;between&gt; this one &amp; its neighbours."));
    assert!(
        page.contains("too_few_matches")
            && page.contains("Adding points, round 2")
            && page.contains("Widened to 40 % &amp;")
    );
    assert!(!page.contains("NaN") && !page.contains("inf"), "every place on the plots is finite");
    let opened = ["div", "table", "tr", "td", "svg", "g", "figure", "ul", "details"];
    for tag in opened {
        let (open, close) = (format!("<{tag}"), format!("</{tag}>"));
        let starts = page.matches(&format!("{open}>")).count() + page.matches(&format!("{open} ")).count();
        assert_eq!(starts, page.matches(&close).count(), "{tag}");
    }
}

#[test]
fn a_run_without_a_model_has_a_page_too() {
    let model = generate(&SceneOptions { num_images: 4, ..SceneOptions::default() }).truth;
    let mut report = report(&model);
    report.models.clear();
    report.images.retain(|image| image.state != ImageState::Registered);
    let page = page(&report, &[], &BTreeMap::new());
    assert!(page.contains("No model was found") && page.contains("0 of 2") && !page.contains("<svg"));
}

#[test]
fn a_model_without_points_or_extent_is_drawn() {
    let mut model = generate(&SceneOptions { num_images: 3, num_points: 0, ..SceneOptions::default() }).truth;
    for id in [1, 2] {
        model.deregister(multistage::scene::ImageId(id));
    }
    let mut report = report(&generate(&SceneOptions { num_images: 3, ..SceneOptions::default() }).truth);
    report.models[0].points = 0;
    let page = page(&report, &[&model], &BTreeMap::new());
    assert!(page.contains("<svg") && !page.contains("NaN"));
}
