//! Speed of bundle adjustment: `cargo bench --bench bundle -- [--threads N] [--write DIR] [MODEL_DIR ...]`.
//!
//! Adjusts synthetic scenes, or COLMAP models (binary) whose poses, points and focal lengths are moved away first. With
//! `--write`, the starts are written too, as `DIR/<k>`, so that `benches/compare/bundle_ceres.py` can adjust the same ones.

use std::fs::{self, File};
use std::io::{BufReader, BufWriter};
use std::path::{Path, PathBuf};

use multistage::bundle::{BundleConfig, BundleOptions, FreeIntrinsics, adjust};
use multistage::formats::colmap::{
    ColmapModel, read_cameras_bin, read_images_bin, read_points3d_bin, write_cameras_bin, write_images_bin,
    write_points3d_bin,
};
use multistage::scene::Reconstruction;
use multistage::synthetic::{Layout, SceneOptions, generate, perturbed};

type Failure = Box<dyn std::error::Error>;

/// Offset of centres and points as a share of the scene's size.
const SHARE: f64 = 0.003;

fn read(folder: &Path) -> Result<Reconstruction, Failure> {
    let open = |name: &str| File::open(folder.join(name)).map(BufReader::new);
    let model = ColmapModel {
        cameras: read_cameras_bin(&mut open("cameras.bin")?)?,
        images: read_images_bin(&mut open("images.bin")?)?,
        points: read_points3d_bin(&mut open("points3D.bin")?)?,
    };
    Ok(model.into_reconstruction()?.0)
}

fn write(model: &Reconstruction, folder: &Path) -> Result<(), Failure> {
    fs::create_dir_all(folder)?;
    let create = |name: &str| File::create(folder.join(name)).map(BufWriter::new);
    let names: Vec<String> = model.images().keys().map(|id| format!("{}.jpg", id.0)).collect();
    let ranks: Vec<_> = model.images().keys().copied().collect();
    write_cameras_bin(model, &mut create("cameras.bin")?)?;
    write_images_bin(model, |id| &names[ranks.partition_point(|&other| other < id)], &mut create("images.bin")?)?;
    write_points3d_bin(model, &mut create("points3D.bin")?)?;
    Ok(())
}

/// Synthetic scenes, and how far centres and points are moved away as a share of the scene's size.
fn scenes() -> Vec<(String, Reconstruction, f64)> {
    let scene = |layout, num_images, num_points, shared_camera| {
        let options = SceneOptions {
            layout,
            num_images,
            num_points,
            shared_camera,
            pixel_noise_px: 0.5,
            detection_ratio: 0.5,
            distractor_ratio: 0.0,
            ..SceneOptions::default()
        };
        let cameras = if shared_camera { "one camera" } else { "a camera each" };
        let share = if layout == Layout::Street { 1e-4 } else { SHARE };
        (format!("{layout:?}, {num_images} images, {cameras}"), generate(&options).truth, share)
    };
    vec![
        scene(Layout::Facade, 10, 2_000, true),
        scene(Layout::Orbit, 25, 20_000, true),
        scene(Layout::Orbit, 128, 30_000, true),
        scene(Layout::Orbit, 128, 30_000, false),
        scene(Layout::Street, 1_000, 100_000, true),
    ]
}

fn cpu_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ProcessCPUTime);
    time.tv_sec as f64 + 1e-9 * time.tv_nsec as f64
}

fn main() -> Result<(), Failure> {
    let mut arguments = std::env::args().skip(1).filter(|argument| argument != "--bench");
    let (mut out, mut models, mut threads) = (None, Vec::new(), 1);
    while let Some(argument) = arguments.next() {
        match argument.as_str() {
            "--write" => out = arguments.next().map(PathBuf::from),
            "--threads" => threads = arguments.next().ok_or("--threads needs a number")?.parse()?,
            folder => models.push((folder.to_owned(), read(Path::new(folder))?, SHARE)),
        }
    }
    if models.is_empty() {
        models = scenes();
    }
    let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build()?;
    println!(
        "{:>9} {:>9} {:>11} {:>6} {:>6} {:>9} {:>11}",
        "points", "sightings", "cost", "steps", "taken", "CPU s", "ms a step"
    );
    for (rank, (name, truth, share)) in models.into_iter().enumerate() {
        let mut model = perturbed(&truth, 0.1, share, 0.01, false, 1);
        if let Some(out) = &out {
            write(&model, &out.join(rank.to_string()))?;
        }
        let free = model.cameras.keys().map(|&id| (id, FreeIntrinsics::FOCAL_AND_DISTORTION)).collect();
        let config = BundleConfig { intrinsics: free, ..BundleConfig::global(&model, FreeIntrinsics::default()) };
        let before = cpu_s();
        let report = pool.install(|| adjust(&mut model, &config, &BundleOptions::default()));
        let spent_s = cpu_s() - before;
        println!(
            "{:>9} {:>9} {:>11.1} {:>6} {:>6} {:>9.3} {:>11.2}  {:?}  {name}",
            report.num_variable_points,
            report.num_observations,
            report.final_cost,
            report.iterations,
            report.accepted,
            spent_s,
            1e3 * spent_s / report.iterations as f64,
            report.stop,
        );
    }
    Ok(())
}
