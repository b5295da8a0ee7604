//! The mapper on scenes whose truth is known: images of one size, without EXIF, that were zoomed.

use std::collections::{BTreeMap, BTreeSet};

use super::*;
use crate::camera::{CameraModel, FocalSource};
use crate::matching::two_view::{self, TwoViewOptions};
use crate::math::Rng;
use crate::synthetic::{Layout, SceneOptions, SyntheticScene, generate};

/// What the mapper is told of a scene when nothing is known of its cameras but their size: one camera for all, with a guess
/// of its focal length.
fn without_exif(scene: &SyntheticScene, options: &SceneOptions, guess_px: f64) -> MapperInput {
    let camera =
        Camera::centered(CameraModel::SimpleRadial, options.width, options.height, guess_px, FocalSource::Guess);
    let trusted = Camera { focal_source: FocalSource::Estimated, ..camera.clone() };
    let images: BTreeMap<ImageId, MapperImage> = scene
        .truth
        .images()
        .iter()
        .map(|(&id, image)| (id, MapperImage { camera: CameraId(0), keypoints: image.keypoints.clone() }))
        .collect();
    let mut graph = MatchGraph::default();
    for (&(a, b), matches) in &scene.matches {
        let mut rng = Rng::from_parts(&[u64::from(a.0), u64::from(b.0)]);
        let (in_a, in_b) = (&images[&a].keypoints, &images[&b].keypoints);
        let two_view = TwoViewOptions::default();
        let Some(mut geometry) = two_view::verify(in_a, in_b, matches, &camera, &camera, &two_view, &mut rng) else {
            continue;
        };
        let calibrated = two_view::verify(in_a, in_b, &geometry.inliers, &trusted, &trusted, &two_view, &mut rng);
        if let Some(calibrated) = calibrated {
            geometry = two_view::TwoViewGeometry { inliers: geometry.inliers, ..calibrated };
        }
        graph.pairs.insert((a, b), geometry);
    }
    MapperInput { images, cameras: [(CameraId(0), camera)].into(), graph, apart: Default::default() }
}

/// The focal lengths of the cameras in use, of the images with even and of those with odd numbers.
fn focals_px(model: &Reconstruction) -> [BTreeMap<CameraId, f64>; 2] {
    [0, 1].map(|parity| {
        let images = model.images().iter().filter(|(id, _)| id.0 % 2 == parity);
        images.map(|(_, image)| (image.camera, model.cameras[&image.camera].mean_focal_px())).collect()
    })
}

#[test]
fn zoomed_images_get_a_camera_of_their_own() {
    for (layout, zoom) in [(Layout::Orbit, 1.3), (Layout::Facade, 0.75), (Layout::Facade, 1.2)] {
        let options = SceneOptions {
            layout,
            zoom,
            num_images: 16,
            num_points: 1500,
            pixel_noise_px: 0.5,
            outlier_ratio: 0.1,
            ..SceneOptions::default()
        };
        let scene = generate(&options);
        let input = without_exif(&scene, &options, 1.04 * options.focal_px);
        let models = reconstruct(&input, &MapperOptions::default(), 1, &|| true, &|_| ());
        let model = &models.models[0];
        assert_eq!(model.images().len(), 16, "{layout:?} {zoom}");
        let found = focals_px(model);
        for (focals, truth_px) in found.iter().zip([options.focal_px, zoom * options.focal_px]) {
            assert_eq!(focals.len(), 1, "{layout:?} {zoom}: one camera a zoom, not {found:?}");
            let focal_px = focals.values().next().unwrap();
            assert!((focal_px / truth_px - 1.0).abs() < 0.02, "{layout:?} {zoom}: {found:?}");
        }
    }
}

#[test]
fn images_of_one_zoom_share_one_camera() {
    for layout in [Layout::Orbit, Layout::Facade, Layout::Street] {
        let options = SceneOptions {
            layout,
            num_images: 16,
            num_points: 1500,
            pixel_noise_px: 0.7,
            outlier_ratio: 0.1,
            ..SceneOptions::default()
        };
        let scene = generate(&options);
        let input = without_exif(&scene, &options, 1.2 * options.focal_px);
        let models = reconstruct(&input, &MapperOptions::default(), 1, &|| true, &|_| ());
        let model = &models.models[0];
        assert_eq!(model.images().len(), 16, "{layout:?}");
        let used: BTreeSet<CameraId> = model.images().values().map(|image| image.camera).collect();
        assert_eq!(used.len(), 1, "{layout:?}: {:?}", focals_px(model));
    }
}

/// An image whose pose is found every time and that every adjustment takes out again: it is given up and the rest stands.
#[test]
fn an_image_that_never_holds_is_given_up() {
    let options = SceneOptions { num_images: 16, num_points: 1500, pixel_noise_px: 0.5, ..SceneOptions::default() };
    let mut scene = generate(&options);
    let weak = *scene.truth.images().keys().last().unwrap();
    for (&(a, b), matches) in &mut scene.matches {
        matches.retain(|found| (a != weak || found.0.0 < 40) && (b != weak || found.1.0 < 40));
    }
    let input = without_exif(&scene, &options, options.focal_px);
    let mapper = MapperOptions { min_pose_inliers_relaxed: 60, ..MapperOptions::default() };
    let models = reconstruct(&input, &mapper, 1, &|| true, &|_| ());
    assert_eq!(models.models[0].images().len(), 15);
    assert!(matches!(models.unregistered[&weak], Unregistered::PoseFailed { .. }), "{:?}", models.unregistered);
}
