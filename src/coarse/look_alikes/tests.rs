//! Synthetic worlds whose things exist twice: the check must keep the copies apart, and leave worlds without copies alone.

use std::collections::{BTreeMap, BTreeSet};
use std::f64::consts::{PI, TAU};

use nalgebra::{Matrix3, Vector3};

use super::*;
use crate::camera::{Camera, CameraModel, FocalSource, Pixel};
use crate::coarse::MapperImage;
use crate::geometry::Rigid3;
use crate::matching::two_view::{TwoViewConfig, TwoViewGeometry, TwoViewOptions, verify};
use crate::math::Rng;
use crate::scene::{CameraId, KeypointIdx, Observation};

/// Photographs of one camera with these keypoints and inliers, of whose geometry nothing else is known.
pub(super) fn matched_input(
    (width, height): (u32, u32),
    keypoints: Vec<Vec<Pixel>>,
    pairs: impl IntoIterator<Item = ((ImageId, ImageId), Vec<(KeypointIdx, KeypointIdx)>)>,
) -> MapperInput {
    let geometry = |inliers| TwoViewGeometry {
        config: TwoViewConfig::Planar,
        inliers,
        fundamental: None,
        essential: None,
        homography: None,
        b_from_a: None,
        median_triangulation_angle_rad: None,
        num_e_inliers: 0,
        num_f_inliers: 0,
        num_h_inliers: 0,
    };
    let camera = Camera::centered(CameraModel::SimpleRadial, width, height, 900.0, FocalSource::Exif);
    let images = (0..).map(ImageId).zip(keypoints);
    MapperInput {
        images: images.map(|(id, at)| (id, MapperImage { camera: CameraId(0), keypoints: at.into() })).collect(),
        cameras: BTreeMap::from([(CameraId(0), camera)]),
        graph: MatchGraph { pairs: pairs.into_iter().map(|(pair, inliers)| (pair, geometry(inliers))).collect() },
        apart: ApartImages::default(),
    }
}

/// A surface point; those of one look can't be told apart.
struct SurfacePoint {
    xyz: Vector3<f64>,
    normal: Vector3<f64>,
    look: usize,
}

/// Photographs of a world, and which point each keypoint shows.
struct World {
    input: MapperInput,
    shown: BTreeMap<ImageId, Vec<usize>>,
}

/// Cosine, to the normal, of the steepest view under which a point is detected.
const GRAZING_COSINE: f64 = 0.5;
const DETECTION_RATIO: f64 = 0.85;
const NOISE_PX: f64 = 0.4;

fn look_at(center: Vector3<f64>, target: Vector3<f64>) -> Rigid3 {
    let forward = (target - center).normalize();
    let right = forward.cross(&Vector3::z()).normalize();
    let axes = Matrix3::from_rows(&[right.transpose(), forward.cross(&right).transpose(), forward.transpose()]);
    Rigid3::from_center(Rigid3::from_matrix(&axes, Vector3::zeros()).rotation, &center)
}

impl World {
    /// Photographs the points from every pose and matches keypoints of one look, where a picture shows it only once.
    fn photograph(points: &[SurfacePoint], poses: &[Rigid3], rng: &mut Rng) -> Self {
        let camera = Camera::centered(CameraModel::SimpleRadial, 1000, 800, 900.0, FocalSource::Exif);
        let (mut images, mut shown) = (BTreeMap::new(), BTreeMap::new());
        for (id, pose) in (0u32..).map(ImageId).zip(poses) {
            let (mut keypoints, mut ids) = (Vec::new(), Vec::new());
            for (at, point) in points.iter().enumerate() {
                let to_camera = (pose.target_origin_in_source() - point.xyz).normalize();
                let Some(exact) = camera.project(&pose.apply(&point.xyz)) else { continue };
                let inside = (0.0..1000.0).contains(&exact.0.x) && (0.0..800.0).contains(&exact.0.y);
                if inside && to_camera.dot(&point.normal) > GRAZING_COSINE && rng.uniform() < DETECTION_RATIO {
                    let noisy = |at: f64, rng: &mut Rng| at + NOISE_PX * rng.normal();
                    keypoints.push(Pixel::new(noisy(exact.0.x, rng), noisy(exact.0.y, rng)));
                    ids.push(at);
                }
            }
            images.insert(id, MapperImage { camera: CameraId(0), keypoints: keypoints.into() });
            shown.insert(id, ids);
        }
        let by_look: BTreeMap<ImageId, BTreeMap<usize, Vec<KeypointIdx>>> = shown
            .iter()
            .map(|(&id, ids)| {
                let mut by_look: BTreeMap<usize, Vec<KeypointIdx>> = BTreeMap::new();
                for (keypoint, &point) in (0u32..).map(KeypointIdx).zip(ids) {
                    by_look.entry(points[point].look).or_default().push(keypoint);
                }
                (id, by_look)
            })
            .collect();
        let mut graph = MatchGraph::default();
        for (&a, looks_a) in &by_look {
            for (&b, looks_b) in by_look.range(ImageId(a.0 + 1)..) {
                let matches: Vec<(KeypointIdx, KeypointIdx)> = looks_a
                    .iter()
                    .filter_map(|(look, in_a)| match (&in_a[..], looks_b.get(look).map(Vec::as_slice)) {
                        (&[in_a], Some(&[in_b])) => Some((in_a, in_b)),
                        _ => None,
                    })
                    .collect();
                let (pixels_a, pixels_b) = (&images[&a].keypoints, &images[&b].keypoints);
                let options = TwoViewOptions::default();
                if let Some(found) = verify(pixels_a, pixels_b, &matches, &camera, &camera, &options, rng) {
                    graph.pairs.insert((a, b), found);
                }
            }
        }
        let cameras = BTreeMap::from([(CameraId(0), camera)]);
        Self { input: MapperInput { images, cameras, graph, apart: ApartImages::default() }, shown }
    }

    fn reconstruct(&self, enabled: bool) -> (CoarseModels, LookAlikeAccount) {
        let options = LookAlikeOptions { enabled, ..LookAlikeOptions::default() };
        reconstruct(&self.input, &options, &MapperOptions::default(), &MapperRun::undisturbed(0))
    }

    /// Points of all models that join sightings of different points of the world.
    fn folded(&self, models: &CoarseModels) -> usize {
        let shows = |seen: &Observation| self.shown[&seen.image][seen.keypoint.index()];
        let tracks = models.models.iter().flat_map(|model| model.points().map(|(_, point)| &point.track));
        tracks.filter(|track| track.iter().map(shows).collect::<BTreeSet<_>>().len() > 1).count()
    }

    /// Whether at least a third of the matches of a pair joins different points of the world.
    fn is_wrong(&self, (a, b): (ImageId, ImageId)) -> bool {
        let matches = &self.input.graph.pairs[&(a, b)].inliers;
        let right =
            |(in_a, in_b): &(KeypointIdx, KeypointIdx)| self.shown[&a][in_a.index()] == self.shown[&b][in_b.index()];
        3 * matches.iter().filter(|pair| !right(pair)).count() >= matches.len()
    }
}

/// A walk past a wall on which a house of 4 units stands at each of `houses`, all of one look; before wall and houses stand
/// things that exist once.
fn street(houses: &[f64]) -> World {
    let mut rng = Rng::from_parts(&[11]);
    let length = 24.0;
    let normal = -Vector3::y();
    let mut points: Vec<SurfacePoint> = Vec::new();
    for look in 0..140 {
        let at = Vector3::new(rng.range(-2.0, 2.0), rng.range(-0.4, 0.0), rng.range(0.0, 3.5));
        let copies = houses.iter().map(|&x| SurfacePoint { xyz: at + Vector3::new(x, 0.0, 0.0), normal, look });
        points.extend(copies);
    }
    for look in 140..1600 {
        let xyz = Vector3::new(rng.range(-3.0, length + 3.0), rng.range(-1.0, 0.5), rng.range(0.0, 4.0));
        let hidden = xyz.y > -0.4 && houses.iter().any(|house| (xyz.x - house).abs() < 2.0);
        if !hidden {
            points.push(SurfacePoint { xyz, normal, look });
        }
    }
    let poses: Vec<Rigid3> = (0..25)
        .map(|at| {
            let (x, sway) = (length * f64::from(at) / 24.0, 0.3 * rng.normal());
            look_at(Vector3::new(x, -5.0 + sway, 1.6), Vector3::new(x + 0.2 * rng.normal(), 0.0, 2.0))
        })
        .collect();
    World::photograph(&points, &poses, &mut rng)
}

/// A walk round a building whose fronts repeat `symmetry` times, with things that exist once around it.
fn ring(symmetry: usize) -> World {
    let mut rng = Rng::from_parts(&[12]);
    let mut points: Vec<SurfacePoint> = Vec::new();
    for look in 0..(900 / symmetry) {
        let (angle, radius, z) = (rng.range(0.0, TAU / symmetry as f64), rng.range(1.8, 2.2), rng.range(0.0, 3.0));
        for front in 0..symmetry {
            let angle = angle + TAU * front as f64 / symmetry as f64;
            let normal = Vector3::new(angle.cos(), angle.sin(), 0.0);
            points.push(SurfacePoint { xyz: normal * radius + Vector3::new(0.0, 0.0, z), normal, look });
        }
    }
    for look in 900..1500 {
        let (angle, radius, facing) = (rng.range(0.0, TAU), rng.range(2.4, 3.6), rng.range(-0.6, 0.6));
        let xyz = Vector3::new(radius * angle.cos(), radius * angle.sin(), rng.range(0.0, 1.5));
        let normal = Vector3::new((angle + facing).cos(), (angle + facing).sin(), 0.0);
        points.push(SurfacePoint { xyz, normal, look });
    }
    let poses: Vec<Rigid3> = (0..36)
        .map(|at| {
            let angle = 2.0 * PI * f64::from(at) / 36.0 + 0.02 * rng.normal();
            let radius = 8.0 + 0.2 * rng.normal();
            look_at(Vector3::new(radius * angle.cos(), radius * angle.sin(), 1.6), Vector3::new(0.0, 0.0, 1.4))
        })
        .collect();
    World::photograph(&points, &poses, &mut rng)
}

fn assert_kept_apart(world: &World) {
    let (naive, _) = world.reconstruct(false);
    assert!(world.folded(&naive) > 20, "the world must be able to fool: {}", world.folded(&naive));
    let (models, account) = world.reconstruct(true);
    // What the model could not judge is cut on suspicion, so a few true pairs of very wide baseline may go; what it judged
    // must be wrong.
    let cut_wrongly: Vec<&CutPair> = account.cut.iter().filter(|cut| !world.is_wrong(cut.images)).collect();
    assert!(cut_wrongly.iter().all(|cut| cut.displacement.is_none()), "{cut_wrongly:?}");
    assert!(20 * cut_wrongly.len() <= account.cut.len(), "{cut_wrongly:?} of {}", account.cut.len());
    assert!(!account.cut.is_empty());
    assert_eq!(models.models[0].images().len(), world.input.images.len());
    assert_eq!(world.folded(&models), 0);
    models.models[0].assert_consistent();
}

#[test]
fn two_equal_houses_along_a_street_stay_two() {
    assert_kept_apart(&street(&[4.0, 18.0]));
}

#[test]
fn three_equal_houses_along_a_street_stay_three() {
    assert_kept_apart(&street(&[3.0, 12.0, 21.0]));
}

#[test]
fn a_building_of_two_equal_halves_keeps_both() {
    assert_kept_apart(&ring(2));
}

#[test]
fn a_walk_that_comes_back_keeps_every_pair() {
    let world = ring(1);
    let (models, account) = world.reconstruct(true);
    assert_eq!(account.cut, []);
    assert_eq!(models.models[0].images().len(), world.input.images.len());
    assert!(world.input.graph.pairs.contains_key(&(ImageId(0), ImageId(35))), "the walk must come back");
}

#[test]
fn a_cut_pair_shares_a_place_only_when_enough_of_its_matches_do() {
    let suspect = Suspect {
        images: (ImageId(0), ImageId(1)),
        matches: 200,
        known: 100,
        agreeing: 0,
        strength: 0.1,
        chain_strength: 0.5,
    };
    let options = LookAlikeOptions::default();
    let (few, many) = (options.min_shared_place_matches - 1, options.min_shared_place_matches);
    for (coinciding, judged, apart) in [(few, 20, true), (many, 20, false), (many, 200, true)] {
        let verdict = Verdict::Apart { displacement: 0.7, coinciding, judged };
        let cut = cut_pairs(std::slice::from_ref(&suspect), &[verdict], &options);
        assert_eq!(cut[0].apart, apart, "{coinciding} of {judged}");
    }
}
