//! The features stage: decode, shrink, SIFT, one stored file an image. Memory holds only what the worker threads work on.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex, PoisonError};

use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::colors::{COLOR_LONG_SIDE_PX, Look};
use super::intake::{InputFile, Intake, Refusal, advice};
use super::masks::Mask;
use super::options::ReconstructionOptions;
use super::runner::erased::Part;
use super::runner::{ArtifactKey, Counts, StageProgress, counts, io_error};
use super::{Context, PipelineError, Stage, ready_features};
use crate::features::extract_where;
use crate::formats::features as feature_file;
use crate::formats::photograph::Photograph;
use crate::scene::{Features, ImageId};
use crate::store::ArtifactStore;

/// The features of one image: where they are kept and how many there are, or why there are none.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ImageFeatures {
    /// Key of the feature file.
    pub key: String,
    /// Key of the picture's [`Look`]; none when no picture was decoded.
    pub look_key: Option<String>,
    /// Number of features, or why the picture can't be used after all.
    pub count: Result<usize, Refusal>,
}

/// Extracts the features of every photograph that has none stored yet.
///
/// # Errors
/// Cancellation, or a feature file that can't be stored.
pub fn run(
    folder: &Path,
    intake: &Intake,
    options: &ReconstructionOptions,
    context: &Context,
    store: &ArtifactStore,
    progress: &StageProgress<'_>,
) -> Result<(BTreeMap<ImageId, ImageFeatures>, Counts), PipelineError> {
    let photographs: Vec<_> = intake.photographs().collect();
    let ready: BTreeMap<String, PathBuf> = if options.intake.ready_features {
        let images = ready_features::index(folder)?;
        images.into_iter().map(|image| (image.name, folder.join(image.file))).collect()
    } else {
        BTreeMap::new()
    };
    let extracted: Vec<Result<(ImageId, ImageFeatures, bool), PipelineError>> = photographs
        .par_iter()
        .map(|(id, file, _)| {
            context.check_cancelled()?;
            let mask = file.mask.as_ref();
            let mask_sha256 = mask.map(|mask| &mask.sha256);
            let parts: [&dyn Part; 4] =
                [&file.sha256, &mask_sha256, &options.features, &options.intake.max_long_side_px];
            let key = ArtifactKey::of("features", &parts).0;
            let look_key = ArtifactKey::of("look", &parts).0;
            let failed = |source| io_error(Stage::Features, Path::new(&key), source);
            let ready = ready.get(&file.name);
            let stored = store.get(&key).map_err(failed)?.and_then(|bytes| feature_file::from_bytes(&bytes, None).ok());
            // Features without their look would make points without colours.
            let is_whole = ready.is_some() || store.get(&look_key).map_err(failed)?.is_some();
            let stored = stored.filter(|_| is_whole);
            let reused = stored.is_some();
            let count = match (stored, ready) {
                (Some(features), _) => Ok(features.len()),
                (None, Some(path)) => match ready_features::read(path)? {
                    Ok(features) => {
                        store.put(&key, &feature_file::to_bytes(&features)).map_err(failed)?;
                        Ok(features.len())
                    }
                    Err(refusal) => Err(refusal),
                },
                (None, None) => match extract_one(folder, file, options)? {
                    Ok((features, look)) => {
                        store.put(&look_key, &look.to_bytes()).map_err(failed)?;
                        store.put(&key, &feature_file::to_bytes(&features)).map_err(failed)?;
                        Ok(features.len())
                    }
                    Err(refusal) => Err(refusal),
                },
            };
            let look_key = ready.is_none().then_some(look_key);
            progress.tick();
            Ok((*id, ImageFeatures { key, look_key, count }, reused))
        })
        .collect();
    let extracted: Vec<(ImageId, ImageFeatures, bool)> = extracted.into_iter().collect::<Result<_, _>>()?;
    let features = extracted.iter().filter_map(|(_, image, _)| image.count.as_ref().ok()).sum();
    let reused = extracted.iter().filter(|(_, _, reused)| *reused).count();
    let totals = counts([("images", extracted.len()), ("features", features), ("images_reused", reused)]);
    Ok((extracted.into_iter().map(|(id, image, _)| (id, image)).collect(), totals))
}

/// SIFT of one file where its mask keeps it, in pixels of the original picture, and what its colours are.
fn extract_one(
    folder: &Path,
    file: &InputFile,
    options: &ReconstructionOptions,
) -> Result<Result<(Features, Look), Refusal>, PipelineError> {
    let path = folder.join(&file.name);
    let bytes = std::fs::read(&path).map_err(|source| io_error(Stage::Features, &path, source))?;
    let decoded = Photograph::open(&bytes, &options.intake.limits()).and_then(|photograph| {
        photograph.decode_gray_and_colors(Some(options.intake.max_long_side_px), Some(COLOR_LONG_SIDE_PX))
    });
    let (decoded, picture) = match decoded {
        Ok(decoded) => decoded,
        Err(error) => return Ok(Err(Refusal { code: error.code().to_owned(), advice: advice(&error) })),
    };
    drop(bytes);
    let mask = file.mask.as_ref().map(|mask| Mask::read(&folder.join(&mask.name), &options.intake.limits()));
    let mask = match mask.transpose()?.transpose() {
        Ok(mask) => mask,
        Err(refusal) => return Ok(Err(refusal)),
    };
    let (width, height) = (decoded.image.width as f64, decoded.image.height as f64);
    let kept = |x: f32, y: f32| mask.as_ref().is_none_or(|m| m.keeps(f64::from(x) / width, f64::from(y) / height));
    let mut features = extract_where(&decoded.image, &options.features, &kept);
    let [scale_x, scale_y] = decoded.to_original;
    for keypoint in &mut features.keypoints {
        keypoint.x = (f64::from(keypoint.x) * scale_x) as f32;
        keypoint.y = (f64::from(keypoint.y) * scale_y) as f32;
        keypoint.scale = (f64::from(keypoint.scale) * (scale_x * scale_y).sqrt()) as f32;
    }
    let look = Look::of(picture, &features);
    Ok(Ok((features, look)))
}

/// Features of a run, read back from where they are stored.
pub struct StoredFeatures<'a> {
    store: &'a ArtifactStore,
    keys: BTreeMap<ImageId, String>,
    lost: Mutex<Vec<String>>,
}

impl<'a> StoredFeatures<'a> {
    /// Of every image that has some.
    pub fn new(store: &'a ArtifactStore, features: &BTreeMap<ImageId, ImageFeatures>) -> Self {
        let usable = features.iter().filter(|(_, image)| image.count.is_ok());
        Self { store, keys: usable.map(|(&id, image)| (id, image.key.clone())).collect(), lost: Mutex::default() }
    }

    /// The `limit` features of largest scale, or all; empty when they can't be read back ([`StoredFeatures::check`]
    /// then tells).
    pub fn read(&self, id: ImageId, limit: Option<usize>) -> Features {
        let Some(key) = self.keys.get(&id) else { return Features::default() };
        let features =
            self.store.get(key).ok().flatten().and_then(|bytes| feature_file::from_bytes(&bytes, limit).ok());
        features.unwrap_or_else(|| {
            self.lost.lock().unwrap_or_else(PoisonError::into_inner).push(key.clone());
            Features::default()
        })
    }

    /// Fails when features were lost since they were stored.
    ///
    /// # Errors
    /// Names the first lost file.
    pub fn check(&self, stage: Stage) -> Result<(), PipelineError> {
        match self.lost.lock().unwrap_or_else(PoisonError::into_inner).first() {
            None => Ok(()),
            Some(key) => {
                let gone = std::io::Error::new(std::io::ErrorKind::NotFound, "stored features are damaged or gone");
                Err(io_error(stage, Path::new(key), gone))
            }
        }
    }
}

/// Stored features, the most recently used kept in memory up to a budget of bytes.
pub struct FeatureCache<'a> {
    stored: StoredFeatures<'a>,
    budget_bytes: usize,
    state: Mutex<CacheState>,
}

#[derive(Default)]
struct CacheState {
    clock: u64,
    bytes: usize,
    entries: BTreeMap<ImageId, (u64, Arc<Features>)>,
}

/// Bytes one feature takes in memory.
const FEATURE_BYTES: usize = 144;

impl<'a> FeatureCache<'a> {
    /// With nothing in memory yet.
    pub fn new(stored: StoredFeatures<'a>, budget_bytes: usize) -> Self {
        Self { stored, budget_bytes, state: Mutex::default() }
    }

    /// The features of an image, empty when they can't be read back ([`FeatureCache::check`] then tells).
    pub fn get(&self, id: ImageId) -> Arc<Features> {
        if let Some(features) = self.recall(id) {
            return features;
        }
        let features = Arc::new(self.stored.read(id, None));
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.clock += 1;
        let now = state.clock;
        if state.entries.insert(id, (now, features.clone())).is_none() {
            state.bytes += features.len() * FEATURE_BYTES;
        }
        while state.bytes > self.budget_bytes && state.entries.len() > 1 {
            let Some(oldest) = state.entries.iter().min_by_key(|(_, (used, _))| *used).map(|(&id, _)| id) else {
                break;
            };
            if let Some((_, dropped)) = state.entries.remove(&oldest) {
                state.bytes -= dropped.len() * FEATURE_BYTES;
            }
        }
        features
    }

    fn recall(&self, id: ImageId) -> Option<Arc<Features>> {
        let mut state = self.state.lock().unwrap_or_else(PoisonError::into_inner);
        state.clock += 1;
        let now = state.clock;
        let entry = state.entries.get_mut(&id)?;
        entry.0 = now;
        Some(entry.1.clone())
    }

    /// [`StoredFeatures::check`].
    ///
    /// # Errors
    /// Names the first lost file.
    pub fn check(&self, stage: Stage) -> Result<(), PipelineError> {
        self.stored.check(stage)
    }
}
