//! Tracks of each image's features, triangulated image by image (paper, section 6.3).
//!
//! A keypoint of the query image with its matches in all candidate images is a star-shaped track. Guided matches can be
//! wrong along the epipolar line, so a track of three or more sightings is triangulated robustly: the query's ray is
//! intersected with every other one, the intersection (or the position of a model's point that one of the sightings
//! already sees) that most sightings agree with is kept, and its inliers give the linear least-squares point of the paper,
//! refined to the least reprojection error. Every image is independent of all others; the merge ([`super::merge`]) joins
//! what they found.

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::guided_match::KeypointMatch;
use super::options::TriangulationOptions;
use super::stars::StarTracks;
use super::views::{Sighting, ViewTable};
use super::{AddPointsError, Cancelled};
use crate::geometry::triangulation::refine_point;
use crate::scene::{ImageId, KeypointIdx, Reconstruction};

/// The matches of one pair.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PairMatches {
    /// The first image.
    pub first: ImageId,
    /// The second.
    pub second: ImageId,
    /// Keypoints that belong together, each at most once.
    pub matches: Vec<KeypointMatch>,
}

/// A query keypoint and those of its matches that see one point with it.
#[derive(Clone, Debug)]
pub struct StarTrack {
    /// The keypoint whose matches they are.
    pub query: Sighting,
    /// The sightings that agree, the query's among them, sorted; one an image, two or more.
    pub sightings: Vec<Sighting>,
    /// The point.
    pub xyz: Vector3<f64>,
    /// Whether all matches it is made of are distinctive.
    pub distinctive: bool,
    /// Mean of the squared errors, relative to what is allowed.
    pub mean_relative_error_sq: f64,
}

/// The tracks of all images' keypoints, by image and keypoint.
///
/// # Errors
/// When cancelled; asked for every image.
pub fn star_tracks(
    model: &Reconstruction,
    table: &ViewTable,
    matches: &[PairMatches],
    cancelled: &Cancelled,
) -> Result<StarTracks, AddPointsError> {
    // The pairs of each image, as (index of the pair, whether it is the pair's first).
    let mut pairs_of: Vec<Vec<(usize, bool)>> = vec![Vec::new(); table.len()];
    for (index, pair) in matches.iter().enumerate() {
        if let (Some(first), Some(second)) = (table.rank(pair.first), table.rank(pair.second)) {
            pairs_of[first as usize].push((index, true));
            pairs_of[second as usize].push((index, false));
        }
    }
    let of_image = |rank: usize| {
        if cancelled() {
            return Err(AddPointsError::Cancelled);
        }
        Ok(stars_of_image(model, table, matches, rank as u32, &pairs_of[rank]))
    };
    let of_images = |ranks: &[usize]| ranks.par_iter().map(|&rank| of_image(rank)).collect::<Result<Vec<_>, _>>();
    let mut stars = StarTracks::default();
    let ranks: Vec<usize> = (0..table.len()).collect();
    let mut found = Vec::new();
    for some in ranks.chunks(IMAGES_PER_THREAD * rayon::current_num_threads()) {
        // Those found before are packed meanwhile, which only one thread can do.
        let pack = || std::mem::take(&mut found).into_iter().for_each(|of_image| stars.add_image(of_image));
        let ((), next) = rayon::join(pack, || of_images(some));
        found = next?;
    }
    found.into_iter().for_each(|of_image| stars.add_image(of_image));
    Ok(stars)
}

/// Images whose stars are found before they are packed, for each thread: enough for threads to be seldom without work.
const IMAGES_PER_THREAD: usize = 2;

fn stars_of_image(
    model: &Reconstruction,
    table: &ViewTable,
    matches: &[PairMatches],
    rank: u32,
    pairs: &[(usize, bool)],
) -> Vec<StarTrack> {
    let mut links: Vec<(KeypointIdx, Link)> = Vec::new();
    for &(index, is_first) in pairs {
        let pair = &matches[index];
        let other = table.rank(if is_first { pair.second } else { pair.first }).expect("pairs were filtered by rank");
        links.extend(pair.matches.iter().map(|found| {
            let (own, keypoint) = if is_first { (found.first, found.second) } else { (found.second, found.first) };
            (own, Link { seen: Sighting { rank: other, keypoint }, distinctive: found.distinctive })
        }));
    }
    links.sort_unstable();
    let mut stars = Vec::new();
    let mut track = Vec::new();
    for links in links.chunk_by(|a, b| a.0 == b.0) {
        track.clear();
        track.extend(links.iter().map(|&(_, link)| link));
        stars.extend(triangulate_star(model, table, Sighting { rank, keypoint: links[0].0 }, &track));
    }
    stars
}

/// A match of a query keypoint.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Link {
    /// The matched keypoint.
    pub seen: Sighting,
    /// Whether the match is distinctive ([`KeypointMatch::distinctive`]).
    pub distinctive: bool,
}

/// The point that a star's query sees together with most of its matches (at most one an image, by rank); none when it agrees
/// with none of them.
pub fn triangulate_star(
    model: &Reconstruction,
    table: &ViewTable,
    query: Sighting,
    links: &[Link],
) -> Option<StarTrack> {
    let track: Vec<Sighting> = std::iter::once(query).chain(links.iter().map(|link| link.seen)).collect();
    let query_ray = table.ray(query);
    let known = track.iter().filter_map(|&seen| {
        let point = table.image(seen.rank).points()[seen.keypoint.index()]?;
        Some(model.point(point)?.xyz)
    });
    let crossings = track[1..].iter().filter_map(|&seen| nearest_to_rays(query_ray, table.ray(seen)));
    let mut best: Option<(Vector3<f64>, f64)> = None;
    for xyz in known.chain(crossings) {
        // The cost only grows, so most are known to be no better before all sightings are looked at.
        let least = best.map_or(f64::INFINITY, |(_, cost)| cost);
        let mut costs = track.iter().map(|&seen| table.relative_error_sq(seen, &xyz).min(1.0));
        let cost = costs.try_fold(0.0, |sum, cost| Some(sum + cost).filter(|sum| *sum < least));
        best = cost.map(|cost| (xyz, cost)).or(best);
    }
    let (xyz, _) = best?;
    let (xyz, mut sightings) = refit(table, xyz, |xyz| table.agreeing(&track, xyz))?;
    if sightings[0] != query {
        return None;
    }
    let errors: f64 = sightings.iter().map(|&seen| table.relative_error_sq(seen, &xyz)).sum();
    // Both lists are by rank, so each inlier's link is found in passing.
    let mut links = links.iter();
    let distinctive =
        sightings[1..].iter().all(|seen| links.find(|link| link.seen == *seen).is_some_and(|link| link.distinctive));
    sightings.sort_unstable();
    Some(StarTrack { query, distinctive, mean_relative_error_sq: errors / sightings.len() as f64, sightings, xyz })
}

/// Rounds of [`refit`]: the inliers have settled after one or two.
const MAX_REFITS: usize = 3;

/// Fits a point to the sightings that `inliers` grants it, again until these stay the same. A fit that loses sightings is
/// undone; none when there are fewer than two from the start.
pub fn refit(
    table: &ViewTable,
    start: Vector3<f64>,
    inliers: impl Fn(&Vector3<f64>) -> Vec<Sighting>,
) -> Option<(Vector3<f64>, Vec<Sighting>)> {
    let (mut xyz, mut granted) = (start, inliers(&start));
    if granted.len() < 2 {
        return None;
    }
    for _ in 0..MAX_REFITS {
        // The start is near: a crossing of two of the rays, or a point of the model.
        let views: Vec<_> = granted.iter().map(|&seen| table.view(seen)).collect();
        let fitted = refine_point(&views, &xyz);
        let fitted_granted = inliers(&fitted);
        if fitted_granted.len() < granted.len() {
            break;
        }
        let settled = fitted_granted == granted;
        (xyz, granted) = (fitted, fitted_granted);
        if settled {
            break;
        }
    }
    Some((xyz, granted))
}

/// Whether a track fixes a new point well enough.
pub fn fixes_point(table: &ViewTable, xyz: &Vector3<f64>, track: &[Sighting], options: &TriangulationOptions) -> bool {
    let two_views = track.len() == 2;
    let min_angle_deg = if two_views { options.min_angle_two_view_deg } else { options.min_angle_deg };
    track.len() >= options.min_track_length
        && (!two_views || track.iter().all(|&seen| table.fits_two_view(seen, xyz)))
        && table.has_angle(track, xyz, min_angle_deg.to_radians())
}

/// The point half-way between the rays of two sightings where they are nearest; none where that is not in front of both images.
pub fn crossing(table: &ViewTable, [a, b]: [Sighting; 2]) -> Option<Vector3<f64>> {
    nearest_to_rays(table.ray(a), table.ray(b))
}

/// Rays at a smaller sine of their angle than this have no crossing to speak of (1e-6 rad is a thousandth of a pixel).
const MIN_SINE_SQ: f64 = 1e-12;

/// The point half-way between two rays (centre, direction) where they are nearest; none for parallel rays and where they are
/// nearest behind a centre.
///
/// With `w` the vector between the centres, the depths s, t minimise `|s a - t b - w|^2`:
/// `s = ((a.w)(b.b) - (a.b)(b.w)) / D`, `t = ((a.b)(a.w) - (a.a)(b.w)) / D`, `D = (a.a)(b.b) - (a.b)^2`.
fn nearest_to_rays(
    (center_a, a): (Vector3<f64>, Vector3<f64>),
    (center_b, b): (Vector3<f64>, Vector3<f64>),
) -> Option<Vector3<f64>> {
    let w = center_b - center_a;
    let (aa, bb, ab, aw, bw) = (a.dot(&a), b.dot(&b), a.dot(&b), a.dot(&w), b.dot(&w));
    let determinant = aa * bb - ab * ab;
    if determinant <= MIN_SINE_SQ * aa * bb {
        return None;
    }
    let (s, t) = ((aw * bb - ab * bw) / determinant, (ab * aw - aa * bw) / determinant);
    (s > 0.0 && t > 0.0).then(|| (center_a + a * s + center_b + b * t) / 2.0)
}
