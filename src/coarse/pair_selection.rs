//! Which pairs of images are worth matching.
//!
//! Small sets: all pairs. Larger ones: preemptive matching (Wu, "Towards linear-time incremental structure from motion",
//! 3DV 2013, section 4; it is the paper's "V+PM"): the hundred features of largest scale of two images are matched first,
//! and the pair goes on only when a few of them match. To these are added, against what such a small sample misses: for
//! every image its best-ranked partners even below the threshold, its neighbours in name order (photographs are mostly
//! taken along a walk, and cameras number them), and the photographs taken nearby when positions are known.

use std::collections::BTreeMap;
use std::num::NonZero;

use kiddo::{ImmutableKdTree, SquaredEuclidean};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::matching::descriptor::{PackedDescriptors, top2_both};
use crate::matching::{MatchOptions, mutual_matches};
use crate::scene::{Descriptor, ImageId};

/// Radius of the sphere that stands for the earth, in metres: good to 0.5 % for distances between neighbours.
const EARTH_RADIUS_M: f64 = 6_371_009.0;

/// Which pairs are matched.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PairSelectionOptions {
    /// Sets of at most this many images match all pairs.
    pub exhaustive_up_to: usize,
    /// Features of largest scale an image is judged by. 100 in Wu's paper.
    pub preemptive_features: usize,
    /// A pair goes on with at least this many matches among them. 4 in Wu's paper; 2 to 4 in ours.
    pub preemptive_matches: usize,
    /// How these features are matched.
    pub preemptive_matching: MatchOptions,
    /// So many partners of most preemptive matches (at least one) are kept for every image even below the threshold.
    pub best_partners: usize,
    /// So many following images in name order are kept for every image; 0 for none.
    pub sequence_neighbors: usize,
    /// Photographs taken within this distance, in metres, are kept, where positions are known; 0 for none.
    pub gps_radius_m: f64,
    /// At most so many of them for every image, nearest first.
    pub gps_neighbors: usize,
}

impl Default for PairSelectionOptions {
    fn default() -> Self {
        Self {
            exhaustive_up_to: 60,
            preemptive_features: 100,
            preemptive_matches: 4,
            preemptive_matching: MatchOptions::default(),
            best_partners: 5,
            sequence_neighbors: 3,
            gps_radius_m: 100.0,
            gps_neighbors: 20,
        }
    }
}

impl PairSelectionOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        self.preemptive_matching.validate(errors);
        if self.preemptive_features == 0 {
            errors.push("preemptive_features must be at least 1".to_owned());
        }
        if self.preemptive_matches == 0 {
            errors.push("preemptive_matches must be at least 1".to_owned());
        }
        if !(self.gps_radius_m >= 0.0 && self.gps_radius_m.is_finite()) {
            errors.push(format!("gps_radius_m is {}, it must be finite and not negative", self.gps_radius_m));
        }
    }
}

/// A place on the earth, from EXIF.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct GeoPosition {
    /// Latitude in degrees, north positive.
    pub latitude_deg: f64,
    /// Longitude in degrees, east positive.
    pub longitude_deg: f64,
}

impl GeoPosition {
    /// On a sphere as large as the earth, in metres from its centre: chords between neighbours are their distance.
    fn on_sphere_m(&self) -> [f64; 3] {
        let (lat, lon) = (self.latitude_deg.to_radians(), self.longitude_deg.to_radians());
        [lat.cos() * lon.cos(), lat.cos() * lon.sin(), lat.sin()].map(|axis| EARTH_RADIUS_M * axis)
    }

    fn is_valid(&self) -> bool {
        self.latitude_deg.abs() <= 90.0 && self.longitude_deg.abs() <= 360.0
    }
}

/// An image to pair up.
#[derive(Clone, Copy, Debug)]
pub struct PairingImage<'a> {
    /// The image; ids follow the order of names.
    pub id: ImageId,
    /// Its descriptors by descending scale (only the first `preemptive_features` are read).
    pub descriptors: &'a [Descriptor],
    /// Where it was taken, if known.
    pub position: Option<GeoPosition>,
}

/// Why a pair is matched. A pair may have several reasons.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct PairReasons {
    /// The set is small.
    pub exhaustive: bool,
    /// Matches among the features of largest scale, when they were enough or among the image's best.
    pub preemptive_matches: Option<u32>,
    /// Neighbours in name order.
    pub sequence: bool,
    /// Taken close to each other.
    pub gps: bool,
}

/// The pairs to match, the smaller id first, with their reasons.
pub type SelectedPairs = BTreeMap<(ImageId, ImageId), PairReasons>;

/// Selects the pairs of these images, whose ids must differ.
pub fn select_pairs(images: &[PairingImage], options: &PairSelectionOptions) -> SelectedPairs {
    let mut images = images.to_vec();
    images.sort_by_key(|image| image.id);
    let mut pairs = SelectedPairs::new();
    if images.len() <= options.exhaustive_up_to {
        for (rank, first) in images.iter().enumerate() {
            for second in &images[rank + 1..] {
                pairs.entry((first.id, second.id)).or_default().exhaustive = true;
            }
        }
        return pairs;
    }
    for (first, second, matches) in preemptive_pairs(&images, options) {
        pairs.entry((images[first].id, images[second].id)).or_default().preemptive_matches = Some(matches);
    }
    for (rank, first) in images.iter().enumerate() {
        for second in images[rank + 1..].iter().take(options.sequence_neighbors) {
            pairs.entry((first.id, second.id)).or_default().sequence = true;
        }
    }
    for pair in nearby_pairs(&images, options) {
        pairs.entry(pair).or_default().gps = true;
    }
    pairs
}

/// Pairs of ranks (ascending) whose top features match, with the number of matches.
fn preemptive_pairs(images: &[PairingImage], options: &PairSelectionOptions) -> Vec<(usize, usize, u32)> {
    let top = |image: &PairingImage| image.descriptors.len().min(options.preemptive_features);
    let packed: Vec<PackedDescriptors> =
        images.par_iter().map(|image| PackedDescriptors::pack(&image.descriptors[..top(image)])).collect();
    let test = options.preemptive_matching.test();
    let counts: Vec<Vec<(usize, u32)>> = (0..images.len())
        .into_par_iter()
        .map_init(
            || (Vec::new(), Vec::new()),
            |(of_queries, of_rows), first| {
                let queries = &images[first].descriptors[..top(&images[first])];
                let count = |second: usize| {
                    top2_both(queries, &packed[second], of_queries, of_rows);
                    let back = options.preemptive_matching.cross_check.then_some(of_rows.as_slice());
                    (second, mutual_matches(of_queries, back, &test).len() as u32)
                };
                (first + 1..images.len()).map(count).filter(|&(_, matches)| matches > 0).collect()
            },
        )
        .collect();

    let mut partners = vec![Vec::new(); images.len()];
    for (first, counts) in counts.iter().enumerate() {
        for &(second, matches) in counts {
            partners[first].push((std::cmp::Reverse(matches), second));
            partners[second].push((std::cmp::Reverse(matches), first));
        }
    }
    let mut kept = BTreeMap::new();
    for (image, partners) in partners.iter_mut().enumerate() {
        partners.sort_unstable();
        for (rank, &(std::cmp::Reverse(matches), partner)) in partners.iter().enumerate() {
            if rank < options.best_partners || matches as usize >= options.preemptive_matches {
                kept.insert((image.min(partner), image.max(partner)), matches);
            }
        }
    }
    kept.into_iter().map(|((first, second), matches)| (first, second, matches)).collect()
}

/// Pairs taken close to each other.
fn nearby_pairs(images: &[PairingImage], options: &PairSelectionOptions) -> Vec<(ImageId, ImageId)> {
    let placed: Vec<(ImageId, [f64; 3])> = images
        .iter()
        .filter_map(|image| Some((image.id, image.position.filter(GeoPosition::is_valid)?.on_sphere_m())))
        .collect();
    let positions: Vec<[f64; 3]> = placed.iter().map(|(_, position)| *position).collect();
    let (Some(wanted), true) = (NonZero::new(options.gps_neighbors + 1), options.gps_radius_m > 0.0) else {
        return Vec::new();
    };
    // Only positions that are not numbers make the construction fail, and those were left out.
    let Ok(tree) = ImmutableKdTree::<f64, 3>::new_from_slice(&positions) else { return Vec::new() };
    let mut pairs = Vec::new();
    for (rank, (id, position)) in placed.iter().enumerate() {
        // One more than wanted, because the image finds itself.
        let near = tree
            .query(position)
            .nearest_n::<SquaredEuclidean<f64>>(wanted)
            .within(options.gps_radius_m * options.gps_radius_m)
            .execute();
        for found in near.iter().filter(|found| found.item as usize != rank).take(options.gps_neighbors) {
            let other = placed[found.item as usize].0;
            pairs.push(((*id).min(other), (*id).max(other)));
        }
    }
    pairs
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    /// A walk: image i sees the descriptors 30 i .. 30 i + 100 of a long street, shuffled and with noise.
    fn walk(num_images: usize) -> Vec<Vec<Descriptor>> {
        let mut rng = Rng::from_parts(&[5]);
        let street: Vec<Descriptor> =
            (0..30 * num_images + 100).map(|_| std::array::from_fn(|_| rng.below(91) as u8)).collect();
        (0..num_images)
            .map(|image| {
                let mut seen: Vec<Descriptor> = street[30 * image..30 * image + 100]
                    .iter()
                    .map(|descriptor| descriptor.map(|byte| byte.saturating_add(rng.below(9) as u8)))
                    .collect();
                rng.shuffle(&mut seen);
                seen
            })
            .collect()
    }

    fn images(descriptors: &[Vec<Descriptor>]) -> Vec<PairingImage<'_>> {
        (0u32..)
            .map(ImageId)
            .zip(descriptors)
            .map(|(id, descriptors)| PairingImage { id, descriptors, position: None })
            .collect()
    }

    fn preemptive_only() -> PairSelectionOptions {
        PairSelectionOptions {
            exhaustive_up_to: 0,
            best_partners: 0,
            sequence_neighbors: 0,
            ..PairSelectionOptions::default()
        }
    }

    #[test]
    fn small_sets_take_all_pairs() {
        let descriptors = walk(7);
        assert_eq!(select_pairs(&images(&descriptors), &PairSelectionOptions::default()).len(), 21);
    }

    #[test]
    fn preemptive_matching_finds_the_pairs_that_overlap() {
        let descriptors = walk(12);
        let pairs = select_pairs(&images(&descriptors), &preemptive_only());
        // Shared features: 70 one step apart, 40 two, 10 three, none beyond.
        for (first, second) in (0..12).flat_map(|a| (a + 1..12).map(move |b| (a, b))) {
            let reasons = pairs.get(&(ImageId(first), ImageId(second)));
            assert_eq!(reasons.is_some(), second - first <= 3, "{first} {second}");
            if let Some(reasons) = reasons {
                let shared = 100 - 30 * (second - first);
                assert!(reasons.preemptive_matches.unwrap().abs_diff(shared) <= 3);
            }
        }
    }

    #[test]
    fn best_partners_survive_a_threshold_nobody_reaches() {
        let descriptors = walk(12);
        let options = PairSelectionOptions { preemptive_matches: 200, best_partners: 1, ..preemptive_only() };
        let pairs = select_pairs(&images(&descriptors), &options);
        assert!((0..12).all(|id| pairs.keys().any(|(a, b)| a.0 == id || b.0 == id)));
        assert!(pairs.len() <= 12);
    }

    #[test]
    fn neighbours_by_name_and_by_place_are_added() {
        let blank = vec![Vec::new(); 6];
        let mut images = images(&blank);
        let options = PairSelectionOptions { sequence_neighbors: 1, gps_radius_m: 50.0, ..preemptive_only() };
        // 0.0001 degrees of latitude are 11.1 m; image 4 is a kilometre off, image 2 has no position.
        for (image, step) in images.iter_mut().zip([0.0, 8.0, 0.0, 3.0, 90.0, 1.0]) {
            image.position = Some(GeoPosition { latitude_deg: 48.0 + 1e-4 * step, longitude_deg: 16.0 });
        }
        images[2].position = None;
        let pairs = select_pairs(&images, &options);
        let by = |reason: fn(&PairReasons) -> bool| -> Vec<(u32, u32)> {
            pairs.iter().filter(|(_, reasons)| reason(reasons)).map(|((a, b), _)| (a.0, b.0)).collect()
        };
        assert_eq!(by(|reasons| reasons.sequence), [(0, 1), (1, 2), (2, 3), (3, 4), (4, 5)]);
        assert_eq!(by(|reasons| reasons.gps), [(0, 3), (0, 5), (3, 5)]);
    }

    #[test]
    fn many_photographs_from_one_tripod_do_not_flood() {
        let blank = vec![Vec::new(); 100];
        let mut images = images(&blank);
        for image in &mut images {
            image.position = Some(GeoPosition { latitude_deg: -33.0, longitude_deg: 151.0 });
        }
        let options = PairSelectionOptions { gps_neighbors: 5, ..preemptive_only() };
        let pairs = select_pairs(&images, &options);
        assert!(pairs.len() <= 500 && pairs.len() >= 250, "{}", pairs.len());
    }
}
