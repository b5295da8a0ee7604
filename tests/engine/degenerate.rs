//! Sets that leave a two-view geometry undetermined or mislead it: views turned on the spot, a flat scene, and a
//! background that stands still in the frame.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

use image::{Rgb, RgbImage};
use multistage::formats::colmap::{ColmapModel, read_cameras_bin, read_images_bin, read_points3d_bin};
use multistage::math::Rng;
use multistage::scene::Reconstruction;
use nalgebra::{Matrix3, Rotation3, Vector3};

use super::multistage;
use super::rendered::photographs;

const SIZE_PX: [u32; 2] = [640, 480];
const NUM_PHOTOGRAPHS: usize = 9;
/// The rendered photographs' focal length.
const FOCAL_PX: f64 = 0.86 * 640.0;
/// Photographs of the object on the turntable, and what of the frame's size it fills.
const NUM_TURNED: usize = 10;
const OBJECT_RADIUS: f64 = 0.38;

fn calibration(focal_px: f64) -> Matrix3<f64> {
    let [width, height] = SIZE_PX.map(f64::from);
    Matrix3::new(focal_px, 0.0, width / 2.0, 0.0, focal_px, height / 2.0, 0.0, 0.0, 1.0)
}

/// The picture that shows `source` through a homography from its pixels to the source's, with a little noise; black beyond.
fn warped(source: &RgbImage, to_source: &Matrix3<f64>, rng: &mut Rng) -> RgbImage {
    RgbImage::from_fn(SIZE_PX[0], SIZE_PX[1], |x, y| {
        let at = to_source * Vector3::new(f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0);
        let (x, y) = (at.x / at.z - 0.5, at.y / at.z - 0.5);
        let inside = x >= 0.0 && y >= 0.0 && x < f64::from(source.width() - 1) && y < f64::from(source.height() - 1);
        if !inside {
            return Rgb([0; 3]);
        }
        let (part_x, part_y) = (x.fract(), y.fract());
        let pixel = |dx: u32, dy: u32| source.get_pixel(x as u32 + dx, y as u32 + dy).0.map(f64::from);
        let (a, b, c, d) = (pixel(0, 0), pixel(1, 0), pixel(0, 1), pixel(1, 1));
        let noise = rng.range(-2.0, 2.0);
        Rgb(std::array::from_fn(|k| {
            let upper = a[k] * (1.0 - part_x) + b[k] * part_x;
            let lower = c[k] * (1.0 - part_x) + d[k] * part_x;
            (upper * (1.0 - part_y) + lower * part_y + noise).clamp(0.0, 255.0) as u8
        }))
    })
}

/// The centres of the largest model's cameras by the names of their pictures.
fn centers(images: &Path, out: &Path) -> BTreeMap<String, Vector3<f64>> {
    let run = multistage(&["reconstruct", images.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let open = |name: &str| BufReader::new(File::open(out.join("sparse/0").join(name)).unwrap());
    let model = ColmapModel {
        cameras: read_cameras_bin(&mut open("cameras.bin")).unwrap(),
        images: read_images_bin(&mut open("images.bin")).unwrap(),
        points: read_points3d_bin(&mut open("points3D.bin")).unwrap(),
    };
    let (model, names): (Reconstruction, _) = model.into_reconstruction().unwrap();
    model.images().iter().map(|(id, image)| (names[id].clone(), image.center_in_world())).collect()
}

fn extent(centers: impl Iterator<Item = Vector3<f64>> + Clone) -> f64 {
    let low = centers.clone().fold(Vector3::repeat(f64::INFINITY), |low, at| low.inf(&at));
    let high = centers.fold(Vector3::repeat(f64::NEG_INFINITY), |high, at| high.sup(&at));
    (high - low).norm()
}

#[test]
fn views_turned_on_the_spot_find_the_same_spot() {
    let folder = tempfile::tempdir().unwrap();
    let (spec, images) = (folder.path().join("spec.json"), folder.path().join("images"));
    // A lens without distortion, so that a turn is a homography.
    let options = serde_json::json!({
        "scene": "temple", "num_images": NUM_PHOTOGRAPHS, "arc_deg": 100, "width": SIZE_PX[0], "height": SIZE_PX[1], "k1": 0,
    });
    std::fs::write(&spec, options.to_string()).unwrap();
    let rendered = multistage(&["synthesize", spec.to_str().unwrap(), "--out", folder.path().to_str().unwrap()]);
    assert!(rendered.status.success(), "{}", String::from_utf8_lossy(&rendered.stderr));
    let source = image::open(images.join("temple_004.jpg")).unwrap().to_rgb8();
    let (k, mut rng) = (calibration(FOCAL_PX), Rng::from_parts(&[1]));
    for (at, [pitch, yaw, roll]) in [[0.0, 0.12, 0.0], [0.03, -0.12, 0.0], [-0.05, 0.08, 0.15]].into_iter().enumerate()
    {
        let turn = Rotation3::from_euler_angles(pitch, yaw, roll);
        let to_source = k * turn.matrix() * k.try_inverse().unwrap();
        warped(&source, &to_source, &mut rng).save(images.join(format!("turned_{at}.png"))).unwrap();
    }
    let found = centers(&images, &folder.path().join("out"));
    assert_eq!(found.len(), NUM_PHOTOGRAPHS + 3, "{:?}", found.keys());
    let size = extent(found.values().copied());
    for (name, center) in found.iter().filter(|(name, _)| name.starts_with("turned")) {
        let distance = (center - found["temple_004.jpg"]).norm() / size;
        assert!(distance < 0.01, "{name} is {distance} of the set's extent off");
    }
}

/// More features would show no other standpoint either, so no wider share of them is tried.
#[test]
fn pictures_from_one_spot_give_no_model_and_say_why() {
    let folder = tempfile::tempdir().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    std::fs::create_dir(&images).unwrap();
    let source = image::open(photographs().join("temple_004.jpg")).unwrap().to_rgb8();
    let (k, mut rng) = (calibration(FOCAL_PX), Rng::from_parts(&[3]));
    for at in 0..6 {
        let turn = Rotation3::from_euler_angles(0.02 * f64::from(at % 2), 0.04 * f64::from(at) - 0.1, 0.0);
        let to_source = k * turn.matrix() * k.try_inverse().unwrap();
        warped(&source, &to_source, &mut rng).save(images.join(format!("turned_{at}.png"))).unwrap();
    }
    let run = multistage(&["reconstruct", images.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert_eq!(run.status.code(), Some(3), "{}", String::from_utf8_lossy(&run.stderr));
    let report: serde_json::Value = serde_json::from_reader(File::open(out.join("report.json")).unwrap()).unwrap();
    let notes = report["notes"].to_string();
    assert!(notes.contains("as if the camera had only been turned") && notes.contains("masks/"), "{notes}");
    let matched = report["stages"].as_array().unwrap().iter().filter(|stage| stage["name"] == "coarse_match").count();
    assert_eq!(matched, 1, "a wider share was tried");
    for image in report["images"].as_array().unwrap() {
        assert_eq!(image["reason"], "no_initial_pair", "{image}");
    }
}

/// A picture hung on a wall and photographed from an arc, by pictures without EXIF.
#[test]
fn a_flat_scene_is_reconstructed() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let painting = image::open(photographs().join("temple_006.jpg")).unwrap().to_rgb8();
    let (width, height) = (f64::from(painting.width()), f64::from(painting.height()));
    // The painting is 2 wide, about the origin, in the plane z = 0; cameras look at its middle from in front (z < 0).
    let to_pixel = Matrix3::new(width / 2.0, 0.0, width / 2.0, 0.0, width / 2.0, height / 2.0, 0.0, 0.0, 1.0);
    let (k, mut rng) = (calibration(700.0), Rng::from_parts(&[2]));
    let mut truth = BTreeMap::new();
    for at in 0..9 {
        let angle = -0.7 + 1.4 * f64::from(at) / 8.0;
        let center = Vector3::new(2.2 * angle.sin(), 0.35 * (1.7 * f64::from(at)).sin(), -2.2 * angle.cos());
        let z = -center.normalize();
        let x = Vector3::y().cross(&z).normalize();
        let rotation = Matrix3::from_rows(&[x.transpose(), z.cross(&x).transpose(), z.transpose()]);
        let translation = -rotation * center;
        let to_view = k * Matrix3::from_columns(&[rotation.column(0).into(), rotation.column(1).into(), translation]);
        let name = format!("wall_{at}.png");
        warped(&painting, &(to_pixel * to_view.try_inverse().unwrap()), &mut rng).save(images.join(&name)).unwrap();
        truth.insert(name, center);
    }
    let found = centers(&images, &folder.path().join("out"));
    assert_eq!(found.len(), truth.len());
    let worst = worst_distance_error(&found, &truth);
    assert!(worst < 0.03, "a distance of cameras 2.2 from the wall is {worst} off");
}

/// The largest error of a distance between two cameras. Distances, up to one scale, do not ask for an alignment.
fn worst_distance_error(found: &BTreeMap<String, Vector3<f64>>, truth: &BTreeMap<String, Vector3<f64>>) -> f64 {
    let distances = |of: &BTreeMap<String, Vector3<f64>>| -> Vec<f64> {
        let all: Vec<Vector3<f64>> = of.values().copied().collect();
        all.iter().enumerate().flat_map(|(k, a)| all[..k].iter().map(move |b| (a - b).norm())).collect()
    };
    let (found, truth) = (distances(found), distances(truth));
    let scale = truth.iter().sum::<f64>() / found.iter().sum::<f64>();
    found.iter().zip(&truth).map(|(a, b)| (scale * a - b).abs()).fold(0.0, f64::max)
}

/// As on a turntable before a camera on a tripod: the middle of each picture shows the object from another side, and
/// the same room is around it in all, with more matches than the object has.
#[test]
fn a_background_that_stands_still_is_left_out() {
    let folder = tempfile::tempdir().unwrap();
    let images = folder.path().join("images");
    std::fs::create_dir(&images).unwrap();
    let room = image::imageops::rotate180(&image::open(photographs().join("temple_003.jpg")).unwrap().to_rgb8());
    let mut rng = Rng::from_parts(&[4]);
    for at in 0..NUM_TURNED {
        let object = image::open(photographs().join(format!("temple_{at:03}.jpg"))).unwrap().to_rgb8();
        let turned = RgbImage::from_fn(SIZE_PX[0], SIZE_PX[1], |x, y| {
            let [right, down] =
                [(x, SIZE_PX[0]), (y, SIZE_PX[1])].map(|(at, size)| f64::from(at) / f64::from(size) - 0.5);
            let Rgb(pixel) = *if right.hypot(down) < OBJECT_RADIUS { &object } else { &room }.get_pixel(x, y);
            let noise = rng.range(-2.0, 2.0);
            Rgb(pixel.map(|value| (f64::from(value) + noise).clamp(0.0, 255.0) as u8))
        });
        turned.save(images.join(format!("temple_{at:03}.png"))).unwrap();
    }
    let found = centers(&images, &folder.path().join("out"));
    assert_eq!(found.len(), NUM_TURNED, "{:?}", found.keys());
    let report: serde_json::Value =
        serde_json::from_reader(File::open(folder.path().join("out/report.json")).unwrap()).unwrap();
    let notes = report["notes"].to_string();
    assert!(notes.contains(&format!("In {NUM_TURNED} photographs something stands still")), "{notes}");
    let truth = centers(&photographs(), &folder.path().join("undisturbed"));
    let truth: BTreeMap<_, _> = truth
        .into_iter()
        .map(|(name, center)| (name.replace("jpg", "png"), center))
        .filter(|(name, _)| found.contains_key(name))
        .collect();
    let off = worst_distance_error(&found, &truth) / extent(truth.values().copied());
    assert!(off < 0.02, "a distance is {off} of the set's extent off");
}
