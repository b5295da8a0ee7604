//! The mapper on scenes whose truth is known: images of one size, without EXIF, that were zoomed.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Mutex;
use std::sync::atomic::{AtomicUsize, Ordering};

use super::*;
use crate::camera::{CameraModel, FocalSource};
use crate::coarse::{IntrinsicsOptions, focal_priors};
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
        let models = reconstruct(&input, &MapperOptions::default(), &MapperRun::undisturbed(1));
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
        let models = reconstruct(&input, &MapperOptions::default(), &MapperRun::undisturbed(1));
        let model = &models.models[0];
        assert_eq!(model.images().len(), 16, "{layout:?}");
        let used: BTreeSet<CameraId> = model.images().values().map(|image| image.camera).collect();
        assert_eq!(used.len(), 1, "{layout:?}: {:?}", focals_px(model));
    }
}

#[test]
fn only_focal_lengths_that_nothing_tells_have_a_prior() {
    let camera = |source| Camera::centered(CameraModel::SimpleRadial, 1000, 800, 700.0, source);
    let sources = [FocalSource::Guess, FocalSource::Exif, FocalSource::Estimated, FocalSource::Known];
    let cameras = (0..).map(CameraId).zip(sources.map(camera)).collect();
    let options = IntrinsicsOptions::default();
    let priors = focal_priors(&Reconstruction::new(cameras), &options);
    assert_eq!(priors.keys().collect::<Vec<_>>(), [&CameraId(0), &CameraId(2)]);
    assert!(priors.values().all(|prior| prior.focal_px == 1200.0));
    let none = IntrinsicsOptions { typical_focal_sigma_log: None, ..options };
    assert_eq!(focal_priors(&Reconstruction::new([(CameraId(0), camera(FocalSource::Guess))].into()), &none).len(), 0);
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
    let models = reconstruct(&input, &mapper, &MapperRun::undisturbed(1));
    assert_eq!(models.models[0].images().len(), 15);
    assert!(matches!(models.unregistered[&weak], Unregistered::PoseFailed { .. }), "{:?}", models.unregistered);
}

#[test]
fn two_images_that_match_each_other_alone_are_too_few() {
    let options = SceneOptions { num_images: 4, num_points: 500, ..SceneOptions::default() };
    let mut input = without_exif(&generate(&options), &options, options.focal_px);
    input.graph.pairs.retain(|&pair, _| pair == (ImageId(0), ImageId(1)));
    let models = reconstruct(&input, &MapperOptions::default(), &MapperRun::undisturbed(1));
    assert!(models.models.is_empty());
    let two = Unregistered::TooFewTogether { images: 2 };
    let why = [two.clone(), two, Unregistered::NoPairs, Unregistered::NoPairs];
    assert_eq!(models.unregistered, (0..4).map(ImageId).zip(why).collect());
}

/// An image with a repeated pattern: it seems to see a few points of the model as another image does, while a strong
/// pair says that it was turned away from there.
#[test]
fn a_pose_that_strong_pairs_contradict_is_not_taken() {
    let options = SceneOptions { num_images: 16, num_points: 1500, pixel_noise_px: 0.5, ..SceneOptions::default() };
    let scene = generate(&options);
    let mut input = without_exif(&scene, &options, options.focal_px);
    let (first, copied, image) = (ImageId(0), ImageId(8), ImageId(15));
    input.graph.pairs.retain(|&(_, b), _| b != image);
    let mut copy = input.images[&copied].clone();
    for other in (5..8).map(ImageId) {
        let mut geometry = input.graph.pairs[&(other, copied)].clone();
        geometry.inliers.truncate(20);
        input.graph.pairs.insert((other, image), geometry);
    }
    // Keypoints of their own for the strong pair.
    let mut rng = Rng::from_parts(&[3]);
    let mut further = |keypoints: &mut Arc<[Pixel]>| {
        let start = keypoints.len() as u32;
        let more = (0..300).map(|_| Pixel::new(rng.range(0.0, 1000.0), rng.range(0.0, 700.0)));
        *keypoints = keypoints.iter().copied().chain(more).collect();
        (start..start + 300).map(crate::scene::KeypointIdx).collect::<Vec<_>>()
    };
    let in_first = further(&mut input.images.get_mut(&first).unwrap().keypoints);
    let in_copy = further(&mut copy.keypoints);
    input.images.insert(image, copy);
    let mut strong = input.graph.pairs[&(first, ImageId(1))].clone();
    strong.inliers = in_first.into_iter().zip(in_copy).collect();
    strong.b_from_a = Some(crate::geometry::Rigid3::identity());
    input.graph.pairs.insert((first, image), strong);

    let mut mapper = MapperOptions::default();
    let models = reconstruct(&input, &mapper, &MapperRun::undisturbed(1));
    assert_eq!(models.models[0].images().len(), 15);
    let why = &models.unregistered[&image];
    assert!(matches!(why, Unregistered::TurnedOtherwise { inliers: 30..=60, .. }), "{why:?}");
    mapper.rotation_cycles.enabled = false;
    let taken = reconstruct(&input, &mapper, &MapperRun::undisturbed(1));
    assert_eq!(taken.models[0].images().len(), 16, "the test can fail");
}

/// Keeps the bytes of every checkpoint, and says when it is enough.
#[derive(Default)]
struct Kept {
    begun: AtomicUsize,
    last: Mutex<BTreeMap<usize, Vec<u8>>>,
    num_kept: AtomicUsize,
}

impl Checkpoints for Kept {
    fn begin(&self) -> Option<Checkpoint<'static>> {
        let model = self.begun.fetch_add(1, Ordering::SeqCst) + 1;
        self.last.lock().unwrap().get(&model).map(|bytes| postcard::from_bytes(bytes).unwrap())
    }

    fn keep(&self, checkpoint: &Checkpoint<'_>) {
        let bytes = postcard::to_stdvec(checkpoint).unwrap();
        self.last.lock().unwrap().insert(self.begun.load(Ordering::SeqCst), bytes);
        self.num_kept.fetch_add(1, Ordering::SeqCst);
    }
}

/// Two scenes without a common point, so that there are two models, of two zooms each: wherever a reconstruction is
/// stopped, going on from what was kept gives the same models to the last bit.
#[test]
fn a_stopped_reconstruction_goes_on_from_what_was_kept() {
    let options = SceneOptions { num_images: 12, num_points: 600, zoom: 1.3, ..SceneOptions::default() };
    let scene = generate(&options);
    let mut input = without_exif(&scene, &options, options.focal_px);
    let moved = |id: ImageId| ImageId(id.0 + 100);
    let images: Vec<_> = input.images.iter().map(|(&id, image)| (moved(id), image.clone())).collect();
    input.images.extend(images);
    let pairs: Vec<_> = input.graph.pairs.iter().map(|(&(a, b), pair)| ((moved(a), moved(b)), pair.clone())).collect();
    input.graph.pairs.extend(pairs);

    let mapper = MapperOptions::default();
    let all = Kept::default();
    let run = MapperRun { checkpoints: &all, ..MapperRun::undisturbed(1) };
    let bytes = |models: &CoarseModels| postcard::to_stdvec(models).unwrap();
    let whole = reconstruct(&input, &mapper, &run);
    assert_eq!(whole.models.len(), 2);
    let num_kept = all.num_kept.load(Ordering::SeqCst);
    assert!(num_kept > 6, "{num_kept}");
    for enough in 1..=num_kept {
        let kept = Kept::default();
        let keep_going = || kept.num_kept.load(Ordering::SeqCst) < enough;
        reconstruct(&input, &mapper, &MapperRun { keep_going: &keep_going, checkpoints: &kept, ..run });
        kept.begun.store(0, Ordering::SeqCst);
        let placed = AtomicUsize::new(usize::MAX);
        let progress = |registered: usize| {
            placed.fetch_min(registered, Ordering::SeqCst);
        };
        let after = reconstruct(&input, &mapper, &MapperRun { progress: &progress, checkpoints: &kept, ..run });
        assert!(placed.load(Ordering::SeqCst) > 2, "stopped after {enough}: begins anew");
        assert!(bytes(&after) == bytes(&whole), "stopped after {enough} of {num_kept}: another model");
    }
}
