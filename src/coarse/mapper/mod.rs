//! Incremental structure from motion on the match graph: initial pair, next-best image, pose, triangulation, local and global
//! bundle adjustment, filtering. One model per connected component, and further models from the images the first left over.
//!
//! Snavely, Seitz, Szeliski, "Photo Tourism", 2006; Schönberger, Frahm, "Structure-from-Motion Revisited", CVPR 2016 (the
//! pyramid score of the next image, retriangulation, iterated adjustment and filtering).

mod adjust;
mod cameras;
mod checkpoint;
mod extend;
mod initial;
mod options;
mod register;
#[cfg(test)]
mod tests;
mod triangulate;

pub use checkpoint::{Checkpoint, Checkpoints, MapperRun};
pub use extend::extend;
pub use options::MapperOptions;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::rotation_cycles::RotationForest;
use super::{MatchGraph, Tracks};
use crate::camera::{Camera, Pixel};
use crate::scene::{ApartImages, CameraId, ImageId, Point3dId, Reconstruction};
use checkpoint::Growth;

/// What the mapper is told of an image.
#[derive(Clone, Debug)]
pub struct MapperImage {
    /// Its intrinsics.
    pub camera: CameraId,
    /// The position of every keypoint.
    pub keypoints: Arc<[Pixel]>,
}

/// The input of the mapper.
#[derive(Clone, Debug)]
pub struct MapperInput {
    /// Every image that may be registered.
    pub images: BTreeMap<ImageId, MapperImage>,
    /// Intrinsics to start from.
    pub cameras: BTreeMap<CameraId, Camera>,
    /// Verified pairs.
    pub graph: MatchGraph,
    /// Images that show different places: no track joins them.
    pub apart: ApartImages,
}

impl MapperInput {
    /// The intrinsics an image starts from.
    pub(super) fn camera_of(&self, id: ImageId) -> &Camera {
        &self.cameras[&self.images[&id].camera]
    }
}

/// Why the mapper left an image out.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Unregistered {
    /// No pair with it was verified.
    NoPairs,
    /// Its component is too small for a model.
    TooFewTogether {
        /// Images of it.
        images: usize,
    },
    /// Its component gave no model: no pair of it could start one.
    NoInitialPair,
    /// It sees too few points of the model.
    TooFewPoints {
        /// Points it sees.
        visible: usize,
    },
    /// No pose agreed with enough of the points it sees.
    PoseFailed {
        /// Points it sees.
        visible: usize,
        /// Those the best pose agreed with.
        inliers: usize,
    },
    /// The pose that some of the points it sees agree with is turned another way than the pairs with it say.
    TurnedOtherwise {
        /// Points it sees.
        visible: usize,
        /// Those that agree with the pose.
        inliers: usize,
    },
}

/// The models of all components.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct CoarseModels {
    /// Largest first.
    pub models: Vec<Reconstruction>,
    /// Why each other image is in none.
    pub unregistered: BTreeMap<ImageId, Unregistered>,
}

/// Reconstructs every component of the graph.
pub fn reconstruct(input: &MapperInput, options: &MapperOptions, run: &MapperRun<'_>) -> CoarseModels {
    let mut result = CoarseModels::default();
    for &image in input.images.keys() {
        result.unregistered.insert(image, Unregistered::NoPairs);
    }
    for component in input.graph.components() {
        if component.len() < options.min_model_images {
            let why = Unregistered::TooFewTogether { images: component.len() };
            result.unregistered.extend(component.iter().map(|&image| (image, why.clone())));
        }
        let mut remaining = component;
        while remaining.len() >= options.min_model_images && (run.keep_going)() {
            for &image in &remaining {
                result.unregistered.entry(image).and_modify(|why| {
                    if *why == Unregistered::NoPairs {
                        *why = Unregistered::NoInitialPair;
                    }
                });
            }
            let done: usize = result.models.iter().map(|model| model.images().len()).sum();
            let told = |registered: usize| (run.progress)(done + registered);
            let run = MapperRun { progress: &told, ..*run };
            let Some((model, reasons)) = best_model(input, &remaining, options, &run) else { break };
            for (image, reason) in reasons {
                result.unregistered.insert(image, reason);
            }
            for image in model.images().keys() {
                remaining.remove(image);
                result.unregistered.remove(image);
            }
            result.models.push(model);
            let connected = input.graph.restricted_to(&remaining).components();
            remaining = connected.into_iter().next().unwrap_or_default();
        }
    }
    result.models.sort_by_key(|model| std::cmp::Reverse((model.images().len(), model.num_points())));
    result
}

/// The best model of a component over a few initial pairs: the first that registers a satisfying share of the images, else
/// the one with most.
fn best_model(
    input: &MapperInput,
    component: &BTreeSet<ImageId>,
    options: &MapperOptions,
    run: &MapperRun<'_>,
) -> Option<(Reconstruction, BTreeMap<ImageId, Unregistered>)> {
    let graph = input.graph.restricted_to(component);
    let tracks = Tracks::build(&graph, &input.apart, run.keep_going);
    let rotations = RotationForest::of(&graph, |id| input.camera_of(id));
    let mut used_starts = BTreeSet::new();
    let mut best: Option<(Reconstruction, BTreeMap<ImageId, Unregistered>)> = None;
    for _ in 0..options.max_starts {
        let mut mapper = Mapper::new(input, &graph, &tracks, &rotations, component, options, run);
        if !mapper.start(&mut used_starts) {
            break;
        }
        mapper.grow();
        let registered = mapper.model.images().len();
        if registered >= options.min_model_images
            && best.as_ref().is_none_or(|(model, _)| registered > model.images().len())
        {
            let reasons = mapper.reasons();
            best = Some((mapper.model, reasons));
        }
        if registered as f64 >= options.satisfied_share * component.len() as f64 || !(run.keep_going)() {
            break;
        }
    }
    best
}

/// A model without images.
fn empty_model(input: &MapperInput) -> Reconstruction {
    let mut model = Reconstruction::new(input.cameras.clone());
    model.apart = input.apart.clone();
    model
}

/// A model that grows.
pub(super) struct Mapper<'a> {
    input: &'a MapperInput,
    graph: &'a MatchGraph,
    tracks: &'a Tracks,
    rotations: &'a RotationForest,
    component: &'a BTreeSet<ImageId>,
    options: &'a MapperOptions,
    run: &'a MapperRun<'a>,
    model: Reconstruction,
    /// The last point each track was given; it may have been filtered since.
    point_of_track: Vec<Option<Point3dId>>,
    trials: BTreeMap<ImageId, u32>,
    /// How often each image was taken out again for lack of points.
    drops: BTreeMap<ImageId, u32>,
    failures: BTreeMap<ImageId, Unregistered>,
    /// Whether no more images will be registered.
    is_whole: bool,
}

impl<'a> Mapper<'a> {
    fn new(
        input: &'a MapperInput,
        graph: &'a MatchGraph,
        tracks: &'a Tracks,
        rotations: &'a RotationForest,
        component: &'a BTreeSet<ImageId>,
        options: &'a MapperOptions,
        run: &'a MapperRun<'a>,
    ) -> Self {
        Self {
            input,
            graph,
            tracks,
            rotations,
            component,
            options,
            run,
            model: empty_model(input),
            point_of_track: vec![None; tracks.tracks.len()],
            trials: BTreeMap::new(),
            drops: BTreeMap::new(),
            failures: BTreeMap::new(),
            is_whole: false,
        }
    }

    fn goes_on(&self) -> bool {
        (self.run.keep_going)()
    }

    /// Number of images and of points.
    fn size(&self) -> (usize, usize) {
        (self.model.images().len(), self.model.num_points())
    }

    /// Registers image after image until none can be, then adjusts everything. What an earlier run did of that is taken up.
    fn grow(&mut self) {
        let from_start = Growth { adjusted_at: self.size(), min_inliers: self.options.min_pose_inliers };
        let mut growth = self.take_up().unwrap_or(from_start);
        if self.is_whole {
            return;
        }
        while self.goes_on() {
            (self.run.progress)(self.model.images().len());
            let Some(image) = self.register_next(growth.min_inliers) else {
                let has_grown = growth.adjusted_at.0 != self.model.images().len();
                if !has_grown && growth.min_inliers <= self.options.min_pose_inliers_relaxed {
                    break;
                }
                self.trials.clear();
                if has_grown {
                    self.adjust_and_keep(&mut growth);
                } else {
                    growth.min_inliers = self.options.min_pose_inliers_relaxed;
                }
                continue;
            };
            self.triangulate_image(image);
            self.adjust_locally(image);
            let (size, then) = (self.size(), growth.adjusted_at);
            let grown = |now: usize, then: usize| now as f64 >= self.options.global_growth * then as f64;
            if grown(size.0, then.0) || grown(size.1, then.1) {
                self.adjust_and_keep(&mut growth);
            }
        }
        self.finish();
        self.keep(growth);
    }

    fn adjust_and_keep(&mut self, growth: &mut Growth) {
        self.adjust_globally();
        growth.adjusted_at = self.size();
        self.keep(*growth);
    }

    /// Triangulates and completes the tracks of an image.
    fn triangulate_image(&mut self, image: ImageId) {
        let mut tracks: Vec<usize> = self.tracks.of(image).iter().map(|&(_, track)| track).collect();
        tracks.sort_unstable();
        self.triangulate_tracks(&tracks);
    }

    /// The largest reprojection error allowed in an image of a camera.
    fn max_error_px(&self, camera: &Camera) -> f64 {
        self.options.keep_limits().max_error_px(camera)
    }

    /// Why the component's other images are not in the model.
    fn reasons(&self) -> BTreeMap<ImageId, Unregistered> {
        let missing = self.component.iter().filter(|image| self.model.image(**image).is_none());
        missing
            .map(|&image| {
                let visible = self.visible_points(image).len();
                (image, self.failures.get(&image).cloned().unwrap_or(Unregistered::TooFewPoints { visible }))
            })
            .collect()
    }
}
