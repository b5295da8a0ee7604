//! Relative rotations of pairs as a check on weaker ones. Repeated texture (tiles, boards, lamellas) gives pairs that
//! agree in a few tens of matches and are wrong; their baselines look wide, so a model would even start from them. And
//! it gives poses that agree with a few tens of points and are wrong.
//!
//! Along a closed chain of pairs the relative rotations multiply to the identity (Zach, Klopschitz, Pollefeys,
//! "Disambiguating visual relations using loop constraints", CVPR 2010). The chain to hold a pair or a pose against is
//! the one whose weakest link is strongest, that is a path in a maximum spanning tree by inliers. Panoramic pairs are
//! links, too: they know no depth, but how the camera was turned they know best.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::UnitQuaternion;
use serde::{Deserialize, Serialize};

use super::MatchGraph;
use crate::camera::Camera;
use crate::geometry::Rigid3;
use crate::matching::two_view::TwoViewConfig;
use crate::math::UnionFind;
use crate::scene::{ImageId, Reconstruction};

/// When a rotation counts as contradicted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RotationCycleOptions {
    /// Whether pairs and poses are held against stronger pairs.
    pub enabled: bool,
    /// Every link of the chain that a pair or a pose is held against has at least so many times its inliers.
    pub min_times_stronger: f64,
    /// Rotations that differ by more than this contradict each other, in degrees. Wrong ones differ by any angle; those
    /// of short baselines before a plane are off by a few degrees.
    pub max_angle_deg: f64,
    /// More for every link of the chain, whose errors add up, in degrees.
    pub link_angle_deg: f64,
    /// Links of a chain at most: the errors of more say too little.
    pub max_links: usize,
}

impl Default for RotationCycleOptions {
    fn default() -> Self {
        Self { enabled: true, min_times_stronger: 2.0, max_angle_deg: 15.0, link_angle_deg: 1.0, max_links: 30 }
    }
}

impl RotationCycleOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        for (name, value, least) in [
            ("min_times_stronger", self.min_times_stronger, 1.0),
            ("max_angle_deg", self.max_angle_deg, 0.0),
            ("link_angle_deg", self.link_angle_deg, 0.0),
        ] {
            if !(value >= least && value.is_finite()) {
                errors.push(format!("rotation_cycles.{name} must be at least {least}, not {value}"));
            }
        }
    }
}

/// A link of the forest as seen from one of its ends.
#[derive(Clone, Debug)]
struct Link {
    to: ImageId,
    to_from_here: UnitQuaternion<f64>,
    inliers: usize,
}

/// A maximum spanning forest of the pairs whose relative rotation is certain, by inliers.
#[derive(Clone, Debug, Default)]
pub struct RotationForest {
    links: BTreeMap<ImageId, Vec<Link>>,
}

impl RotationForest {
    /// That of a graph. Of a plane alone two rotations look alike, so planar pairs are no links.
    pub fn of<'a>(graph: &MatchGraph, camera: impl Fn(ImageId) -> &'a Camera) -> Self {
        let certain = graph.pairs.iter().filter(|(_, geometry)| geometry.config != TwoViewConfig::Planar);
        let mut strongest: Vec<_> = certain
            .filter_map(|(&(a, b), geometry)| {
                Some(((a, b), geometry.rotation(camera(a), camera(b))?, geometry.inliers.len()))
            })
            .collect();
        strongest.sort_by_key(|&(pair, _, inliers)| (std::cmp::Reverse(inliers), pair));
        let images: BTreeSet<ImageId> = strongest.iter().flat_map(|&((a, b), ..)| [a, b]).collect();
        let rank: BTreeMap<ImageId, usize> = images.iter().enumerate().map(|(rank, &id)| (id, rank)).collect();
        let mut joined = UnionFind::new(images.len());
        let mut forest = Self::default();
        for ((a, b), b_from_a, inliers) in strongest {
            if joined.union(rank[&a], rank[&b]) {
                for (from, to, to_from_here) in [(a, b, b_from_a), (b, a, b_from_a.inverse())] {
                    forest.links.entry(from).or_default().push(Link { to, to_from_here, inliers });
                }
            }
        }
        forest
    }

    /// Whether a rotation found from so many inliers is contradicted: by the shortest chain of much stronger links from
    /// the image to one whose rotation is known (`goal_from_image` gives what the rotation in question says of it), if
    /// there is any.
    fn contradicts(
        &self,
        image: ImageId,
        inliers: usize,
        goal_from_image: impl Fn(ImageId) -> Option<UnitQuaternion<f64>>,
        options: &RotationCycleOptions,
    ) -> bool {
        if !options.enabled {
            return false;
        }
        let is_strong = |link: &&Link| link.inliers as f64 >= options.min_times_stronger * inliers as f64;
        let mut seen = BTreeSet::from([image]);
        let mut waiting = VecDeque::from([(image, UnitQuaternion::identity(), 0)]);
        while let Some((at, at_from_image, links)) = waiting.pop_front() {
            if let Some(told) = goal_from_image(at) {
                let allowed_deg = options.max_angle_deg + options.link_angle_deg * links as f64;
                return told.angle_to(&at_from_image).to_degrees() > allowed_deg;
            }
            if links == options.max_links {
                continue;
            }
            for link in self.links.get(&at).into_iter().flatten().filter(is_strong) {
                if seen.insert(link.to) {
                    waiting.push_back((link.to, link.to_from_here * at_from_image, links + 1));
                }
            }
        }
        false
    }

    /// Whether the pose that so many points of a model give an image is contradicted by its chain to the images of the model.
    pub fn contradicts_pose(
        &self,
        model: &Reconstruction,
        image: ImageId,
        cam_from_world: &Rigid3,
        inliers: usize,
        options: &RotationCycleOptions,
    ) -> bool {
        let told = |goal| {
            let goal_from_world = model.image(goal)?.cam_from_world.rotation;
            Some(goal_from_world * cam_from_world.rotation.inverse())
        };
        self.contradicts(image, inliers, told, options)
    }
}

/// The pairs that chains of much stronger ones contradict.
pub fn contradicted<'a>(
    graph: &MatchGraph,
    camera: impl Fn(ImageId) -> &'a Camera,
    options: &RotationCycleOptions,
) -> BTreeSet<(ImageId, ImageId)> {
    let forest = RotationForest::of(graph, &camera);
    let pairs = graph.pairs.iter().filter(|&(&(a, b), geometry)| {
        geometry.rotation(camera(a), camera(b)).is_some_and(|b_from_a| {
            let told = |goal| (goal == b).then_some(b_from_a);
            forest.contradicts(a, geometry.inliers.len(), told, options)
        })
    });
    pairs.map(|(&pair, _)| pair).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::{CameraModel, FocalSource};
    use crate::matching::two_view::TwoViewGeometry;
    use crate::scene::{CameraId, KeypointIdx};
    use nalgebra::Vector3;

    const IMAGES: u32 = 12;

    fn camera() -> Camera {
        Camera::centered(CameraModel::SimplePinhole, 1200, 800, 1000.0, FocalSource::Known)
    }

    /// Image `n` of a ring, turned by 30 degrees against the one before.
    fn image_from_world(n: u32) -> UnitQuaternion<f64> {
        UnitQuaternion::from_scaled_axis(Vector3::y() * (f64::from(n) * std::f64::consts::TAU / f64::from(IMAGES)))
    }

    /// A pair of this kind that turns by `degrees` more than the truth.
    fn pair(
        a: u32,
        b: u32,
        config: TwoViewConfig,
        inliers: u32,
        degrees: f64,
    ) -> ((ImageId, ImageId), TwoViewGeometry) {
        let off = UnitQuaternion::from_scaled_axis(Vector3::x() * degrees.to_radians());
        let b_from_a = off * image_from_world(b) * image_from_world(a).inverse();
        let calibration = camera().calibration_matrix();
        let turned = calibration * b_from_a.to_rotation_matrix() * calibration.try_inverse().unwrap();
        let has_depth = config != TwoViewConfig::Panoramic;
        let geometry = TwoViewGeometry {
            config,
            inliers: (0..inliers).map(|n| (KeypointIdx(n), KeypointIdx(n))).collect(),
            fundamental: None,
            essential: None,
            // Of either sign, as it is found.
            homography: Some(turned * if b.is_multiple_of(2) { -0.3 } else { 0.3 }),
            b_from_a: has_depth.then(|| Rigid3::new(b_from_a, Vector3::x())),
            median_triangulation_angle_rad: None,
            num_e_inliers: 0,
            num_f_inliers: 0,
            num_h_inliers: 0,
        };
        ((ImageId(a), ImageId(b)), geometry)
    }

    /// A chain of pairs with 100 inliers, every other of which knows no depth.
    fn chain() -> MatchGraph {
        let kinds = [TwoViewConfig::Calibrated, TwoViewConfig::Panoramic];
        let pairs = (1..IMAGES).map(|n| pair(n - 1, n, kinds[n as usize % 2], 100, 0.0));
        MatchGraph { pairs: pairs.collect() }
    }

    #[test]
    fn weak_pairs_that_turn_otherwise_are_found_and_no_others() {
        let (camera, options) = (camera(), RotationCycleOptions::default());
        let mut graph = chain();
        graph.pairs.extend([
            pair(0, 6, TwoViewConfig::Calibrated, 20, 120.0),
            pair(1, 4, TwoViewConfig::Planar, 50, 60.0),
            // As the chain says, or nearly: six links may be off by six degrees more than one.
            pair(0, 2, TwoViewConfig::Calibrated, 20, 0.0),
            pair(2, 8, TwoViewConfig::Calibrated, 20, 18.0),
            // Too strong for the chain to say anything; and a plane is no link, so it contradicts nothing either.
            pair(3, 9, TwoViewConfig::Calibrated, 60, 90.0),
            pair(5, 10, TwoViewConfig::Planar, 500, 90.0),
            // An end that no link leads to.
            pair(4, IMAGES + 3, TwoViewConfig::Planar, 20, 90.0),
        ]);
        let found: Vec<(u32, u32)> =
            contradicted(&graph, |_| &camera, &options).into_iter().map(|(a, b)| (a.0, b.0)).collect();
        assert_eq!(found, [(0, 6), (1, 4)]);
        let off = RotationCycleOptions { enabled: false, ..options.clone() };
        assert!(contradicted(&graph, |_| &camera, &off).is_empty());
        let short = RotationCycleOptions { max_links: 5, ..options };
        let found = contradicted(&graph, |_| &camera, &short);
        assert_eq!(found.len(), 1, "a chain of six links is not asked: {found:?}");
    }

    #[test]
    fn a_pose_is_held_against_the_chain_to_the_model() {
        let (camera, options) = (camera(), RotationCycleOptions::default());
        let forest = RotationForest::of(&chain(), |_| &camera);
        let mut model = Reconstruction::new([(CameraId(0), camera.clone())].into());
        // The model's world is turned against that of the ring.
        let ring_from_world = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -1.1, 0.4));
        let pose = |n| Rigid3::new(image_from_world(n) * ring_from_world, Vector3::zeros());
        for n in 0..3 {
            model.register(ImageId(n), CameraId(0), pose(n), [].into());
        }
        let contradicts = |pose: Rigid3, inliers| forest.contradicts_pose(&model, ImageId(7), &pose, inliers, &options);
        assert!(!contradicts(pose(7), 20));
        assert!(contradicts(pose(9), 20), "turned by 60 degrees");
        assert!(!contradicts(pose(9), 51), "too many points for links of 100");
        let lone = forest.contradicts_pose(&model, ImageId(IMAGES), &pose(9), 20, &options);
        assert!(!lone, "no chain leads to it");
    }
}
