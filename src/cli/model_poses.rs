//! Finds the camera poses in a file or folder of any kind that is known.

use std::collections::BTreeMap;
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

use crate::formats::{FormatError, bundler, colmap, poses};
use crate::geometry::Rigid3;

/// Poses `cam_from_world` by image name.
pub type NamedPoses = BTreeMap<String, Rigid3>;

/// Why there are none.
#[derive(Debug, thiserror::Error)]
pub enum PosesError {
    /// A file can't be read.
    #[error("{path}: {source}", path = .path.display())]
    File {
        /// Which.
        path: PathBuf,
        /// Why.
        source: FormatError,
    },
    /// The path is of no kind that is known.
    #[error(
        "{path}: neither a COLMAP model, a bundle.out with list.txt, an NVM file, a poses.txt nor a folder of *.camera files",
        path = .0.display()
    )]
    Unknown(PathBuf),
}

/// Reads the poses of a model: a COLMAP folder (binary or text), an output folder of `reconstruct` (its largest model), a
/// folder of `*.camera` files or with a `poses.txt` or `bundle.out`, or one of these files, or an NVM file.
pub fn read(path: &Path) -> Result<NamedPoses, PosesError> {
    if path.is_dir() {
        return read_folder(path);
    }
    let name = path.file_name().map(|name| name.to_string_lossy().to_lowercase()).unwrap_or_default();
    if name.ends_with(".nvm") {
        read_file(path, poses::read_nvm_poses)
    } else if name.ends_with("poses.txt") {
        read_file(path, poses::read_pose_list)
    } else if name.ends_with(".out") {
        read_bundle(path)
    } else if path.exists() {
        Err(PosesError::Unknown(path.to_owned()))
    } else {
        let missing = std::io::Error::new(std::io::ErrorKind::NotFound, "there is no such file or folder");
        Err(PosesError::File { path: path.to_owned(), source: missing.into() })
    }
}

fn read_folder(folder: &Path) -> Result<NamedPoses, PosesError> {
    let cameras = camera_files(folder)?;
    if !cameras.is_empty() {
        let mut found = NamedPoses::new();
        for path in cameras {
            let pose = read_file(&path, poses::read_strecha_camera)?;
            let name = path.file_stem().map(|stem| stem.to_string_lossy().into_owned()).unwrap_or_default();
            found.insert(name, pose);
        }
        return Ok(found);
    }
    let names_and_poses = |images: BTreeMap<u32, colmap::ColmapImage>| {
        images.into_values().map(|image| (image.name, image.cam_from_world)).collect()
    };
    for model in [folder.to_owned(), folder.join("sparse/0"), folder.join("0")] {
        let (binary, text) = (model.join("images.bin"), model.join("images.txt"));
        if binary.is_file() {
            return read_file(&binary, |input| colmap::read_images_bin(input).map(names_and_poses));
        }
        if text.is_file() {
            return read_file(&text, |input| colmap::read_images_txt(input).map(names_and_poses));
        }
    }
    if folder.join("poses.txt").is_file() {
        return read(&folder.join("poses.txt"));
    }
    if folder.join("bundle.out").is_file() {
        return read_bundle(&folder.join("bundle.out"));
    }
    Err(PosesError::Unknown(folder.to_owned()))
}

fn camera_files(folder: &Path) -> Result<Vec<PathBuf>, PosesError> {
    let list = || -> std::io::Result<Vec<PathBuf>> {
        let mut files = Vec::new();
        for entry in std::fs::read_dir(folder)? {
            let path = entry?.path();
            if path.extension().is_some_and(|extension| extension == "camera") {
                files.push(path);
            }
        }
        files.sort();
        Ok(files)
    };
    list().map_err(|error| PosesError::File { path: folder.to_owned(), source: error.into() })
}

fn read_bundle(path: &Path) -> Result<NamedPoses, PosesError> {
    let found = read_file(path, bundler::read_bundle_poses)?;
    let names = read_file(&path.with_file_name("list.txt"), bundler::read_list)?;
    Ok(names.into_iter().zip(found).filter_map(|(name, pose)| Some((name, pose?))).collect())
}

fn read_file<T>(
    path: &Path,
    read: impl FnOnce(&mut BufReader<File>) -> Result<T, FormatError>,
) -> Result<T, PosesError> {
    File::open(path)
        .map_err(FormatError::from)
        .and_then(|file| read(&mut BufReader::new(file)))
        .map_err(|source| PosesError::File { path: path.to_owned(), source })
}
