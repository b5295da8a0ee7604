//! Intake: which files are photographs, what their headers and EXIF say, and which share a camera.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};

use super::masks::{self, MaskFile};
use super::options::{IntakeOptions, KnownCamera};
use super::{Context, PipelineError, ready_features};
use crate::camera::{Camera, CameraModel, FocalSource, MAX_PARAMS};
use crate::formats::exif::Exif;
use crate::formats::photograph::{self, PhotographError};
use crate::scene::{CameraId, ImageId};

/// File name endings, in lower case, that mark a file as meant to be a photograph. What is in it is judged by content.
const PHOTOGRAPH_EXTENSIONS: [&str; 14] =
    ["jpg", "jpeg", "jpe", "jfif", "png", "tif", "tiff", "webp", "heic", "heif", "bmp", "gif", "avif", "jp2"];

/// A photograph that can be used, as far as its header tells.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Photograph {
    /// Its columns.
    pub width: u32,
    /// Its rows.
    pub height: u32,
    /// Its intrinsics.
    pub camera: CameraId,
    /// What its EXIF says.
    pub exif: Exif,
}

/// Why a file can't be used: a stable code and a sentence.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Refusal {
    /// Stable code: `unreadable`, `duplicate`, ...
    pub code: String,
    /// What is wrong and what to do about it.
    pub advice: String,
}

/// One input file.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct InputFile {
    /// Path relative to the input folder, with `/`.
    pub name: String,
    /// SHA-256 of its bytes in hexadecimal; none where it could not be read.
    pub sha256: Option<String>,
    /// Its size, where the header could be read.
    pub size: Option<(u32, u32)>,
    /// The photograph, or why there is none.
    pub photograph: Result<Photograph, Refusal>,
    /// Its mask, if there is one.
    pub mask: Option<MaskFile>,
}

/// Everything the later stages know of the input.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Intake {
    /// All input files in name order; an [`ImageId`] is a rank in it.
    pub files: Vec<InputFile>,
    /// Intrinsics to start from.
    pub cameras: BTreeMap<CameraId, Camera>,
}

impl Intake {
    /// The usable photographs.
    pub fn photographs(&self) -> impl Iterator<Item = (ImageId, &InputFile, &Photograph)> {
        (0u32..).map(ImageId).zip(&self.files).filter_map(|(id, file)| Some((id, file, file.photograph.as_ref().ok()?)))
    }

    /// The camera of every usable photograph.
    pub fn camera_of_image(&self) -> BTreeMap<ImageId, CameraId> {
        self.photographs().map(|(id, _, photograph)| (id, photograph.camera)).collect()
    }

    /// The name of an image.
    pub fn name(&self, id: ImageId) -> &str {
        &self.files[id.index()].name
    }
}

/// Reads every photograph's header under `folder`.
///
/// # Errors
/// When the folder can't be listed or holds no file that is meant to be a photograph.
pub fn run(folder: &Path, options: &IntakeOptions, context: &Context) -> Result<Intake, PipelineError> {
    if options.ready_features {
        return Ok(group_cameras(refuse_duplicates(ready_features::inspect(folder)?), options));
    }
    let unusable = |message: String| PipelineError::InvalidInput { path: folder.to_owned(), message };
    let mut names = Vec::new();
    list(folder, folder, &mut names).map_err(|error| unusable(error.to_string()))?;
    names.sort_unstable();
    if names.is_empty() {
        return Err(unusable("there is no photograph in it".to_owned()));
    }
    let inspected: Vec<Result<InputFile, PipelineError>> = names
        .par_iter()
        .map(|name| {
            context.check_cancelled()?;
            Ok(inspect(folder, name, options))
        })
        .collect();
    let mut inspected: Vec<InputFile> = inspected.into_iter().collect::<Result<_, _>>()?;
    masks::assign(&mut inspected);
    Ok(group_cameras(refuse_duplicates(inspected), options))
}

/// Lists the files under `folder` that are meant to be photographs, by their names relative to `root`.
fn list(root: &Path, folder: &Path, names: &mut Vec<String>) -> std::io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let path = entry?.path();
        let hidden = path.file_name().is_some_and(|name| name.to_string_lossy().starts_with('.'));
        if hidden {
            continue;
        }
        if path.is_dir() {
            list(root, &path, names)?;
            continue;
        }
        let extension = path.extension().map(|extension| extension.to_string_lossy().to_lowercase());
        if extension.is_some_and(|extension| PHOTOGRAPH_EXTENSIONS.contains(&extension.as_str()))
            && let Ok(relative) = path.strip_prefix(root)
        {
            let parts: Vec<String> =
                relative.components().map(|part| part.as_os_str().to_string_lossy().into_owned()).collect();
            names.push(parts.join("/"));
        }
    }
    Ok(())
}

/// Reads the header of one file; its camera is filled in later.
fn inspect(folder: &Path, name: &str, options: &IntakeOptions) -> InputFile {
    let refused = |sha256: Option<String>, size: Option<(u32, u32)>, code: &str, advice: String| {
        let photograph = Err(Refusal { code: code.to_owned(), advice });
        InputFile { name: name.to_owned(), sha256, size, photograph, mask: None }
    };
    let path: PathBuf = folder.join(name);
    let bytes = match std::fs::read(&path) {
        Ok(bytes) => bytes,
        Err(error) => return refused(None, None, "unreadable", format!("The file could not be read: {error}.")),
    };
    let sha256 = Some(hex(&Sha256::digest(&bytes)));
    match photograph::inspect(&bytes, &options.limits()) {
        Ok(info) => {
            let size = Some((info.width, info.height));
            let photograph =
                Ok(Photograph { width: info.width, height: info.height, camera: CameraId(0), exif: info.exif });
            InputFile { name: name.to_owned(), sha256, size, photograph, mask: None }
        }
        Err(error) => refused(sha256, stated_size(&error), error.code(), advice(&error)),
    }
}

/// The size the header states, where that is what is wrong.
fn stated_size(error: &PhotographError) -> Option<(u32, u32)> {
    match *error {
        PhotographError::TooSmall { width, height, .. } | PhotographError::TooLarge { width, height, .. } => {
            Some((width, height))
        }
        _ => None,
    }
}

/// What to do about a file that is no usable photograph.
pub fn advice(error: &PhotographError) -> String {
    let cure = match error {
        PhotographError::Unreadable(_) => "Copy it again from the camera, or leave it out.",
        PhotographError::Truncated(_) => "It was probably not copied to its end: copy it again from the camera.",
        PhotographError::TooSmall { .. } => "Use the original instead of a preview.",
        PhotographError::TooLarge { .. } => "Shrink it, or raise intake.max_megapixels.",
        PhotographError::UnsupportedFormat(_) => "Save it as JPEG, PNG, TIFF or WebP.",
    };
    let what = error.to_string();
    format!("{}{}. {cure}", what[..1].to_uppercase(), &what[1..])
}

/// Bytes in hexadecimal.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

/// Keeps the first of several files with the same bytes.
fn refuse_duplicates(inspected: Vec<InputFile>) -> Vec<InputFile> {
    let mut first: BTreeMap<String, String> = BTreeMap::new();
    let mut kept = Vec::with_capacity(inspected.len());
    for mut file in inspected {
        if let (Ok(_), Some(sha256)) = (&file.photograph, &file.sha256) {
            if let Some(original) = first.get(sha256) {
                file.photograph = Err(Refusal {
                    code: "duplicate".to_owned(),
                    advice: format!("The same picture as {original}, byte for byte; that one was used."),
                });
            } else {
                first.insert(sha256.clone(), file.name.clone());
            }
        }
        kept.push(file);
    }
    kept
}

/// What photographs of one physical camera at one zoom agree in.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
enum CameraKey {
    Known(String),
    Exif { make: String, model: String, lens: String, focal_um: u64, size: (u32, u32) },
    SizeOnly((u32, u32)),
}

fn camera_key(file: &InputFile, photograph: &Photograph, options: &IntakeOptions) -> CameraKey {
    let size = (photograph.width, photograph.height);
    if options.cameras.contains_key(&file.name) {
        return CameraKey::Known(file.name.clone());
    }
    if options.camera.is_some() {
        return CameraKey::SizeOnly(size);
    }
    let exif = &photograph.exif;
    match exif.focal_px(size.0, size.1) {
        Some(_) => CameraKey::Exif {
            make: exif.make.clone().unwrap_or_default(),
            model: exif.model.clone().unwrap_or_default(),
            lens: exif.lens.clone().unwrap_or_default(),
            focal_um: (exif.focal_mm.or(exif.focal_35mm).unwrap_or(0.0) * 1000.0).round() as u64,
            size,
        },
        None => CameraKey::SizeOnly(size),
    }
}

/// Gives every photograph its camera: one for all that agree in make, model, lens, focal length and size, or, without EXIF,
/// in size (estimates that disagree split such a group later).
fn group_cameras(inspected: Vec<InputFile>, options: &IntakeOptions) -> Intake {
    let mut ids: BTreeMap<CameraKey, CameraId> = BTreeMap::new();
    let mut cameras = BTreeMap::new();
    let mut files = Vec::with_capacity(inspected.len());
    for mut file in inspected {
        if let Ok(photograph) = &file.photograph {
            let key = camera_key(&file, photograph, options);
            let next = CameraId(ids.len() as u32);
            let id = *ids.entry(key).or_insert(next);
            cameras.entry(id).or_insert_with(|| starting_camera(&file.name, photograph, options));
            if let Ok(photograph) = &mut file.photograph {
                photograph.camera = id;
            }
        }
        files.push(file);
    }
    Intake { files, cameras }
}

fn starting_camera(name: &str, photograph: &Photograph, options: &IntakeOptions) -> Camera {
    let (width, height) = (photograph.width, photograph.height);
    if let Some(known) = options.cameras.get(name).or(options.camera.as_ref()) {
        return known_camera(known, width, height);
    }
    let (focal_px, source) = match photograph.exif.focal_px(width, height) {
        Some(focal_px) => (focal_px, FocalSource::Exif),
        None => (options.default_focal * f64::from(width.max(height)), FocalSource::Guess),
    };
    Camera::centered(CameraModel::SimpleRadial, width, height, focal_px, source)
}

fn known_camera(known: &KnownCamera, width: u32, height: u32) -> Camera {
    let mut params = [0.0; MAX_PARAMS];
    params[..known.params.len()].copy_from_slice(&known.params);
    Camera { model: known.model, width, height, params, focal_source: FocalSource::Known }
}
