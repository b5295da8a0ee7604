//! `evaluate` on models with known errors, in every format it reads.

use std::fmt::Write as _;
use std::path::Path;

use multistage::formats::{bundler, colmap};
use multistage::geometry::{PoseAccuracy, Rigid3};
use multistage::scene::{ImageId, Reconstruction};
use multistage::synthetic::{SceneOptions, generate, perturbed};
use nalgebra::{UnitQuaternion, Vector3};

use super::{failure, multistage};

fn scene() -> Reconstruction {
    generate(&SceneOptions { num_images: 12, num_points: 60, ..SceneOptions::default() }).truth
}

/// A model in another frame, with cameras turned by half a degree, one of them by 30, and one missing.
fn flawed(truth: &Reconstruction) -> Reconstruction {
    let mut model = perturbed(truth, 0.5, 0.002, 0.0, false, 7);
    let pose = model.image(ImageId(4)).unwrap().cam_from_world;
    let turn = UnitQuaternion::from_scaled_axis(Vector3::new(0.0, 30f64.to_radians(), 0.0));
    model.set_pose(ImageId(4), Rigid3::from_center(turn * pose.rotation, &pose.target_origin_in_source()));
    model.deregister(ImageId(9));
    let ids: Vec<ImageId> = model.images().keys().copied().collect();
    let frame = UnitQuaternion::from_scaled_axis(Vector3::new(0.2, 2.0, -0.5));
    for id in ids {
        let pose = model.image(id).unwrap().cam_from_world;
        let center = 0.3 * (frame * pose.target_origin_in_source()) + Vector3::new(5.0, 6.0, 7.0);
        model.set_pose(id, Rigid3::from_center(pose.rotation * frame.inverse(), &center));
    }
    model
}

fn name(id: ImageId) -> String {
    format!("all/IMG_{:03}.jpg", id.0)
}

fn save(folder: &Path, file: &str, write: impl FnOnce(&mut Vec<u8>) -> std::io::Result<()>) {
    let mut bytes = Vec::new();
    write(&mut bytes).unwrap();
    std::fs::create_dir_all(folder).unwrap();
    std::fs::write(folder.join(file), bytes).unwrap();
}

fn save_everywhere(model: &Reconstruction, folder: &Path) {
    let names: Vec<String> = (0..20).map(|id| name(ImageId(id))).collect();
    let name_of = |id: ImageId| names[id.index()].as_str();
    save(&folder.join("run/sparse/0"), "images.bin", |out| colmap::write_images_bin(model, name_of, out));
    save(&folder.join("text"), "images.txt", |out| colmap::write_images_txt(model, name_of, out));
    save(&folder.join("bundle"), "bundle.out", |out| bundler::write_bundle(model, out));
    save(&folder.join("bundle"), "list.txt", |out| bundler::write_list(model, name_of, out));
    let (mut list, mut nvm) = ("# poses\n".to_owned(), format!("NVM_V3\n\n{}\n", model.images().len()));
    for (&id, image) in model.images() {
        let (q, c) = (image.cam_from_world.rotation, image.center_in_world());
        let pose = format!("{} {} {} {} {} {} {}", q.w, q.i, q.j, q.k, c.x, c.y, c.z);
        writeln!(list, "{} {pose}", name(id)).unwrap();
        writeln!(nvm, "{} 1000 {pose} 0 0", name(id)).unwrap();
        let r = image.cam_from_world.rotation_matrix().transpose();
        let rows: String = (0..3).map(|row| format!("{} {} {}\n", r[(row, 0)], r[(row, 1)], r[(row, 2)])).collect();
        let camera = format!("1000 0 500\n0 1000 400\n0 0 1\n0 0 0\n{rows}{} {} {}\n1000 800\n", c.x, c.y, c.z);
        let file = format!("img_{:03}.jpg.camera", id.0);
        std::fs::create_dir_all(folder.join("strecha")).unwrap();
        std::fs::write(folder.join("strecha").join(file), camera).unwrap();
    }
    std::fs::write(folder.join("poses.txt"), list).unwrap();
    std::fs::write(folder.join("model.nvm"), nvm).unwrap();
}

fn evaluated(model: &Path, reference: &Path) -> PoseAccuracy {
    let output = multistage(&["evaluate", model.to_str().unwrap(), reference.to_str().unwrap(), "--json"]);
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    serde_json::from_slice(&output.stdout).unwrap()
}

#[test]
fn every_format_gives_the_same_measures() {
    let folder = tempfile::tempdir().unwrap();
    let (truth, model) = (folder.path().join("truth"), folder.path().join("model"));
    save_everywhere(&scene(), &truth);
    save_everywhere(&flawed(&scene()), &model);
    let first = evaluated(&model.join("run"), &truth.join("run/sparse/0"));
    assert_eq!((first.reference_images, first.registered, first.extra), (12, 11, 0));
    let aligned = first.aligned.as_ref().unwrap();
    assert!((aligned.rotation_deg.median - 0.5).abs() < 0.1, "{aligned:?}");
    assert!((aligned.rotation_deg.max - 30.0).abs() < 1.0, "{aligned:?}");
    assert!(aligned.center_mean_relative < 0.005, "{aligned:?}");
    // 11 pairs lack an image, 10 have the turned one: at most 45 of 66 count.
    let auc = first.auc_percent.unwrap();
    assert!(auc[3] < 100.0 * 45.0 / 66.0 && auc[3] > 55.0 && auc.is_sorted(), "{auc:?}");
    for other in ["text", "bundle", "bundle/bundle.out", "poses.txt", "model.nvm", "strecha"] {
        let again = evaluated(&model.join(other), &truth.join(other));
        let (a, b) = (again.aligned.as_ref().unwrap(), aligned);
        assert!((a.center.mean - b.center.mean).abs() < 1e-6, "{other}: {again:?}");
        assert!((a.rotation_deg.mean - b.rotation_deg.mean).abs() < 1e-4, "{other}: {again:?}");
        assert!(again.auc_percent.unwrap().iter().zip(auc).all(|(a, b)| (a - b).abs() < 1e-3), "{other}: {again:?}");
    }
}

#[test]
fn what_can_not_be_read_ends_with_status_2() {
    let folder = tempfile::tempdir().unwrap();
    save_everywhere(&scene(), folder.path());
    let path = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::write(folder.path().join("notes.md"), "no model").unwrap();
    std::fs::write(folder.path().join("broken.nvm"), "NVM_V3\n3\na.jpg 1 2\n").unwrap();
    std::fs::create_dir(folder.path().join("empty")).unwrap();
    let cases = [("absent", "no such file"), ("notes.md", "neither"), ("empty", "neither"), ("broken.nvm", "no pose")];
    for (file, words) in cases {
        let (code, message) = failure(&["evaluate", &path(file), &path("poses.txt")]);
        assert_eq!(code, 2, "{file}: {message}");
        assert!(message.contains(words) && message.contains(file), "{message}");
    }
}
