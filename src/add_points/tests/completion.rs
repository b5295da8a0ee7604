//! Further sightings of points of two, on a scene with known truth.

use crate::add_points::completion::{Completer, CompletionOptions};
use crate::add_points::test_scene::{SceneSpec, TestScene, build};
use crate::add_points::*;
use crate::scene::Point3dId;

fn complete(
    scene: &TestScene,
    model: &mut Reconstruction,
    unconfirmed: &[PairOfSightings],
    cancelled: &Cancelled,
) -> Result<Vec<Point3dId>, AddPointsError> {
    let features = |id: ImageId| scene.features[id.index()].clone();
    let (completion, options) = (CompletionOptions::default(), AddPointsOptions::default());
    Completer { features: &features, completion: &completion, options: &options, cancelled }.run(model, unconfirmed)
}

/// A model of points that many images see, of which every second one has lost all sightings but the last two, and the ids of
/// these.
fn with_short_tracks(scene: &TestScene) -> (Reconstruction, Vec<Point3dId>) {
    let mut model = scene.coarse(1.0);
    let long: Vec<Point3dId> = model.points().filter(|(_, point)| point.track.len() >= 4).map(|(id, _)| id).collect();
    let cut: Vec<Point3dId> = long.into_iter().step_by(2).collect();
    for &id in &cut {
        let track = model.point(id).unwrap().track.clone();
        for &seen in &track[..track.len() - 2] {
            model.remove_observation(id, seen);
        }
    }
    (model, cut)
}

fn assert_tracks_are_true(scene: &TestScene, model: &Reconstruction, points: &[Point3dId]) {
    let true_track = |id: &&Point3dId| {
        let track = &model.point(**id).unwrap().track;
        let shown = scene.truth_of(&track[0]);
        shown.is_some() && track.iter().all(|seen| scene.truth_of(seen) == shown)
    };
    let right = points.iter().filter(true_track).count();
    assert!(right as f64 >= 0.99 * points.len() as f64, "{right} of {}", points.len());
}

#[test]
fn points_of_two_are_found_where_they_project_to() {
    let scene = build(&SceneSpec::default());
    let (mut model, cut) = with_short_tracks(&scene);
    let before = model.num_points();
    let completed = complete(&scene, &mut model, &[], &|| false).unwrap();
    model.assert_consistent();
    assert_eq!(model.num_points(), before);
    let found = cut.iter().filter(|id| model.point(**id).unwrap().track.len() >= 4).count();
    assert!(cut.len() > 400 && found as f64 > 0.98 * cut.len() as f64, "{found} of {}", cut.len());
    assert_tracks_are_true(&scene, &model, &completed);
}

/// What looks otherwise is another thing, however near it lies.
#[test]
fn a_place_alone_is_no_sighting() {
    let scene = build(&SceneSpec { descriptor_noise: 60.0, ..SceneSpec::default() });
    let (mut model, _) = with_short_tracks(&scene);
    assert_eq!(complete(&scene, &mut model, &[], &|| false).unwrap(), []);
}

#[test]
fn an_unconfirmed_match_becomes_a_point_where_a_third_image_sees_it() {
    let scene = build(&SceneSpec::default());
    let everywhere = |point: &usize| (0..6).all(|image| scene.keypoint_of(image, *point).is_some());
    let shown: Vec<usize> = (0..scene.points.len()).filter(everywhere).collect();
    let (known, new) = shown.split_at(shown.len() / 2);
    let seen = |image: usize, point: usize| scene.observation(image, scene.keypoint_of(image, point).unwrap());
    let mut model = scene.posed.clone();
    for &point in known {
        model.add_point(scene.points[point], (0..6).map(|image| seen(image, point)).collect(), [0; 3]);
    }
    let right: Vec<PairOfSightings> = new.iter().map(|&point| [seen(0, point), seen(5, point)]).collect();
    // Two points: their rays do not meet, or they meet where no other image has anything.
    let wrong = new.windows(2).map(|two| [seen(0, two[0]), seen(5, two[1])]);
    let taken = known.iter().map(|&point| [seen(0, point), seen(5, point)]);
    let unconfirmed: Vec<PairOfSightings> = wrong.chain(taken).chain(right.iter().copied()).collect();
    let completed = complete(&scene, &mut model, &unconfirmed, &|| false).unwrap();
    model.assert_consistent();
    assert_eq!(model.num_points(), known.len() + completed.len(), "what nobody else sees is no point");
    assert!(completed.len() as f64 > 0.95 * new.len() as f64, "{} of {}", completed.len(), new.len());
    assert_tracks_are_true(&scene, &model, &completed);
}

#[test]
fn images_apart_share_no_point() {
    let scene = build(&SceneSpec::default());
    let (mut model, _) = with_short_tracks(&scene);
    model.apart = (1..6).map(|other| (ImageId(0), ImageId(other))).collect();
    let of_first: Vec<Point3dId> =
        model.points().filter(|(_, p)| p.track.iter().any(|seen| seen.image == ImageId(0))).map(|(id, _)| id).collect();
    of_first.iter().for_each(|&id| model.remove_point(id));
    let completed = complete(&scene, &mut model, &[], &|| false).unwrap();
    model.assert_consistent();
    assert!(!completed.is_empty());
    assert_eq!(model.images()[&ImageId(0)].num_observations(), 0);
}

#[test]
fn the_number_of_threads_does_not_show() {
    let scene = build(&SceneSpec::default());
    let with = |threads: usize| {
        let (mut model, _) = with_short_tracks(&scene);
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        let completed = pool.install(|| complete(&scene, &mut model, &[], &|| false)).unwrap();
        (completed, serde_json::to_string(&model.points().map(|(_, point)| point.clone()).collect::<Vec<_>>()).unwrap())
    };
    assert_eq!(with(1), with(3));
}

#[test]
fn it_can_be_stopped() {
    let scene = build(&SceneSpec::default());
    let (mut model, _) = with_short_tracks(&scene);
    assert_eq!(complete(&scene, &mut model, &[], &|| true), Err(AddPointsError::Cancelled));
}
