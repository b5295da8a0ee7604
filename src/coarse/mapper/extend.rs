//! Going on from a model of fewer pairs.

use std::collections::BTreeSet;

use super::{CoarseModels, Mapper, MapperInput, MapperOptions, MapperRun, empty_model, reconstruct};
use crate::coarse::Tracks;
use crate::coarse::rotation_cycles::RotationForest;
use crate::scene::{ImageId, Reconstruction};

/// The models of `input`, given those of the same images from some of its pairs. Where each component of the graph has
/// one model with all its images, the poses are there already: all tracks are triangulated anew and everything is
/// adjusted, which takes a third of the time. Where images are missing or models may be joined now, all is
/// reconstructed from the start.
pub fn extend(
    input: &MapperInput,
    models: &CoarseModels,
    options: &MapperOptions,
    run: &MapperRun<'_>,
) -> CoarseModels {
    let images_of = |model: &Reconstruction| -> BTreeSet<ImageId> { model.images().keys().copied().collect() };
    let placed: Vec<BTreeSet<ImageId>> = models.models.iter().map(images_of).collect();
    let components: Vec<BTreeSet<ImageId>> =
        input.graph.components().into_iter().filter(|component| component.len() >= options.min_model_images).collect();
    let is_whole = components.len() == placed.len() && components.iter().all(|component| placed.contains(component));
    if !is_whole {
        return reconstruct(input, options, run);
    }
    let mut extended = CoarseModels { models: Vec::new(), unregistered: models.unregistered.clone() };
    for (model, component) in models.models.iter().zip(&placed) {
        let graph = input.graph.restricted_to(component);
        let tracks = Tracks::build(&graph, &input.apart, run.keep_going);
        let rotations = RotationForest::of(&graph, |id| input.camera_of(id));
        let mut mapper = Mapper::new(input, &graph, &tracks, &rotations, component, options, run);
        mapper.adopt(model);
        mapper.grow();
        for (image, reason) in mapper.reasons() {
            extended.unregistered.insert(image, reason);
        }
        extended.models.push(mapper.model);
    }
    extended.models.sort_by_key(|model| std::cmp::Reverse((model.images().len(), model.num_points())));
    extended
}

impl Mapper<'_> {
    /// Takes over poses and intrinsics, and gives every track a point.
    fn adopt(&mut self, placed: &Reconstruction) {
        let mut model = empty_model(self.input);
        model.cameras = placed.cameras.clone();
        for (&id, image) in placed.images() {
            model.register(id, image.camera, image.cam_from_world, image.keypoints.clone());
        }
        self.model = model;
        let all: Vec<usize> = (0..self.tracks.tracks.len()).collect();
        self.triangulate_tracks(&all);
    }
}
