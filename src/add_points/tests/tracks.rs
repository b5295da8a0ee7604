//! Triangulation of stars and merging of tracks, on a scene with known truth.

use nalgebra::Vector3;

use crate::add_points::test_scene::{SceneSpec, TestScene, build};
use crate::add_points::*;
use crate::scene::{KeypointIdx, Observation};

#[test]
fn triangulation_is_accurate_and_survives_a_wrong_match() {
    let scene = build(&SceneSpec { clutter: 0, pixel_noise: 0.0, ..SceneSpec::default() });
    let options = AddPointsOptions::default();
    let table = views::ViewTable::new(&scene.posed, &options.triangulation, &options.pixel_scaling);
    let star_of = |track: &[views::Sighting]| {
        let link = |&seen: &views::Sighting| triangulate::Link { seen, distinctive: true };
        let links: Vec<triangulate::Link> = track[1..].iter().map(link).collect();
        triangulate::triangulate_star(&scene.posed, &table, track[0], &links)
    };
    let mut tested = 0;
    for point in 0..60 {
        let track: Vec<views::Sighting> = (0..6)
            .filter_map(|image| Some(table.sighting(&scene.observation(image, scene.keypoint_of(image, point)?))))
            .collect();
        if track.len() < 5 {
            continue;
        }
        tested += 1;
        let star = star_of(&track).unwrap();
        assert_eq!(star.sightings, track);
        assert!((star.xyz - scene.points[point]).norm() < 1e-4, "f32 keypoints");
        let mut spoiled = track.clone();
        let other = scene.keypoint_of(spoiled[2].rank as usize, point + 100).unwrap_or(0);
        spoiled[2].keypoint = KeypointIdx(other as u32);
        let star = star_of(&spoiled).unwrap();
        let expected: Vec<_> = track.iter().copied().filter(|seen| *seen != track[2]).collect();
        assert_eq!(star.sightings, expected);
        assert!((star.xyz - scene.points[point]).norm() < 1e-4);
    }
    assert!(tested > 20, "{tested}");
}

/// Builds a track update from pieces whose sightings are given as (image, point shown).
fn merged(scene: &TestScene, model: &Reconstruction, stars: &[Vec<(usize, usize)>]) -> Vec<merge::TrackUpdate> {
    let options = AddPointsOptions::default();
    let table = views::ViewTable::new(model, &options.triangulation, &options.pixel_scaling);
    let tracks: Vec<triangulate::StarTrack> = stars
        .iter()
        .map(|star| {
            let sight = |&(image, point): &(usize, usize)| {
                table.sighting(&scene.observation(image, scene.keypoint_of(image, point).unwrap()))
            };
            let mut sightings: Vec<_> = star.iter().map(sight).collect();
            let query = sightings[0];
            sightings.sort_unstable();
            triangulate::StarTrack {
                query,
                sightings,
                xyz: scene.points[star[0].1],
                distinctive: true,
                mean_relative_error_sq: 0.1,
            }
        })
        .collect();
    let mut stars = stars::StarTracks::default();
    tracks.into_iter().for_each(|track| stars.add_image(vec![track]));
    merge::merge_tracks(model, &table, &stars, &options.triangulation, &|| false).unwrap()
}

#[test]
fn two_views_alone_need_a_distinctive_match() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let p = well_seen(&scene, 0);
    let options = AddPointsOptions::default();
    let created = |images: &[u32], distinctive: bool| {
        let keypoint = |image: u32| KeypointIdx(scene.keypoint_of(image as usize, p).unwrap() as u32);
        let pairs: Vec<PairMatches> = images
            .windows(2)
            .map(|pair| PairMatches {
                first: ImageId(pair[0]),
                second: ImageId(pair[1]),
                matches: vec![KeypointMatch { first: keypoint(pair[0]), second: keypoint(pair[1]), distinctive }],
            })
            .collect();
        let (report, unconfirmed) = add_matches(&mut scene.posed.clone(), pairs, &options, &|| false).unwrap();
        (report.points_created, unconfirmed.len())
    };
    assert_eq!([created(&[0, 4], true), created(&[0, 4], false), created(&[0, 2, 4], false)], [(1, 0), (0, 1), (1, 0)]);
}

/// A point that all six images show.
fn well_seen(scene: &TestScene, rank: usize) -> usize {
    let all = |point: &usize| (0..6).all(|image| scene.keypoint_of(image, *point).is_some());
    (0..scene.points.len()).filter(all).nth(rank).unwrap()
}

#[test]
fn pieces_of_a_point_become_one() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let p = well_seen(&scene, 0);
    let updates =
        merged(&scene, &scene.posed, &[vec![(0, p), (1, p)], vec![(3, p), (4, p), (5, p)], vec![(1, p), (3, p)]]);
    let expected: Vec<Observation> =
        [0, 1, 3, 4, 5].map(|image| scene.observation(image, scene.keypoint_of(image, p).unwrap())).to_vec();
    assert_eq!(updates.len(), 1);
    assert_eq!((updates[0].extends, &updates[0].track), (None, &expected));
    assert!((updates[0].xyz - scene.points[p]).norm() < 0.03);
}

#[test]
fn a_wrong_link_does_not_fuse_two_points() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let (p, q) = (well_seen(&scene, 0), well_seen(&scene, 1));
    let stars = [vec![(0, p), (1, p), (2, p)], vec![(3, q), (4, q), (5, q)], vec![(2, p), (3, q)]];
    let mut updates = merged(&scene, &scene.posed, &stars);
    updates.sort_by_key(|update| update.track[0]);
    let lengths: Vec<usize> = updates.iter().map(|update| update.track.len()).collect();
    assert_eq!(lengths, [3, 3]);
    for (update, point) in updates.iter().zip([p, q]) {
        assert!(update.track.iter().all(|seen| scene.truth_of(seen) == Some(point)));
    }
}

#[test]
fn of_two_keypoints_in_one_image_the_better_stays() {
    let scene = build(&SceneSpec { clutter: 0, pixel_noise: 0.0, points: 5000, ..SceneSpec::default() });
    let keypoints = &scene.posed.images()[&ImageId(2)].keypoints;
    // A keypoint of image 2 within the allowance of p's, but off.
    let offset = |k: usize, l: usize| (keypoints[k].0 - keypoints[l].0).norm();
    let everywhere = |point: usize| (0..6).all(|image| scene.keypoint_of(image, point).is_some());
    let pairs = (0..keypoints.len()).flat_map(|k| (0..k).map(move |l| (k, l)));
    let near = pairs.filter(|&(k, l)| (0.3..1.9).contains(&offset(k, l)));
    let (p, q) = near
        .filter_map(|(k, l)| Some((scene.truth[2][k]?, scene.truth[2][l]?)))
        .find(|&(p, _)| everywhere(p))
        .expect("among so many points some are close");
    let updates = merged(
        &scene,
        &scene.posed,
        &[vec![(0, p), (1, p), (2, q)], vec![(3, p), (4, p), (2, p)], vec![(0, p), (3, p)]],
    );
    assert_eq!(updates.len(), 1);
    assert_eq!(updates[0].track.len(), 5);
    assert!(updates[0].track.iter().all(|seen| scene.truth_of(seen) == Some(p)));
}

#[test]
fn points_of_the_model_are_extended_and_joined() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let p = well_seen(&scene, 0);
    let seen = |image: usize| scene.observation(image, scene.keypoint_of(image, p).unwrap());
    let mut model = scene.posed.clone();
    let long = model.add_point(scene.points[p], vec![seen(2), seen(3), seen(5)], [1; 3]);
    let short = model.add_point(scene.points[p] + Vector3::new(0.001, 0.0, 0.0), vec![seen(0), seen(1)], [2; 3]);
    let updates = merged(&scene, &model, &[vec![(1, p), (2, p)], vec![(4, p), (5, p)]]);
    assert_eq!(updates.len(), 1);
    assert_eq!((updates[0].extends, &updates[0].absorbs), (Some(long), &vec![short]));
    let counts = merge::apply_updates(&mut model, updates);
    assert_eq!((counts.created, counts.extended, counts.absorbed), (0, 1, 1));
    model.assert_consistent();
    assert_eq!((model.num_points(), model.point(long).unwrap().track.len()), (1, 6));
    assert_eq!(model.point(long).unwrap().color, [1; 3]);
}

#[test]
fn two_rays_at_a_tiny_angle_make_no_point() {
    let scene = build(&SceneSpec { clutter: 0, ..SceneSpec::default() });
    let p = well_seen(&scene, 0);
    let mut model = Reconstruction::new(scene.posed.cameras.clone());
    for (&id, image) in scene.posed.images() {
        // Cameras 0 and 1 a hair apart.
        let pose =
            if id == ImageId(1) { scene.posed.images()[&ImageId(0)].cam_from_world } else { image.cam_from_world };
        model.register(id, image.camera, pose, image.keypoints.clone());
    }
    assert!(merged(&scene, &model, &[vec![(0, p), (1, p)]]).is_empty());
}
