//! `reconstruct` in the foreground: exit status, outputs, options, and readers that are not ours.

use std::path::{Path, PathBuf};
use std::process::Command;

use image::{ImageBuffer, Rgb};
use multistage::formats::report::{ImageState, Report};
use multistage::math::Rng;

use super::{failure, multistage};

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn report_of(out: &Path) -> Report {
    serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap()
}

#[test]
fn bad_input_and_options_end_with_status_2() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let (images, out) = (text(&images).to_owned(), text(&folder.path().join("out")).to_owned());
    let broken = folder.path().join("broken.json");
    std::fs::write(&broken, "{\"iterations\": ").unwrap();
    let wrong = folder.path().join("wrong.json");
    std::fs::write(&wrong, "{\"intake\": {\"max_long_side_px\": \"big\"}}").unwrap();
    let cases: &[(&[&str], &str)] = &[
        (&["reconstruct", &images], "--out"),
        (&["reconstruct", "/nonexistent/folder", "--out", &out], "/nonexistent/folder"),
        (&["reconstruct", &images, "--out", &out, "--set", "iteration=1"], "there is no `iteration`"),
        (&["reconstruct", &images, "--out", &out, "--set", "iterations=many"], "option iterations"),
        (&["reconstruct", &images, "--out", &out, "--set", "iterations=0"], "iterations"),
        (&["reconstruct", &images, "--out", &out, "--options", text(&broken)], "broken.json"),
        (&["reconstruct", &images, "--out", &out, "--options", text(&wrong)], "option intake.max_long_side_px"),
        (&["reconstruct", &images, "--out", &out, "--threads", "0"], "--threads"),
    ];
    for (args, words) in cases {
        let (code, message) = failure(args);
        assert_eq!(code, 2, "{args:?}: {message}");
        assert!(message.contains(words), "{args:?}: {message}");
    }
}

#[test]
fn options_are_printed_with_what_was_set() {
    let args = ["reconstruct", ".", "--out", "out", "--set", "iterations=1", "--print-options"];
    let output = multistage(&args);
    assert!(output.status.success());
    let options: serde_json::Value = serde_json::from_slice(&output.stdout).unwrap();
    assert_eq!(options["iterations"], 1);
    assert!(!Path::new("out").exists(), "nothing else is done");
}

/// A picture of nothing: smooth noise of its own.
fn unrelated_picture(seed: u64) -> ImageBuffer<Rgb<u8>, Vec<u8>> {
    let mut rng = Rng::from_parts(&[seed]);
    let coarse = ImageBuffer::from_fn(40, 30, |_, _| Rgb([0; 3].map(|_: u8| rng.below(256) as u8)));
    image::imageops::resize(&coarse, 320, 240, image::imageops::FilterType::CatmullRom)
}

#[test]
fn unrelated_pictures_end_with_status_3_and_a_report() {
    let folder = tempfile::tempdir().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    std::fs::create_dir(&images).unwrap();
    for seed in 0..3 {
        unrelated_picture(seed).save(images.join(format!("{seed}.png"))).unwrap();
    }
    std::fs::write(images.join("letter.jpg"), "no picture").unwrap();
    let (code, message) = failure(&["reconstruct", text(&images), "--out", text(&out), "--threads", "2"]);
    assert_eq!(code, 3, "{message}");
    let report = report_of(&out);
    assert!(report.models.is_empty());
    assert_eq!(report.images.len(), 4);
    for image in &report.images {
        assert_ne!(image.state, ImageState::Registered);
        assert!(image.reason.is_some() && image.advice.is_some(), "{image:?}");
    }
    let letter = report.images.iter().find(|image| image.name == "letter.jpg").unwrap();
    assert_eq!((letter.state, letter.reason.as_deref()), (ImageState::Rejected, Some("unreadable")));
    assert!(std::fs::read_to_string(out.join("report.html")).unwrap().contains("No model was found"));
    assert!(!out.join(".work").exists(), "what was kept for resuming goes when the run is done");
}

/// A small set of photographs, or why there is none.
fn photographs() -> Result<PathBuf, &'static str> {
    let images = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets/bundler-et/images");
    images.is_dir().then_some(images).ok_or("skipped: there are no test photographs at ../shared/datasets/bundler-et")
}

#[test]
fn photographs_become_a_model_that_other_readers_agree_on() {
    let images = match photographs() {
        Ok(images) => images,
        Err(reason) => return println!("{reason}"),
    };
    let folder = tempfile::tempdir().unwrap();
    let out = folder.path().join("out");
    let output = multistage(&["reconstruct", text(&images), "--out", text(&out), "--set", "iterations=1"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    let summary = String::from_utf8(output.stdout).unwrap();
    assert!(summary.contains("Model 0: ") && summary.contains("mean reprojection error"), "{summary}");
    for file in [
        "report.json",
        "report.html",
        "sparse/0/cameras.bin",
        "sparse/0/images.bin",
        "sparse/0/points3D.bin",
        "sparse/0/cameras.txt",
        "sparse/0/images.txt",
        "sparse/0/points3D.txt",
        "bundle/0/bundle.out",
        "bundle/0/list.txt",
        "ply/0/points.ply",
        "ply/0/cameras.ply",
    ] {
        assert!(out.join(file).metadata().is_ok_and(|file| file.len() > 0), "{file} is missing or empty");
    }
    let report = report_of(&out);
    assert!(report.models[0].images >= 8, "{} of 9 photographs", report.models[0].images);
    let itself = multistage(&["evaluate", text(&out), text(&out.join("bundle/0/bundle.out"))]);
    assert!(String::from_utf8(itself.stdout).unwrap().contains("AUC@1  deg      100.00"));

    let Ok(python) = std::env::var("MULTISTAGE_PYTHON") else {
        return println!("skipped: MULTISTAGE_PYTHON names no python with pycolmap and numpy");
    };
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/tools/check_with_pycolmap.py");
    let check = Command::new(python).arg(script).arg(&out).output().unwrap();
    let said = String::from_utf8_lossy(&check.stdout);
    assert!(check.status.success(), "{said}{}", String::from_utf8_lossy(&check.stderr));
    println!("{said}");
}
