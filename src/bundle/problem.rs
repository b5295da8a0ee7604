//! The adjustment as dense arrays: poses, cameras, points, and sightings sorted by point.
//!
//! The unknowns of the reduced camera system come in *slots*: six of a pose `(omega, v)` as [`Rigid3::step`] takes them, or the
//! free parameters of a camera. Slots of poses come first, in image order, then those of cameras.

use std::collections::BTreeMap;

use super::config::{BundleConfig, FreeIntrinsics, Gauge, PointSelection};
use super::options::BundleOptions;
use super::projection::{Column, Lens};
use crate::camera::{Camera, MAX_PARAMS};
use crate::geometry::Rigid3;
use crate::scene::{CameraId, ImageId, Point3dId, Reconstruction};

/// Unknowns of a pose.
pub(super) const POSE: usize = 6;

/// Consecutive unknowns of the reduced system.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Slot {
    pub first: usize,
    pub len: usize,
}

/// An image that takes part.
pub(super) struct PoseBlock {
    pub id: ImageId,
    pub camera: u32,
    /// Which slot; none for a constant pose.
    pub slot: Option<u32>,
}

/// A camera that takes part.
pub(super) struct CameraBlock {
    pub id: CameraId,
    /// Which slot; none for constant intrinsics.
    pub slot: Option<u32>,
    /// Free parameters: index in `Camera::params` and meaning.
    pub free: Vec<(usize, Column)>,
    /// What a sighting of a point behind the camera counts as, squared pixels: the image diagonal.
    pub behind_sq: f64,
}

/// One sighting.
#[derive(Clone, Copy)]
pub(super) struct Sighting {
    pub pose: u32,
    pub pixel: [f64; 2],
}

/// A Gaussian prior on one free parameter.
pub(super) struct Prior {
    pub camera: usize,
    pub parameter: usize,
    pub unknown: usize,
    /// Whether the logarithm is what is normal.
    pub logarithmic: bool,
    /// The value expected.
    pub expected: f64,
    /// Standard deviation.
    pub sigma: f64,
}

impl Prior {
    /// The residual, in standard deviations, and its derivative by the parameter.
    pub fn residual(&self, state: &State) -> (f64, f64) {
        let value = state.cameras[self.camera].params[self.parameter];
        if self.logarithmic {
            ((value / self.expected).ln() / self.sigma, 1.0 / (value * self.sigma))
        } else {
            ((value - self.expected) / self.sigma, 1.0 / self.sigma)
        }
    }
}

/// What does not change during the adjustment.
pub(super) struct Problem {
    pub poses: Vec<PoseBlock>,
    pub cameras: Vec<CameraBlock>,
    pub slots: Vec<Slot>,
    /// Unknowns of the reduced system.
    pub num_unknowns: usize,
    /// Unknowns held for the gauge.
    pub held: Vec<usize>,
    pub priors: Vec<Prior>,
    pub point_ids: Vec<Point3dId>,
    pub point_is_variable: Vec<bool>,
    /// Sightings of point `p` are `sightings[point_start[p]..point_start[p + 1]]`, in image order.
    pub point_start: Vec<u32>,
    pub sightings: Vec<Sighting>,
}

/// What changes: a candidate solution.
#[derive(Clone)]
pub(super) struct State {
    pub poses: Vec<Rigid3>,
    /// The rotations of `poses`, row by row.
    pub rotations: Vec<[[f64; 3]; 3]>,
    pub cameras: Vec<Camera>,
    /// The lenses of `cameras`.
    pub lenses: Vec<Lens>,
    pub points: Vec<[f64; 3]>,
}

impl State {
    /// Rotation matrices and lenses of the poses and cameras as they are now.
    pub fn refresh(&mut self) {
        for (rotation, pose) in self.rotations.iter_mut().zip(&self.poses) {
            let matrix = pose.rotation_matrix();
            *rotation = std::array::from_fn(|row| std::array::from_fn(|column| matrix[(row, column)]));
        }
        for (lens, camera) in self.lenses.iter_mut().zip(&self.cameras) {
            *lens = Lens::of(camera);
        }
    }
}

fn free_columns(camera: &Camera, free: FreeIntrinsics) -> Vec<(usize, Column)> {
    (0..camera.model.num_params())
        .map(|index| (index, Lens::column(camera, index)))
        .filter(|(_, column)| match column {
            Column::Focal | Column::FocalOf(_) => free.focal,
            Column::Center(_) => free.principal_point,
            Column::Distortion(_) => free.distortion,
        })
        .collect()
}

/// The points that take part, by the first images that see them: points that are near each other in this order touch the
/// same blocks of the reduced system, which then stay in the cache.
fn chosen_points(model: &Reconstruction, config: &BundleConfig) -> Vec<Point3dId> {
    let mut ids: Vec<(ImageId, ImageId, Point3dId)> = selected_points(model, config)
        .into_iter()
        .filter_map(|id| {
            let track = &model.point(id)?.track;
            Some((track.first()?.image, track.last()?.image, id))
        })
        .collect();
    ids.sort_unstable();
    ids.into_iter().map(|(.., id)| id).collect()
}

fn selected_points(model: &Reconstruction, config: &BundleConfig) -> Vec<Point3dId> {
    match &config.points {
        PointSelection::Only(ids) => ids.iter().copied().collect(),
        PointSelection::SeenByVariableImages => {
            let images = config.variable_images.iter().filter_map(|&id| model.image(id));
            let mut ids: Vec<Point3dId> = images.flat_map(|image| image.points().iter().flatten().copied()).collect();
            ids.sort_unstable();
            ids.dedup();
            ids
        }
    }
}

impl Problem {
    /// Gathers what the configuration names from a model.
    pub fn build(model: &Reconstruction, config: &BundleConfig, options: &BundleOptions) -> (Self, State) {
        let chosen = chosen_points(model, config);
        let bound = model.images().keys().next_back().map_or(0, |id| id.index() + 1);
        let mut pose_of_image: Vec<Option<u32>> = vec![None; bound];
        for &id in &chosen {
            for seen in &model.point(id).expect("chosen points exist").track {
                pose_of_image[seen.image.index()] = Some(0);
            }
        }
        let mut problem = Self {
            poses: Vec::new(),
            cameras: Vec::new(),
            slots: Vec::new(),
            num_unknowns: 0,
            held: Vec::new(),
            priors: Vec::new(),
            point_ids: Vec::new(),
            point_is_variable: Vec::new(),
            point_start: vec![0],
            sightings: Vec::new(),
        };
        let mut state = State {
            poses: Vec::new(),
            rotations: Vec::new(),
            cameras: Vec::new(),
            lenses: Vec::new(),
            points: Vec::new(),
        };
        let mut rank_of_camera: BTreeMap<CameraId, u32> = BTreeMap::new();
        for (&id, image) in model.images() {
            if pose_of_image[id.index()].is_none() {
                continue;
            }
            let next = rank_of_camera.len() as u32;
            let camera = *rank_of_camera.entry(image.camera).or_insert(next);
            if camera == next {
                problem.cameras.push(camera_block(model, config, image.camera));
                state.cameras.push(model.cameras[&image.camera].clone());
            }
            pose_of_image[id.index()] = Some(problem.poses.len() as u32);
            problem.poses.push(PoseBlock { id, camera, slot: None });
            state.poses.push(image.cam_from_world);
        }
        state.rotations = vec![[[0.0; 3]; 3]; state.poses.len()];
        state.lenses = state.cameras.iter().map(Lens::of).collect();
        state.refresh();

        for &id in &chosen {
            let point = model.point(id).expect("chosen points exist");
            let is_variable = !config.constant_points.contains(&id);
            for seen in &point.track {
                let image = &model.images()[&seen.image];
                let pixel = image.keypoints[seen.keypoint.index()].0;
                let pose = pose_of_image[seen.image.index()].expect("images of chosen points take part");
                let camera = &problem.cameras[problem.poses[pose as usize].camera as usize];
                if is_variable || config.variable_images.contains(&seen.image) || !camera.free.is_empty() {
                    problem.sightings.push(Sighting { pose, pixel: [pixel.x, pixel.y] });
                }
            }
            let end = problem.sightings.len() as u32;
            if problem.point_start.last() != Some(&end) {
                problem.point_ids.push(id);
                problem.point_is_variable.push(is_variable);
                problem.point_start.push(end);
                state.points.push(point.xyz.into());
            }
        }
        problem.assign_slots(config, &state);
        problem.add_priors(config, options, &state);
        (problem, state)
    }

    fn assign_slots(&mut self, config: &BundleConfig, state: &State) {
        let mut is_variable: Vec<bool> =
            self.poses.iter().map(|pose| config.variable_images.contains(&pose.id)).collect();
        let scale = self.fix_gauge(config.gauge, &mut is_variable, state);
        for (pose, _) in self.poses.iter_mut().zip(&is_variable).filter(|(_, variable)| **variable) {
            pose.slot = Some(self.slots.len() as u32);
            self.slots.push(Slot { first: self.num_unknowns, len: POSE });
            self.num_unknowns += POSE;
        }
        if let Some((pose, coordinate)) = scale
            && let Some(slot) = self.poses[pose].slot
        {
            self.held.push(self.slots[slot as usize].first + 3 + coordinate);
        }
        for camera in self.cameras.iter_mut().filter(|camera| !camera.free.is_empty()) {
            camera.slot = Some(self.slots.len() as u32);
            self.slots.push(Slot { first: self.num_unknowns, len: camera.free.len() });
            self.num_unknowns += camera.free.len();
        }
    }

    /// Holds one pose, and returns the pose and the coordinate of its translation that fix the scale.
    ///
    /// With the first centre `c1` held, scaling the scene about it by `s` turns the translation `t2 = -R2 c2` of another
    /// image into `-R2 c1 - s R2 (c2 - c1)`: holding the coordinate where `R2 (c2 - c1)` is largest fixes `s`.
    fn fix_gauge(&self, gauge: Gauge, is_variable: &mut [bool], state: &State) -> Option<(usize, usize)> {
        let num_constant = is_variable.iter().filter(|variable| !**variable).count();
        let num_constant_points = self.point_is_variable.iter().filter(|variable| !**variable).count();
        if gauge == Gauge::Free || num_constant >= 2 || num_constant_points >= 3 || is_variable.is_empty() {
            return None;
        }
        let anchor = is_variable.iter().position(|variable| !variable).unwrap_or_else(|| {
            let mut counts = vec![0usize; self.poses.len()];
            for sighting in &self.sightings {
                counts[sighting.pose as usize] += 1;
            }
            let most = counts.iter().copied().max().unwrap_or(0);
            counts.iter().position(|&count| count == most).unwrap_or(0)
        });
        is_variable[anchor] = false;
        let center = state.poses[anchor].target_origin_in_source();
        let mut best: Option<(f64, usize, usize)> = None;
        for (pose, at) in state.poses.iter().enumerate().filter(|&(pose, _)| is_variable[pose]) {
            let offset = at.rotation * (at.target_origin_in_source() - center);
            let coordinate = offset.iamax();
            if best.is_none_or(|(largest, ..)| offset[coordinate].abs() > largest) {
                best = Some((offset[coordinate].abs(), pose, coordinate));
            }
        }
        best.map(|(_, pose, coordinate)| (pose, coordinate))
    }

    fn add_priors(&mut self, config: &BundleConfig, options: &BundleOptions, state: &State) {
        for (rank, block) in self.cameras.iter().enumerate() {
            let Some(slot) = block.slot else { continue };
            let camera = &state.cameras[rank];
            for (at, &(parameter, column)) in block.free.iter().enumerate() {
                let unknown = self.slots[slot as usize].first + at;
                let prior = match column {
                    Column::Focal | Column::FocalOf(_) => {
                        config.focal_priors.get(&block.id).map(|prior| (true, prior.focal_px, prior.sigma_log))
                    }
                    Column::Center(axis) => options.principal_point_sigma.map(|sigma| {
                        let (width, height) = (f64::from(camera.width), f64::from(camera.height));
                        (false, 0.5 * [width, height][axis], sigma * width.max(height))
                    }),
                    Column::Distortion(_) => None,
                };
                if let Some((logarithmic, expected, sigma)) = prior {
                    self.priors.push(Prior { camera: rank, parameter, unknown, logarithmic, expected, sigma });
                }
            }
        }
    }

    /// Writes what may have changed back into the model.
    pub fn write_back(&self, state: &State, model: &mut Reconstruction) {
        for (block, pose) in self.poses.iter().zip(&state.poses).filter(|(block, _)| block.slot.is_some()) {
            model.set_pose(block.id, *pose);
        }
        for (block, camera) in self.cameras.iter().zip(&state.cameras).filter(|(block, _)| block.slot.is_some()) {
            model.cameras.insert(block.id, camera.clone());
        }
        for ((&id, point), _) in
            self.point_ids.iter().zip(&state.points).zip(&self.point_is_variable).filter(|(_, variable)| **variable)
        {
            model.set_xyz(id, (*point).into());
        }
    }
}

fn camera_block(model: &Reconstruction, config: &BundleConfig, id: CameraId) -> CameraBlock {
    let camera = &model.cameras[&id];
    let free = config.intrinsics.get(&id).map_or_else(Vec::new, |&free| free_columns(camera, free));
    debug_assert!(free.len() <= MAX_PARAMS);
    let (width, height) = (f64::from(camera.width), f64::from(camera.height));
    CameraBlock { id, slot: None, free, behind_sq: width * width + height * height }
}
