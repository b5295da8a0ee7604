//! Which matches of a sweep are mutual, by their definition.

use nalgebra::Vector2;

use super::one_behind_the_other;
use crate::add_points::epipolar::EpipolarGeometry;
use crate::add_points::one_way::OneWay;
use crate::add_points::pair_matcher::prepare;
use crate::add_points::prepared::PreparedImage;
use crate::add_points::test_scene::{SceneSpec, build};
use crate::add_points::*;
use crate::matching::descriptor::distance_sq;
use crate::math::Rng;

/// Two cameras side by side, and one behind the other with both epipoles in their images. Every third query is not asked, but
/// competes.
#[test]
fn a_match_is_mutual_when_no_other_query_is_nearer_to_its_target() {
    let scene = build(&SceneSpec::default());
    let options = AddPointsOptions::default();
    let model = one_behind_the_other(&scene);
    let prepared =
        |image: u32| prepare(&model, ImageId(image), scene.features[image as usize].clone(), &options).unwrap();
    for (a, b) in [(0, 5), (2, 3)] {
        let (first, second) = (prepared(a), prepared(b));
        let of = |image: &PreparedImage| (image.camera.clone(), image.cam_from_world);
        let ((camera_a, pose_a), (camera_b, pose_b)) = (of(&first), of(&second));
        let geometry = EpipolarGeometry::new((&camera_a, &pose_a), (&camera_b, &pose_b)).unwrap();
        let search = OneWay {
            query: &first,
            target: &second,
            geometry: &geometry,
            options: &options.guided_match,
            check_ratio: false,
        };
        let is_open = |query: u32| !query.is_multiple_of(3);
        let found = search.run_mutual(is_open, Rng::from_parts(&[1]));
        let found: Vec<(u32, u32)> = found.into_iter().map(|found| (found.query, found.target)).collect();

        let GuidedMatchOptions { band_px, epipole_clearance_bands, .. } = options.guided_match;
        let homogeneous = geometry.epipole_in_target();
        let epipoles = [geometry.epipole_in_query(), Some(homogeneous.xy() / homogeneous.z)];
        let is_clear = |image: &PreparedImage, epipole: Option<Vector2<f64>>, feature: u32| {
            let least_px = epipole_clearance_bands * band_px * image.px_scale;
            epipole.is_none_or(|epipole| (image.finder.positions()[feature as usize] - epipole).norm() >= least_px)
        };
        let members = |image: &PreparedImage| image.finder.members().to_vec();
        let queries: Vec<u32> = members(&first).into_iter().filter(|&q| is_clear(&first, epipoles[0], q)).collect();
        let distance = |q: u32, t: u32| {
            let line = geometry.line_in_target(&first.normalized[q as usize])?;
            let is_near = line.distance_px(&second.finder.positions()[t as usize]) <= band_px * second.px_scale;
            let (a, b) = (&first.features.descriptors[q as usize], &second.features.descriptors[t as usize]);
            is_near.then(|| distance_sq(a, b))
        };
        let nearest = |of: &[u32], distance: &dyn Fn(u32) -> Option<u32>| {
            of.iter().filter_map(|&at| Some((distance(at)?, at))).min().map(|(_, at)| at)
        };
        let targets = members(&second);
        let expected: Vec<(u32, u32)> = queries
            .iter()
            .filter_map(|&q| Some((q, nearest(&targets, &|t| distance(q, t))?)))
            .filter(|&(q, t)| nearest(&queries, &|other| distance(other, t)) == Some(q))
            .filter(|&(q, t)| is_open(q) && is_clear(&second, epipoles[1], t))
            .collect();
        assert!(expected.len() > 150, "{a}-{b}: {}", expected.len());
        assert_eq!(found, expected, "{a}-{b}");
    }
}
