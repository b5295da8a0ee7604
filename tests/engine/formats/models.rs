//! Model files: what is written is read back, by our readers and by others, and an external reader finds the reprojection
//! errors of the model.

use std::collections::BTreeMap;
use std::io::BufRead;

use multistage::camera::{Camera, CameraModel};
use multistage::formats::{FormatError, bundler, colmap, ply};
use multistage::scene::{CameraId, ImageId, Reconstruction};
use multistage::synthetic::{SceneOptions, generate};
use nalgebra::{Matrix3, Vector2, Vector3};
use ply_rs_bw::parser::Parser;
use ply_rs_bw::ply::{DefaultElement, Property};
use proptest::prelude::*;

/// A noisy model. Its second camera is used by no image; its principal point is off the centre.
fn noisy_model(camera_model: CameraModel) -> Reconstruction {
    let options =
        SceneOptions { camera_model, num_images: 6, num_points: 150, pixel_noise_px: 0.7, ..SceneOptions::default() };
    let mut model = generate(&options).truth;
    let mut unused: Camera = model.cameras[&CameraId(0)].clone();
    unused.set_focal(1.0, 1.0);
    model.cameras.insert(CameraId(7), unused);
    let camera = model.cameras.get_mut(&CameraId(0)).unwrap();
    let (fx, _) = camera.focal();
    camera.set_focal(fx, if camera.model.has_two_focals() { 1.004 * fx } else { fx });
    camera.set_principal_point(507.0, 393.5);
    model
}

fn names(model: &Reconstruction) -> BTreeMap<ImageId, String> {
    model.images().keys().map(|id| (*id, format!("walk {}/façade {}.jpg", id.0 % 2, id.0))).collect()
}

fn mean_error_px(model: &Reconstruction) -> f64 {
    let errors = model.reprojection_errors_px();
    errors.iter().sum::<f64>() / errors.len() as f64
}

fn written(write: impl FnOnce(&mut Vec<u8>) -> std::io::Result<()>) -> Vec<u8> {
    let mut bytes = Vec::new();
    write(&mut bytes).unwrap();
    bytes
}

/// The three files, binary or text.
fn colmap_files(model: &Reconstruction, text: bool) -> [Vec<u8>; 3] {
    let names = names(model);
    let name_of = |id| names[&id].as_str();
    if text {
        [
            written(|out| colmap::write_cameras_txt(model, out)),
            written(|out| colmap::write_images_txt(model, name_of, out)),
            written(|out| colmap::write_points3d_txt(model, out)),
        ]
    } else {
        [
            written(|out| colmap::write_cameras_bin(model, out)),
            written(|out| colmap::write_images_bin(model, name_of, out)),
            written(|out| colmap::write_points3d_bin(model, out)),
        ]
    }
}

fn read_colmap(files: &[Vec<u8>; 3], text: bool) -> Result<colmap::ColmapModel, FormatError> {
    let [cameras, images, points] = files;
    Ok(if text {
        colmap::ColmapModel {
            cameras: colmap::read_cameras_txt(&mut cameras.as_slice())?,
            images: colmap::read_images_txt(&mut images.as_slice())?,
            points: colmap::read_points3d_txt(&mut points.as_slice())?,
        }
    } else {
        colmap::ColmapModel {
            cameras: colmap::read_cameras_bin(&mut cameras.as_slice())?,
            images: colmap::read_images_bin(&mut images.as_slice())?,
            points: colmap::read_points3d_bin(&mut points.as_slice())?,
        }
    })
}

#[test]
fn colmap_files_hold_the_whole_model() {
    for camera_model in CameraModel::ALL {
        for text in [false, true] {
            let model = noisy_model(camera_model);
            let read = read_colmap(&colmap_files(&model, text), text).unwrap();
            assert_eq!(read.cameras.keys().collect::<Vec<_>>(), [&1], "only cameras in use are written");
            assert_eq!(read.points.len(), model.num_points());
            let per_point: f64 = read.points.values().map(|point| point.error_px * point.track.len() as f64).sum();
            assert!((per_point / model.num_observations() as f64 - mean_error_px(&model)).abs() < 1e-9);
            let image = &read.images[&3];
            assert_eq!(image.points2d.len(), model.image(ImageId(2)).unwrap().keypoints.len());
            assert!(
                image.points2d.iter().any(|point| point.point_id.is_none()),
                "keypoints without a point are written"
            );

            let (again, again_names) = read.into_reconstruction().unwrap();
            again.assert_consistent();
            assert_eq!(again_names, names(&model));
            assert_eq!(again.cameras[&CameraId(0)].params, model.cameras[&CameraId(0)].params);
            assert!((mean_error_px(&again) - mean_error_px(&model)).abs() < 1e-6);
            for ((_, point), (_, before)) in again.points().zip(model.points()) {
                assert_eq!((point.xyz, point.color, &point.track), (before.xyz, before.color, &before.track));
            }
        }
    }
}

#[test]
fn colmap_binary_has_the_documented_layout() {
    let model = noisy_model(CameraModel::SimpleRadial);
    let [cameras, images, points] = colmap_files(&model, false);
    assert_eq!(cameras[..8], 1u64.to_le_bytes());
    assert_eq!(cameras[8..16], [1, 0, 0, 0, 2, 0, 0, 0], "camera 1 of model 2");
    assert_eq!(cameras.len(), 8 + 4 + 4 + 16 + 4 * 8);
    let pose = model.image(ImageId(0)).unwrap().cam_from_world;
    let number = |at: usize| f64::from_le_bytes(images[at..at + 8].try_into().unwrap());
    assert_eq!([12, 20, 28, 36].map(number), [pose.rotation.w, pose.rotation.i, pose.rotation.j, pose.rotation.k]);
    assert_eq!([44, 52, 60].map(number), [pose.translation.x, pose.translation.y, pose.translation.z]);
    assert_eq!(points[..8], (model.num_points() as u64).to_le_bytes());
}

#[test]
fn damaged_colmap_files_are_errors() {
    let model = noisy_model(CameraModel::Radial);
    for text in [false, true] {
        let files = colmap_files(&model, text);
        for damaged in 0..3 {
            let mut cut = files.clone();
            let len = cut[damaged].len();
            cut[damaged].truncate(len - 4);
            let result = read_colmap(&cut, text).map(colmap::ColmapModel::into_reconstruction);
            assert!(text || matches!(result, Err(FormatError::Malformed { .. })), "file {damaged}");
        }
    }
    // A count of 2^63 entries neither allocates nor succeeds.
    let giant = [&(1u64 << 63).to_le_bytes()[..], &[0; 40]].concat();
    assert!(colmap::read_points3d_bin(&mut giant.as_slice()).is_err());
    assert!(colmap::read_images_bin(&mut giant.as_slice()).is_err());
    let mut model = read_colmap(&colmap_files(&model, false), false).unwrap();
    model.points.values_mut().next().unwrap().track.push((99, 0));
    assert!(model.into_reconstruction().is_err());
}

/// A reader of `bundle.out` as the manual describes it: projects every point into every camera that sees it.
fn bundle_errors_px(file: &[u8]) -> Vec<f64> {
    let mut numbers = file
        .lines()
        .map(Result::unwrap)
        .filter(|line| !line.starts_with('#'))
        .flat_map(|line| line.split_whitespace().map(|n| n.parse::<f64>().unwrap()).collect::<Vec<_>>());
    let mut next = || numbers.next().unwrap();
    let (num_cameras, num_points) = (next() as usize, next() as usize);
    let mut cameras = Vec::new();
    for _ in 0..num_cameras {
        let intrinsics = [next(), next(), next()];
        let rotation = Matrix3::from_row_iterator((0..9).map(|_| next()));
        cameras.push((intrinsics, rotation, Vector3::new(next(), next(), next())));
    }
    let mut errors = Vec::new();
    for _ in 0..num_points {
        let point = Vector3::new(next(), next(), next());
        let _color = [next(), next(), next()];
        for _ in 0..next() as usize {
            let ([f, k1, k2], rotation, translation) = &cameras[next() as usize];
            let _key = next();
            let measured = Vector2::new(next(), next());
            let in_camera = rotation * point + translation;
            assert!(in_camera.z < 0.0, "Bundler's cameras look along -z");
            let p = -in_camera.xy() / in_camera.z;
            let radius_sq = p.norm_squared();
            errors.push((f * (1.0 + k1 * radius_sq + k2 * radius_sq * radius_sq) * p - measured).norm());
        }
    }
    assert_eq!(numbers.next(), None);
    errors
}

#[test]
fn bundler_files_reproject_alike() {
    for camera_model in CameraModel::ALL {
        let model = noisy_model(camera_model);
        let errors = bundle_errors_px(&written(|out| bundler::write_bundle(&model, out)));
        assert_eq!(errors.len(), model.num_observations());
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        assert!((mean - mean_error_px(&model)).abs() < 1e-6, "{camera_model:?}: {mean}");
    }
}

#[test]
fn a_bundler_camera_stays_near_a_tangential_one() {
    let model = noisy_model(CameraModel::OpenCv);
    let file = written(|out| bundler::write_bundle(&model, out));
    let text = String::from_utf8(file).unwrap();
    let intrinsics: Vec<f64> = text.lines().nth(2).unwrap().split(' ').map(|n| n.parse().unwrap()).collect();
    let camera = &model.cameras[&CameraId(0)];
    assert!((intrinsics[0] / camera.mean_focal_px() - 1.0).abs() < 0.003, "{intrinsics:?}");
    assert!((intrinsics[1] - camera.distortion()[0]).abs() < 0.02, "{intrinsics:?}");
}

#[test]
fn with_a_centred_principal_point_bundler_keypoints_are_plain() {
    let mut model = noisy_model(CameraModel::Radial);
    model.cameras.get_mut(&CameraId(0)).unwrap().set_principal_point(500.0, 400.0);
    let text = String::from_utf8(written(|out| bundler::write_bundle(&model, out))).unwrap();
    let (_, point) = model.points().next().unwrap();
    let views = text.lines().nth(2 + 5 * model.images().len() + 2).unwrap();
    let fields: Vec<f64> = views.split(' ').map(|n| n.parse().unwrap()).collect();
    let seen = point.track[0];
    let keypoint = model.image(seen.image).unwrap().keypoints[seen.keypoint.index()].0;
    assert_eq!(fields[..3], [point.track.len() as f64, f64::from(seen.image.0), f64::from(seen.keypoint.0)]);
    assert!((fields[3] - (keypoint.x - 500.0)).abs() < 1e-9 && (fields[4] - (400.0 - keypoint.y)).abs() < 1e-9);
}

#[test]
fn bundler_poses_and_names_come_back() {
    let model = noisy_model(CameraModel::Pinhole);
    let names = names(&model);
    let poses = bundler::read_bundle_poses(&mut written(|out| bundler::write_bundle(&model, out)).as_slice()).unwrap();
    for (pose, image) in poses.iter().zip(model.images().values()) {
        let difference = pose.unwrap().compose(&image.cam_from_world.inverse());
        assert!(difference.rotation.angle() < 1e-9 && difference.translation.norm() < 1e-9);
    }
    let list = written(|out| bundler::write_list(&model, |id| names[&id].as_str(), out));
    assert_eq!(bundler::read_list(&mut list.as_slice()).unwrap(), names.into_values().collect::<Vec<_>>());
    let hints = "a.jpg 0 660.8\nb.jpg 0\nc.jpg\n";
    assert_eq!(bundler::read_list(&mut hints.as_bytes()).unwrap(), ["a.jpg", "b.jpg", "c.jpg"]);
}

fn float(element: &DefaultElement, name: &str) -> f64 {
    match element[name] {
        Property::Float(value) => f64::from(value),
        ref other => panic!("{name} is {other:?}"),
    }
}

#[test]
fn a_ply_library_reads_points_and_cameras() {
    let model = noisy_model(CameraModel::Radial);
    let file = written(|out| ply::write_points(&model, out));
    let cloud = Parser::<DefaultElement>::new().read_ply(&mut file.as_slice()).unwrap();
    let vertices = &cloud.payload["vertex"];
    assert_eq!(vertices.len(), model.num_points());
    for (vertex, (_, point)) in vertices.iter().zip(model.points()) {
        let xyz = Vector3::new(float(vertex, "x"), float(vertex, "y"), float(vertex, "z"));
        assert!((xyz - point.xyz).norm() < 1e-5 * point.xyz.norm().max(1.0));
        let color = ["red", "green", "blue"].map(|name| vertex[name].clone());
        assert_eq!(color, point.color.map(Property::UChar));
    }

    let file = written(|out| ply::write_cameras(&model, out));
    let frusta = Parser::<DefaultElement>::new().read_ply(&mut file.as_slice()).unwrap();
    let count = model.images().len();
    assert_eq!(frusta.payload["vertex"].len(), 5 * count);
    assert_eq!(frusta.payload["face"].len(), 4 * count);
    assert_eq!(frusta.payload["edge"].len(), 8 * count);
    for (vertex, image) in frusta.payload["vertex"].iter().step_by(5).zip(model.images().values()) {
        let center = Vector3::new(float(vertex, "x"), float(vertex, "y"), float(vertex, "z"));
        assert!((center - image.center_in_world()).norm() < 1e-5);
    }
    for face in &frusta.payload["face"] {
        let Property::ListInt(corners) = &face["vertex_indices"] else { panic!("{face:?}") };
        assert!(corners.len() == 3 && corners.iter().all(|&corner| (corner as usize) < 5 * count));
    }
}

#[test]
fn an_empty_model_is_written_too() {
    let model = Reconstruction::new(BTreeMap::new());
    let files = colmap_files(&model, false);
    assert_eq!(read_colmap(&files, false).unwrap(), colmap::ColmapModel::default());
    assert!(bundle_errors_px(&written(|out| bundler::write_bundle(&model, out))).is_empty());
    for file in [written(|out| ply::write_points(&model, out)), written(|out| ply::write_cameras(&model, out))] {
        assert!(Parser::<DefaultElement>::new().read_ply(&mut file.as_slice()).unwrap().payload["vertex"].is_empty());
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(80))]

    /// Whatever happens to a model's bytes, reading ends with a model or an error.
    #[test]
    fn mangled_model_files_never_panic(
        file in 0usize..3,
        text in any::<bool>(),
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..8),
        keep in any::<prop::sample::Index>(),
    ) {
        let options = SceneOptions { num_images: 3, num_points: 12, ..SceneOptions::default() };
        let model = generate(&options).truth;
        let mut files = colmap_files(&model, text);
        let mut bundle = written(|out| bundler::write_bundle(&model, out));
        for bytes in [&mut files[file], &mut bundle] {
            for (at, value) in &flips {
                let at = at.index(bytes.len());
                bytes[at] = *value;
            }
            if keep.index(4) == 0 {
                bytes.truncate(keep.index(bytes.len()));
            }
        }
        if let Ok(read) = read_colmap(&files, text) {
            let _ = read.into_reconstruction();
        }
        let _ = bundler::read_bundle_poses(&mut bundle.as_slice());
        let _ = bundler::read_list(&mut bundle.as_slice());
    }
}
