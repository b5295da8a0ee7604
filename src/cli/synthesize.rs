//! `multistage synthesize SPEC --out DIR`: photographs or features of a scene whose truth is known.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::Deserialize;

use super::Failure;
use crate::camera::Camera;
use crate::formats::exif::{self, Exif};
use crate::formats::features::{FEATURE_SET_INDEX, FeatureSet, FeatureSetImage};
use crate::formats::{colmap, features, photograph};
use crate::scene::{CameraId, ImageId, Reconstruction};
use crate::synthetic::{Photographer, Picture, SceneOptions, Temple, TempleOptions};

/// Arguments of `synthesize`.
#[derive(Debug, clap::Args)]
#[command(after_help = "SPEC is `temple` (photographs of a stone temple), `features` (features without pictures, for \
`reconstruct DIR/features --set intake.ready_features=true`), or a JSON file \
{\"scene\": \"temple\" or \"features\", ...options}. DIR/gt gets the truth: a COLMAP model as text, and poses.txt.")]
pub(super) struct Args {
    /// What to make: temple, features or a JSON file.
    spec: String,
    /// Folder for the result; made if it does not exist.
    #[arg(long, value_name = "DIR")]
    out: PathBuf,
}

/// What a specification asks for.
#[derive(Debug, Deserialize)]
#[serde(tag = "scene", rename_all = "lowercase")]
enum Spec {
    Temple(TempleOptions),
    Features(SceneOptions),
}

/// Quality of the photographs' JPEG.
const JPEG_QUALITY: u8 = 92;
/// Diagonal of 35 mm film.
const FILM_DIAGONAL_MM: f64 = 43.266_615;

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let outside = |error: io::Error| Failure::Outside(format!("{}: {error}", args.out.display()));
    match read_spec(&args.spec)? {
        Spec::Temple(options) => {
            let mut errors = Vec::new();
            options.validate(&mut errors);
            if !errors.is_empty() {
                return Err(Failure::Input(errors.join("; ")));
            }
            let written = write_temple(&options, &args.out, |done| {
                eprint!("\r{done} of {} photographs", options.num_images);
            });
            eprintln!();
            written.map_err(outside)?;
        }
        Spec::Features(options) => write_features(&options, &args.out).map_err(outside)?,
    }
    println!("{}", args.out.display());
    Ok(())
}

fn read_spec(spec: &str) -> Result<Spec, Failure> {
    match spec {
        "temple" => Ok(Spec::Temple(TempleOptions::default())),
        "features" => Ok(Spec::Features(SceneOptions::default())),
        path => {
            let text = fs::read_to_string(path).map_err(|error| Failure::Input(format!("{path}: {error}")))?;
            serde_json::from_str(&text).map_err(|error| Failure::Input(format!("{path}: {error}")))
        }
    }
}

/// The file name of a photograph of the temple.
fn temple_name(index: usize) -> String {
    format!("temple_{index:03}.jpg")
}

/// Photographs the temple into `out/images`, with the truth in `out/gt`; tells `progress` after each photograph how many
/// there are. Returns the paths of the photographs.
pub(super) fn write_temple(
    options: &TempleOptions,
    out: &Path,
    mut progress: impl FnMut(usize),
) -> io::Result<Vec<PathBuf>> {
    let images = out.join("images");
    fs::create_dir_all(&images)?;
    let temple = Temple::new(options);
    let cameras = [0, 1].map(|index| temple.camera(index));
    let exif = options.exif_focal_factor.map(|factor| {
        let mut stated = cameras[0].clone();
        stated.set_focal(factor * stated.focal().0, factor * stated.focal().1);
        invented_exif("Ray caster", &stated)
    });
    let num_cameras = if cameras[0] == cameras[1] { 1 } else { 2 };
    let mut truth = Reconstruction::new((0u32..).map(CameraId).zip(cameras).take(num_cameras).collect());
    let mut names = Vec::new();
    let mut paths = Vec::new();
    for index in 0..options.num_images {
        let jpeg = photograph::encode_jpeg(&temple.photograph(index), JPEG_QUALITY).map_err(io::Error::other)?;
        let file = match &exif {
            Some(exif) => {
                let mut file = Vec::with_capacity(jpeg.len());
                exif::write_app1(&jpeg, exif, &mut file)?;
                file
            }
            None => jpeg,
        };
        let name = temple_name(index);
        let path = images.join(&name);
        fs::write(&path, file)?;
        let camera = CameraId((index % num_cameras) as u32);
        truth.register(ImageId(index as u32), camera, temple.cam_from_world(index), [].into());
        names.push(name);
        paths.push(path);
        progress(index + 1);
    }
    write_truth(&truth, &names, &out.join("gt"))?;
    Ok(paths)
}

/// Writes the features of every image as a set that `reconstruct --set intake.ready_features=true` takes, and the truth.
/// Images are made in parallel and written at once, so memory holds only the truth.
fn write_features(options: &SceneOptions, out: &Path) -> io::Result<()> {
    let folder = out.join("features");
    fs::create_dir_all(&folder)?;
    let photographer = Photographer::new(options);
    let written: Vec<(Picture, FeatureSetImage)> = (0..options.num_images)
        .into_par_iter()
        .map(|index| {
            let (picture, found) = photographer.photograph(index);
            let name = format!("image_{index:04}.jpg");
            let file = format!("image_{index:04}.msfeat");
            fs::write(folder.join(&file), features::to_bytes(&found))?;
            let exif = invented_exif("Scene", &photographer.cameras()[&picture.camera]);
            Ok((picture, FeatureSetImage { name, file, width: options.width, height: options.height, exif }))
        })
        .collect::<io::Result<_>>()?;
    let (pictures, images): (Vec<Picture>, Vec<FeatureSetImage>) = written.into_iter().unzip();
    let names: Vec<String> = images.iter().map(|image| image.name.clone()).collect();
    fs::write(folder.join(FEATURE_SET_INDEX), serde_json::to_vec_pretty(&FeatureSet { images })?)?;
    write_truth(&photographer.truth(pictures), &names, &out.join("gt"))
}

/// What a camera of this program would write into its photographs.
fn invented_exif(model: &str, camera: &Camera) -> Exif {
    let diagonal_px = f64::from(camera.width).hypot(f64::from(camera.height));
    Exif {
        make: Some("Multistage".to_owned()),
        model: Some(model.to_owned()),
        focal_35mm: Some((camera.mean_focal_px() * FILM_DIAGONAL_MM / diagonal_px).round()),
        orientation: Some(1),
        ..Exif::default()
    }
}

/// Writes a model as COLMAP text and as a list of poses; image ids count `names`.
fn write_truth(truth: &Reconstruction, names: &[String], folder: &Path) -> io::Result<()> {
    fs::create_dir_all(folder)?;
    let written = |name: &str, write: &dyn Fn(&mut Vec<u8>) -> io::Result<()>| {
        let mut bytes = Vec::new();
        write(&mut bytes)?;
        fs::write(folder.join(name), bytes)
    };
    written("cameras.txt", &|out| colmap::write_cameras_txt(truth, out))?;
    written("images.txt", &|out| colmap::write_images_txt(truth, |id| &names[id.0 as usize], out))?;
    written("points3D.txt", &|out| colmap::write_points3d_txt(truth, out))?;
    written("poses.txt", &|out| {
        writeln!(out, "# image qw qx qy qz cx cy cz: rotation from world to camera, centre of the camera")?;
        for (id, image) in truth.images() {
            let (q, c) = (image.cam_from_world.rotation, image.center_in_world());
            let name = &names[id.0 as usize];
            writeln!(out, "{name} {} {} {} {} {} {} {}", q.w, q.i, q.j, q.k, c.x, c.y, c.z)?;
        }
        Ok(())
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn specifications_name_a_scene_and_its_options() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let path = folder.path().join("spec.json");
        fs::write(&path, r#"{"scene": "temple", "num_images": 3}"#).expect("writable");
        let Spec::Temple(options) = read_spec(path.to_str().expect("UTF-8")).expect("valid") else {
            panic!("it asks for the temple");
        };
        assert_eq!(options, TempleOptions { num_images: 3, ..TempleOptions::default() });
        fs::write(&path, r#"{"scene": "temple", "images": 3}"#).expect("writable");
        assert!(read_spec(path.to_str().expect("UTF-8")).is_err());
    }

    #[test]
    fn the_temple_comes_with_its_truth() {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let options = TempleOptions { num_images: 2, width: 64, height: 48, ..TempleOptions::default() };
        let paths = write_temple(&options, folder.path(), |_| {}).expect("writable");
        let exif = Exif::read(&fs::read(&paths[0]).expect("written"));
        let focal_px = exif.focal_px(64, 48).expect("the focal length is stated");
        assert!((focal_px / (0.86 * 64.0) - 1.0).abs() < 0.03, "{focal_px}");
        let poses = super::super::model_poses::read(&folder.path().join("gt")).expect("a COLMAP model");
        assert_eq!(poses.len(), 2);
        let listed = super::super::model_poses::read(&folder.path().join("gt/poses.txt")).expect("a list of poses");
        let pose = &listed["temple_001.jpg"];
        let off = pose.target_origin_in_source() - Temple::new(&options).cam_from_world(1).target_origin_in_source();
        assert!(off.norm() < 1e-9, "{off}");
    }
}
