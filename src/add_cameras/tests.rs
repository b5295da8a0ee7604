//! The stage on synthetic scenes with known truth.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::*;
use crate::camera::{Camera, FocalSource};
use crate::geometry::Rigid3;
use crate::math::Rng;
use crate::scene::{CameraId, DESCRIPTOR_LEN, Observation};
use crate::synthetic::{Layout, SceneOptions, generate};

const SEED: u64 = 5;

/// A scene some of whose images were taken out of the model.
struct Held {
    model: Reconstruction,
    features: BTreeMap<ImageId, Arc<Features>>,
    counts: MatchCounts,
    poses: BTreeMap<ImageId, Rigid3>,
    queries: Vec<QueryImage>,
    /// The point every keypoint of a held image really sees.
    truth: BTreeMap<ImageId, Vec<Option<nalgebra::Vector3<f64>>>>,
}

fn hold_out(options: &SceneOptions, held: &[u32]) -> Held {
    let scene = generate(options);
    let mut model = scene.truth;
    let (mut poses, mut truth, mut queries) = (BTreeMap::new(), BTreeMap::new(), Vec::new());
    for id in held.iter().copied().map(ImageId) {
        let image = model.image(id).unwrap();
        poses.insert(id, image.cam_from_world);
        let seen = image.points().iter().map(|point| point.map(|point| model.point(point).unwrap().xyz)).collect();
        truth.insert(id, seen);
        queries.push(QueryImage { image: id, camera_id: image.camera, camera: model.camera_of(id).clone() });
    }
    for &id in poses.keys() {
        model.deregister(id);
    }
    let counts = scene.matches.iter().map(|(&pair, matches)| (pair, matches.len() as u32)).collect();
    let features = scene.features.into_iter().map(|(id, features)| (id, Arc::new(features))).collect();
    Held { model, features, counts, poses, queries, truth }
}

impl Held {
    fn run(&mut self, options: &AddCamerasOptions) -> AddCamerasReport {
        let features = &self.features;
        let load = |id: ImageId| features[&id].clone();
        let snapshot = ModelSnapshot::build(&self.model, &load, options);
        let (model, counts) = (&self.model, &self.counts);
        let found =
            localize_all(&snapshot, model, &self.queries, &load, counts, options, SEED, &|_, _| (), &|| false).unwrap();
        add_localized(&mut self.model, &snapshot, found, &load, options, SEED)
    }

    fn localize(&self, options: &AddCamerasOptions) -> Result<Localized, LocalizeFailure> {
        let load = |id: ImageId| self.features[&id].clone();
        let snapshot = ModelSnapshot::build(&self.model, &load, options);
        let query = &self.queries[0];
        let features = load(query.image);
        localize_image(&snapshot, &self.model, query, &features, &load, &self.counts, options, SEED)
    }

    fn assert_pose(&self, id: ImageId, tolerance: f64) {
        let found = self.model.image(id).unwrap().cam_from_world;
        assert_close(&found, &self.poses[&id], tolerance);
    }
}

fn assert_close(found: &Rigid3, truth: &Rigid3, tolerance: f64) {
    let turn = found.rotation.angle_to(&truth.rotation);
    let shift = (found.target_origin_in_source() - truth.target_origin_in_source()).norm();
    assert!(turn < tolerance && shift < 4.0 * tolerance, "turn {turn}, shift {shift}");
}

/// Noise and as much clutter as features.
fn cluttered() -> SceneOptions {
    SceneOptions { num_points: 2000, pixel_noise_px: 0.5, distractor_ratio: 1.0, ..SceneOptions::default() }
}

fn only(method: LocalizationMethod) -> AddCamerasOptions {
    AddCamerasOptions { methods: vec![method], ..AddCamerasOptions::default() }
}

#[test]
fn every_method_localises_an_image_with_clutter() {
    for method in [LocalizationMethod::ActiveSearch, LocalizationMethod::RankedMatch, LocalizationMethod::DirectMatch] {
        let held = hold_out(&cluttered(), &[4]);
        let found = held.localize(&only(method)).unwrap();
        assert_eq!(found.method, method);
        assert_close(&found.cam_from_world, &held.poses[&ImageId(4)], 2e-3);
        // Most inliers are the true ones: nearly every match names the point its keypoint really sees.
        let truth = &held.truth[&ImageId(4)];
        let right = found.inliers.iter().filter(|seen| {
            let xyz = held.model.point(seen.point).unwrap().xyz;
            truth[seen.keypoint.index()].is_some_and(|seen| (seen - xyz).norm() < 1e-9)
        });
        let right = right.count();
        assert!(right >= 100 && right as f64 > 0.97 * found.inliers.len() as f64, "{method:?}: {right}");
    }
}

#[test]
fn active_search_ends_when_it_has_enough() {
    let held = hold_out(&cluttered(), &[4]);
    let mut options = only(LocalizationMethod::ActiveSearch);
    options.active_search.enough_correspondences = 60;
    let found = held.localize(&options).unwrap();
    assert!((60..120).contains(&found.num_correspondences), "{}", found.num_correspondences);
    options.active_search.enough_correspondences = usize::MAX;
    let exhaustive = held.localize(&options).unwrap();
    let seen = held.truth[&ImageId(4)].iter().flatten().count();
    assert!(exhaustive.inliers.len() as f64 > 0.6 * seen as f64, "{} of {seen}", exhaustive.inliers.len());
}

#[test]
fn the_search_from_points_finds_what_the_search_from_features_misses() {
    let held = hold_out(&cluttered(), &[4]);
    let count = |neighbors_3d: usize| {
        let mut options = only(LocalizationMethod::ActiveSearch);
        options.active_search.enough_correspondences = usize::MAX;
        options.active_search.neighbors_3d = neighbors_3d;
        held.localize(&options).unwrap().inliers.len()
    };
    assert!(count(200) > count(0), "{} {}", count(200), count(0));
}

#[test]
fn all_held_images_are_added_with_their_sightings() {
    let mut held = hold_out(&cluttered(), &[1, 4, 7]);
    let before = held.model.num_observations();
    let report = held.run(&AddCamerasOptions::default());
    assert_eq!((report.images_tried, report.added.len(), report.failed.len()), (3, 3, 0));
    held.model.assert_consistent();
    for id in [1, 4, 7].map(ImageId) {
        held.assert_pose(id, 2e-3);
        assert!(held.model.image(id).unwrap().num_observations() >= 100);
        assert_eq!(report.added[&id].method, LocalizationMethod::ActiveSearch);
    }
    assert_eq!(held.model.num_observations(), before + report.observations_added);
    for (id, point) in held.model.points() {
        for &seen in &point.track {
            let limit = if held.poses.contains_key(&seen.image) { 4.0 } else { 5.0 };
            assert!(held.model.reprojection_error_px(id, seen) <= limit);
        }
    }
}

#[test]
fn the_number_of_threads_does_not_show() {
    let bytes = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut held = hold_out(&cluttered(), &[1, 4, 7]);
        let report = pool.install(|| held.run(&AddCamerasOptions::default()));
        (serde_json::to_string(&held.model).unwrap(), serde_json::to_string(&report).unwrap())
    };
    assert_eq!(bytes(1), bytes(4));
}

#[test]
fn images_that_share_an_unknown_camera_agree_on_it() {
    let scene = SceneOptions { shared_camera: true, ..cluttered() };
    let mut held = hold_out(&scene, &[1, 4, 7]);
    // A camera of their own whose focal length is only guessed.
    let guess = 0.8 * scene.focal_px;
    let mut camera = Camera { focal_source: FocalSource::Guess, ..held.queries[0].camera.clone() };
    camera.set_focal(guess, guess);
    for query in &mut held.queries {
        query.camera_id = CameraId(9);
        query.camera = camera.clone();
    }
    let report = held.run(&AddCamerasOptions::default());
    assert_eq!(report.added.len(), 3, "{:?}", report.failed);
    let found = &held.model.cameras[&CameraId(9)];
    assert_eq!(found.focal_source, FocalSource::Estimated);
    assert!((found.mean_focal_px() / scene.focal_px - 1.0).abs() < 0.02, "{}", found.mean_focal_px());
    for id in [1, 4, 7].map(ImageId) {
        held.assert_pose(id, 2e-2);
    }
}

#[test]
fn a_shared_camera_of_the_model_is_not_changed() {
    let mut held = hold_out(&cluttered(), &[4]);
    for camera in held.model.cameras.values_mut() {
        camera.focal_source = FocalSource::Guess;
    }
    let before = held.model.cameras.clone();
    assert_eq!(held.run(&AddCamerasOptions::default()).added.len(), 1);
    assert_eq!(held.model.cameras, before);
}

#[test]
fn a_picture_of_something_else_fails_with_its_reason() {
    let mut held = hold_out(&cluttered(), &[4]);
    let mut rng = Rng::from_parts(&[77]);
    let alien = Arc::make_mut(held.features.get_mut(&ImageId(4)).unwrap());
    for descriptor in &mut alien.descriptors {
        *descriptor = std::array::from_fn(|_| rng.below(91) as u8);
    }
    let failure = held.run(&AddCamerasOptions::default()).failed[&ImageId(4)];
    assert!(
        matches!(failure, LocalizeFailure::TooFewCorrespondences { found, .. } if found < 12)
            || matches!(failure, LocalizeFailure::TooFewInliers { inliers, .. } if inliers < 12),
        "{failure}"
    );
    assert!(held.model.image(ImageId(4)).is_none());
    held.features.insert(ImageId(4), Arc::new(Features::default()));
    assert_eq!(held.run(&AddCamerasOptions::default()).failed[&ImageId(4)], LocalizeFailure::NoFeatures);
}

#[test]
fn matches_all_over_the_place_are_no_pose() {
    // The right descriptors at random places: plenty of correspondences, no geometry.
    let mut held = hold_out(&cluttered(), &[4]);
    let mut rng = Rng::from_parts(&[78]);
    let scrambled = Arc::make_mut(held.features.get_mut(&ImageId(4)).unwrap());
    for keypoint in &mut scrambled.keypoints {
        keypoint.x = rng.range(0.0, 1000.0) as f32;
        keypoint.y = rng.range(0.0, 800.0) as f32;
    }
    let failure = held.run(&AddCamerasOptions::default()).failed[&ImageId(4)];
    assert!(
        matches!(failure, LocalizeFailure::TooFewInliers { inliers, correspondences, .. }
            if correspondences > 100 && inliers < 16),
        "{failure}"
    );
}

#[test]
fn ranked_images_come_by_matches_and_only_localised_ones() {
    let held = hold_out(&cluttered(), &[4, 5]);
    let ranked = ranked_match::ranked_images(&held.model, ImageId(4), &held.counts, 3);
    assert_eq!(ranked.len(), 3);
    assert!(!ranked.contains(&ImageId(5)), "it is not in the model");
    let count = |other: ImageId| held.counts[&(other.min(ImageId(4)), other.max(ImageId(4)))];
    assert!(ranked.windows(2).all(|pair| count(pair[0]) >= count(pair[1])));
    let left_out = held.model.images().keys().filter(|id| !ranked.contains(id));
    for &id in left_out {
        let key = (id.min(ImageId(4)), id.max(ImageId(4)));
        assert!(held.counts.get(&key).is_none_or(|&matches| matches <= count(ranked[2])));
    }
    // Without coarse matches there is nobody to ask.
    assert!(ranked_match::ranked_images(&held.model, ImageId(4), &MatchCounts::new(), 3).is_empty());
    let mut alone = held;
    alone.counts.clear();
    let failure = alone.localize(&only(LocalizationMethod::RankedMatch)).unwrap_err();
    assert!(matches!(failure, LocalizeFailure::TooFewCorrespondences { found: 0, needed: 17, .. }), "{failure}");
}

#[test]
fn a_large_model_is_searched_by_its_cover() {
    let scene = SceneOptions { layout: Layout::Facade, num_points: 4000, ..cluttered() };
    let mut held = hold_out(&scene, &[4]);
    let set_cover = SetCoverOptions { above_points: 1000, points_per_camera: 300 };
    let options = AddCamerasOptions { set_cover, ..AddCamerasOptions::default() };
    let all = held.model.num_points();
    let report = held.run(&options);
    assert!(report.points_searched < all / 2, "{} of {all}", report.points_searched);
    held.assert_pose(ImageId(4), 2e-3);
}

#[test]
fn a_point_is_the_mean_of_its_sightings_and_listed_under_their_words() {
    let held = hold_out(&cluttered(), &[4]);
    let load = |id: ImageId| held.features[&id].clone();
    let snapshot = ModelSnapshot::build(&held.model, &load, &AddCamerasOptions::default());
    assert_eq!(snapshot.len(), held.model.num_points());
    for (rank, (id, point)) in held.model.points().enumerate().step_by(97) {
        assert_eq!(snapshot.ids[rank], id);
        let seen: Vec<_> =
            point.track.iter().map(|seen| held.features[&seen.image].descriptors[seen.keypoint.index()]).collect();
        for byte in 0..DESCRIPTOR_LEN {
            let mean = seen.iter().map(|descriptor| f64::from(descriptor[byte])).sum::<f64>() / seen.len() as f64;
            assert!((f64::from(snapshot.descriptors[rank][byte]) - mean).abs() <= 0.5);
        }
        for word in snapshot.vocabulary.words_of(&seen) {
            assert!(snapshot.points_of_word.group(word as usize).contains(&(rank as u32)));
            let coarse = snapshot.vocabulary.coarse_word_of(word);
            assert!(snapshot.coarse_words_of_point[rank].contains(&coarse));
        }
    }
}

#[test]
fn far_inliers_do_not_enter_the_tracks() {
    let mut held = hold_out(&cluttered(), &[4]);
    let mut options = AddCamerasOptions::default();
    options.pose.max_track_error_px = 0.5;
    let report = held.run(&options);
    let (added, image) = (report.added[&ImageId(4)], held.model.image(ImageId(4)).unwrap());
    assert!(image.num_observations() > 20 && image.num_observations() < added.inliers);
    for (keypoint, point) in (0u32..).map(crate::scene::KeypointIdx).zip(image.points()) {
        if let Some(point) = point {
            let seen = Observation { image: ImageId(4), keypoint };
            assert!(held.model.reprojection_error_px(*point, seen) <= 0.5);
        }
    }
}

#[test]
fn cancelling_ends_the_search() {
    let held = hold_out(&cluttered(), &[4]);
    let load = |id: ImageId| held.features[&id].clone();
    let options = AddCamerasOptions::default();
    let snapshot = ModelSnapshot::build(&held.model, &load, &options);
    let (queries, counts) = (&held.queries, &held.counts);
    let outcome = localize_all(&snapshot, &held.model, queries, &load, counts, &options, SEED, &|_, _| (), &|| true);
    assert_eq!(outcome.err(), Some(AddCamerasCancelled));
}

#[test]
fn default_options_are_valid_and_bad_ones_are_named() {
    let mut errors = Vec::new();
    let mut options = AddCamerasOptions::default();
    options.validate(&mut errors);
    assert!(errors.is_empty(), "{errors:?}");
    options.methods.clear();
    options.ranked_match.ratio = 1.5;
    options.pose.min_inliers = 3;
    options.vocabulary.max_words = 0;
    options.validate(&mut errors);
    assert_eq!(errors.len(), 4, "{errors:?}");
}
