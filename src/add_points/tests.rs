//! The stage on a scene with known truth.

mod completion;
mod mutual;
mod tracks;

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use nalgebra::Vector3;

use super::pair_matcher::shared_observations;
use super::test_scene::{SceneSpec, TestScene, add_points, build};
use super::*;
use crate::matching::descriptor::distance_sq;
use crate::scene::{KeypointIdx, Observation};

fn match_images(
    scene: &TestScene,
    model: &Reconstruction,
    a: usize,
    b: usize,
    options: &AddPointsOptions,
) -> PairMatches {
    let ids = (ImageId(a as u32), ImageId(b as u32));
    match_pair(model, ids, (scene.features[a].clone(), scene.features[b].clone()), options, 7).unwrap()
}

/// Fraction of matches that are right, and fraction of the true pairs that are found.
fn precision_and_recall(scene: &TestScene, found: &PairMatches) -> (f64, f64) {
    let (a, b) = (found.first.index(), found.second.index());
    let right = |found: &&KeypointMatch| {
        let (x, y) = (scene.truth[a][found.first.index()], scene.truth[b][found.second.index()]);
        x.is_some() && x == y
    };
    let right = found.matches.iter().filter(right).count() as f64;
    (right / found.matches.len() as f64, right / scene.true_pairs(a, b) as f64)
}

fn densify(scene: &TestScene, model: &mut Reconstruction, options: &AddPointsOptions) -> AddPointsReport {
    let features = |id: ImageId| scene.features[id.index()].clone();
    add_points(model, &features, None, options, 7, &|_, _| {}, &|| false).unwrap()
}

#[test]
fn guided_matching_finds_nearly_all_and_little_else() {
    let scene = build(&SceneSpec::default());
    for (a, b) in [(0, 1), (1, 4), (0, 5)] {
        let found = match_images(&scene, &scene.posed, a, b, &AddPointsOptions::default());
        let (precision, recall) = precision_and_recall(&scene, &found);
        assert!(precision > 0.98 && recall > 0.95, "{a}-{b}: precision {precision}, recall {recall}");
        let targets: BTreeSet<KeypointIdx> = found.matches.iter().map(|found| found.second).collect();
        assert_eq!(targets.len(), found.matches.len(), "each keypoint once");
    }
}

#[test]
fn all_searches_give_the_same_matches() {
    let scene = build(&SceneSpec::default());
    let with = |search| {
        let mut options = AddPointsOptions::default();
        options.guided_match.search = search;
        match_images(&scene, &scene.posed, 0, 3, &options)
    };
    let oracle = with(CandidateSearch::Linear);
    assert_eq!(with(CandidateSearch::Grid), oracle);
    assert_eq!(with(CandidateSearch::Radial), oracle);
}

/// The posed model with image 3 moved behind image 2, so that the epipole is in the image.
fn one_behind_the_other(scene: &TestScene) -> Reconstruction {
    let mut model = scene.posed.clone();
    let ahead = model.images()[&ImageId(2)].cam_from_world;
    let behind = crate::geometry::Rigid3::new(ahead.rotation, ahead.translation + Vector3::new(0.02, 0.01, 0.6));
    model.set_pose(ImageId(3), behind);
    model
}

/// Without the tolerance of line groups every query has its own band in all searches, and without random rivals nothing is
/// left to chance. Two cameras side by side, and one behind the other with the epipole in the image, where features and poses
/// do not fit together: what is compared are the candidates, both ways.
#[test]
fn the_sweep_finds_what_a_scan_of_all_features_finds() {
    let scene = build(&SceneSpec::default());
    let model = one_behind_the_other(&scene);
    for (posed, (a, b)) in [(&scene.posed, (0, 3)), (&scene.posed, (4, 1)), (&model, (2, 3)), (&model, (3, 2))] {
        let with = |search| {
            let mut options = AddPointsOptions::default();
            options.guided_match = GuidedMatchOptions {
                search,
                group_tolerance_px: 0.0,
                pad_to: 0,
                min_pair_matches: 0,
                max_ratio: 1.0,
                ratio_both_ways: true,
                cheirality: false,
                max_scale_discrepancy: None,
                max_orientation_discrepancy_deg: None,
                ..options.guided_match
            };
            match_images(&scene, posed, a, b, &options)
        };
        let oracle = with(CandidateSearch::Linear);
        assert!(oracle.matches.len() > 200, "{a}-{b}: {}", oracle.matches.len());
        assert_eq!(with(CandidateSearch::Sweep), oracle, "{a}-{b}");
    }
}

/// The paper's figure 5: a facade where every description occurs a dozen times or more.
#[test]
fn repeated_structures_are_matched_only_with_guidance() {
    let scene = build(&SceneSpec { points: 4000, repeat_every: Some(300), clutter: 200, ..SceneSpec::default() });
    let (a, b) = (&scene.features[1], &scene.features[2]);
    let options = AddPointsOptions::default();
    let ratio = options.guided_match.max_ratio;
    let mut global = 0;
    for descriptor in &a.descriptors {
        let mut distances: Vec<u32> = b.descriptors.iter().map(|other| distance_sq(descriptor, other)).collect();
        distances.sort_unstable();
        global += usize::from(f64::from(distances[0]) <= ratio * ratio * f64::from(distances[1]));
    }
    let found = match_images(&scene, &scene.posed, 1, 2, &options);
    let (precision, recall) = precision_and_recall(&scene, &found);
    let truth = scene.true_pairs(1, 2);
    assert!((global as f64) < 0.1 * truth as f64, "globally {global} of {truth} pass the ratio test");
    assert!(precision > 0.9 && recall > 0.6, "precision {precision}, recall {recall}");
}

#[test]
fn padding_keeps_the_ratio_test_meaningful() {
    // Nothing but clutter of a few kinds: along a line there are a handful of candidates, and one of the query's kind
    // would pass for lack of rivals.
    let scene = build(&SceneSpec { points: 2, clutter: 600, clutter_kinds: Some(12), ..SceneSpec::default() });
    let count = |pad_to| {
        let mut options = AddPointsOptions::default();
        options.guided_match = GuidedMatchOptions {
            pad_to,
            min_pair_matches: 0,
            mutual: false,
            max_scale_discrepancy: None,
            max_orientation_discrepancy_deg: None,
            ..options.guided_match
        };
        match_images(&scene, &scene.posed, 0, 1, &options).matches.len()
    };
    let (padded, bare) = (count(50), count(0));
    assert!(padded < bare / 5 && bare > 20, "{padded} false matches with padding, {bare} without");
}

#[test]
fn a_second_description_of_a_place_is_no_rival() {
    let mut scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let before = match_images(&scene, &scene.posed, 0, 1, &AddPointsOptions::default()).matches.len();
    // Every keypoint of image 1 once more, as SIFT does for a second orientation, with a similar descriptor.
    let twice = |features: &Features| {
        let double = |k: usize| k / 2;
        let n = 2 * features.len();
        let mut descriptors: Vec<_> = (0..n).map(|k| features.descriptors[double(k)]).collect();
        descriptors.iter_mut().skip(1).step_by(2).for_each(|d| d[..16].reverse());
        Features { keypoints: (0..n).map(|k| features.keypoints[double(k)]).collect(), descriptors }
    };
    let second = Arc::new(twice(&scene.features[1]));
    let mut model = Reconstruction::new(scene.posed.cameras.clone());
    for (&id, image) in scene.posed.images() {
        let keypoints = if id == ImageId(1) {
            second.keypoints.iter().map(|k| crate::camera::Pixel::new(f64::from(k.x), f64::from(k.y))).collect()
        } else {
            image.keypoints.clone()
        };
        model.register(id, image.camera, image.cam_from_world, keypoints);
    }
    scene.features[1] = second;
    let mut options = AddPointsOptions::default();
    let with = match_images(&scene, &model, 0, 1, &options).matches.len();
    options.guided_match.same_place_px = 0.0;
    let exact = match_images(&scene, &model, 0, 1, &options).matches.len();
    assert!(with as f64 > 0.9 * before as f64, "{with} of {before}");
    assert_eq!(exact, with, "equal positions are one place at any radius");
}

#[test]
fn wrong_scales_and_turns_are_gated() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let all = match_images(&scene, &scene.posed, 0, 1, &AddPointsOptions::default()).matches.len();
    let spoil = |change: fn(&mut crate::scene::Keypoint)| {
        let mut spoiled = (*scene.features[1]).clone();
        spoiled.keypoints.iter_mut().step_by(4).for_each(change);
        let pair = (ImageId(0), ImageId(1));
        let features = (scene.features[0].clone(), Arc::new(spoiled));
        match_pair(&scene.posed, pair, features, &AddPointsOptions::default(), 7).unwrap().matches.len()
    };
    for left in [spoil(|keypoint| keypoint.scale *= 5.0), spoil(|keypoint| keypoint.orientation += 2.0)] {
        let share = left as f64 / all as f64;
        assert!((0.7..0.8).contains(&share), "{left} of {all}");
    }
}

#[test]
fn known_correspondences_are_not_matched_again() {
    let scene = build(&SceneSpec::default());
    let coarse = scene.coarse(0.3);
    let found = match_images(&scene, &coarse, 0, 1, &AddPointsOptions::default());
    let (first, second) = (&coarse.images()[&ImageId(0)], &coarse.images()[&ImageId(1)]);
    assert!(shared_observations(&coarse, ImageId(0), ImageId(1)).len() > 100);
    for found in &found.matches {
        let (a, b) = (first.points()[found.first.index()], second.points()[found.second.index()]);
        assert!(a.is_none() || a != b);
    }
}

#[test]
fn the_model_becomes_dense() {
    let scene = build(&SceneSpec::default());
    let mut model = scene.coarse(0.2);
    let before = model.num_points();
    let report = densify(&scene, &mut model, &AddPointsOptions::default());
    model.assert_consistent();
    assert_eq!((report.points_before, report.points_after), (before, model.num_points()));
    assert_eq!(report.points_after + report.points_absorbed, before + report.points_created);
    // Every point that at least three images show should be there, once, with nearly all its sightings.
    let mut shown = vec![0usize; scene.points.len()];
    scene.truth.iter().flatten().flatten().for_each(|&point| shown[point] += 1);
    let (mut of_point, mut pure, mut wrong_sightings) = (vec![0usize; scene.points.len()], 0, 0);
    let mut found_sightings = 0;
    for (_, point) in model.points() {
        let shows: Vec<Option<usize>> = point.track.iter().map(|seen| scene.truth_of(seen)).collect();
        let most = shows.iter().flatten().copied().max_by_key(|p| shows.iter().filter(|s| **s == Some(*p)).count());
        let Some(most) = most else { continue };
        let agree = shows.iter().filter(|s| **s == Some(most)).count();
        wrong_sightings += shows.len() - agree;
        found_sightings += agree;
        of_point[most] += 1;
        pure += usize::from(agree == shows.len());
        if agree == shows.len() && agree >= 4 {
            assert!((point.xyz - scene.points[most]).norm() < 0.05, "{:?} {:?}", point.xyz, scene.points[most]);
        }
    }
    let wanted = shown.iter().filter(|&&n| n >= 3).count();
    let there = (0..shown.len()).filter(|&p| shown[p] >= 3 && of_point[p] > 0).count();
    let split = of_point.iter().filter(|&&n| n > 1).count();
    assert!(there as f64 > 0.98 * wanted as f64, "{there} of {wanted} points");
    assert!(split as f64 <= 0.01 * wanted as f64, "{split} points in pieces");
    assert!(pure as f64 > 0.98 * model.num_points() as f64);
    assert!((wrong_sightings as f64) < 0.01 * found_sightings as f64);
    let possible: usize = shown.iter().filter(|&&n| n >= 2).sum();
    assert!(found_sightings as f64 > 0.95 * possible as f64, "{found_sightings} of {possible} sightings");
    let mut errors = model.reprojection_errors_px();
    errors.sort_by(f64::total_cmp);
    assert!(errors[errors.len() / 2] < 1.0, "median {}", errors[errors.len() / 2]);
    assert!(errors[errors.len() - 1] <= 2.0 + 1e-9, "half a scaled pixel each at this size: 4 * 0.5");
}

#[test]
fn results_do_not_depend_on_threads_or_tiles() {
    let scene = build(&SceneSpec { points: 600, clutter: 200, ..SceneSpec::default() });
    let run = |threads: usize, images_per_block: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let mut model = scene.coarse(0.2);
        let mut options = AddPointsOptions::default();
        options.blocks.images_per_block = images_per_block;
        let report = pool.install(|| densify(&scene, &mut model, &options));
        (serde_json::to_string(&model).unwrap(), report)
    };
    let one = run(1, 64);
    assert_eq!(one, run(4, 64));
    assert_eq!(one, run(1, 1));
    assert_eq!(one, run(2, 1));
}

#[test]
fn a_new_image_joins_the_points_there_are() {
    let scene = build(&SceneSpec::default());
    let mut model = scene.coarse(0.3);
    // Image 5 was registered later: it sees only a few points so far.
    let seen: Vec<_> = (0u32..).map(KeypointIdx).zip(model.images()[&ImageId(5)].points().to_vec()).collect();
    for (keypoint, point) in seen.into_iter().skip(40) {
        if let Some(point) = point {
            model.remove_observation(point, Observation { image: ImageId(5), keypoint });
        }
    }
    let before = model.images()[&ImageId(5)].num_observations();
    let tried = AtomicUsize::new(0);
    let features = |id: ImageId| scene.features[id.index()].clone();
    let new = BTreeSet::from([ImageId(5)]);
    let progress = |_: usize, total: usize| tried.store(total, Ordering::Relaxed);
    let options = AddPointsOptions::default();
    let report = add_points(&mut model, &features, Some(&new), &options, 7, &progress, &|| false).unwrap();
    assert!(report.pairs_tried <= 5 && tried.into_inner() == report.pairs_tried);
    assert!(report.points_extended > 100, "{report:?}");
    assert!(model.images()[&ImageId(5)].num_observations() > 10 * before.max(10));
    model.assert_consistent();
}

#[test]
fn cancelling_leaves_the_model_alone() {
    let scene = build(&SceneSpec { points: 300, clutter: 0, ..SceneSpec::default() });
    let mut model = scene.coarse(0.5);
    let before = serde_json::to_string(&model).unwrap();
    let features = |id: ImageId| scene.features[id.index()].clone();
    let result = add_points(&mut model, &features, None, &AddPointsOptions::default(), 7, &|_, _| {}, &|| true);
    assert_eq!(result, Err(AddPointsError::Cancelled));
    assert_eq!(serde_json::to_string(&model).unwrap(), before);
}

#[test]
fn features_that_do_not_fit_are_refused() {
    let scene = build(&SceneSpec { points: 100, clutter: 0, ..SceneSpec::default() });
    let pair = (ImageId(0), ImageId(1));
    let features = (Arc::new(Features::default()), scene.features[1].clone());
    let result = match_pair(&scene.posed, pair, features, &AddPointsOptions::default(), 7);
    assert!(matches!(result, Err(AddPointsError::FeaturesDoNotFit { image: ImageId(0), features: 0, .. })));
}

#[test]
fn default_options_are_valid_and_bad_ones_are_named() {
    let mut errors = Vec::new();
    AddPointsOptions::default().validate(&mut errors);
    assert!(errors.is_empty(), "{errors:?}");
    let mut options = AddPointsOptions::default();
    options.guided_match.band_px = f64::NAN;
    options.triangulation.min_track_length = 1;
    options.validate(&mut errors);
    assert_eq!(errors.len(), 2, "{errors:?}");
    let json = serde_json::to_string(&AddPointsOptions::default()).unwrap();
    assert_eq!(serde_json::from_str::<AddPointsOptions>(&json).unwrap(), AddPointsOptions::default());
    assert!(serde_json::from_str::<AddPointsOptions>(r#"{"guided_match": {"banana": 1}}"#).is_err());
}
