//! A street of features without pictures, and reconstructions of it.

use std::fs;
use std::path::PathBuf;
use std::process::Output;

use multistage::formats::report::Report;
use tempfile::TempDir;

use super::multistage;

pub struct FeatureStreet {
    folder: TempDir,
}

impl FeatureStreet {
    /// Makes `scene/features` and its truth, `scene/gt`.
    pub fn new(num_images: usize, num_points: usize) -> Self {
        let street = Self { folder: tempfile::tempdir().unwrap() };
        let spec = format!(
            r#"{{"scene": "features", "layout": "street", "num_images": {num_images}, "num_points": {num_points},
                "pixel_noise_px": 0.3, "descriptor_noise": 0.2}}"#
        );
        fs::write(street.path("spec.json"), spec).unwrap();
        let made = multistage(&["synthesize", &street.text("spec.json"), "--out", &street.text("scene")]);
        assert!(made.status.success(), "{}", String::from_utf8_lossy(&made.stderr));
        street
    }

    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    pub fn text(&self, name: &str) -> String {
        self.path(name).to_str().unwrap().to_owned()
    }

    /// Reconstructs the features in the folder `input` into `out`.
    pub fn try_reconstruct(&self, input: &str, out: &str, extra: &[&str]) -> Output {
        let (input, out) = (self.text(input), self.text(out));
        let mut args = vec!["reconstruct", &input, "--out", &out, "--quiet", "--set", "intake.ready_features=true"];
        args.extend(extra);
        multistage(&args)
    }

    /// Reconstructs the street into `out`.
    pub fn reconstruct(&self, out: &str, extra: &[&str]) -> Report {
        let run = self.try_reconstruct("scene/features", out, extra);
        assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
        serde_json::from_slice(&fs::read(self.path(out).join("report.json")).unwrap()).unwrap()
    }
}
