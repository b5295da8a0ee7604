//! Focal lengths from many fundamental matrices, by voting.
//!
//! With square pixels and the principal point moved to the origin, `E = diag(f_b, f_b, 1) F diag(f_a, f_a, 1)` must have two
//! equal singular values `s1 = s2` (the Kruppa equations; Hartley, "Extraction of Focal Lengths from the Fundamental
//! Matrix", 1993). One pair fixes a shared focal length in principle, but badly, and not at all for some motions (optical axes
//! that meet, pure translation): its imbalance `1 - s2 / s1`, as a function of `f`, then has a wide or shifted valley. So,
//! as FastMap does (Li et al., "FastMap: Revisiting Structure from Motion through First-Order Optimization", 2025), every
//! pair votes for each of a few hundred candidates, spaced evenly in `log f`, with `exp(-imbalance^2 / (2 sigma^2))`. The
//! mean of a pair's votes is taken off, so that a pair that fits all candidates alike says nothing, and the votes are added.
//! The best candidate is refined by a parabola through its neighbours.
//!
//! Groups (sets of images that share a focal length) take turns: pairs within a group vote on `f` for both sides; a pair
//! across groups votes with the other group's current focal length.
//!
//! The singular values cost no decomposition: as `det E = 0`, `s1^2 + s2^2 = |E|^2` and `s1 s2 = |cof E|`, so
//! `(s2 / s1)^2 = (T - D) / (T + D)` with `T = |E|^2`, `D^2 = T^2 - 4 |cof E|^2`; and both norms are polynomials in the
//! squared focal lengths, because scaling rows and columns of `F` scales its entries and cofactors.

use nalgebra::Matrix3;
use serde::{Deserialize, Serialize};

/// How to vote.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct FocalVotingOptions {
    /// Number of candidates, evenly spaced in the logarithm. More cost time; 256 lie 1 % apart.
    pub candidates: usize,
    /// Least candidate, as a share of the longer side of the image.
    pub min_focal_ratio: f64,
    /// Greatest candidate, as a share of the longer side of the image.
    pub max_focal_ratio: f64,
    /// Imbalance of the singular values that counts as noise: half width of a vote. Lower values trust good pairs more and
    /// need more of them.
    pub sigma: f64,
    /// Rounds in which groups take turns.
    pub rounds: usize,
    /// A vote of less confidence than this leaves the given focal length. (Measured with one group: 0.16 to 0.5 for
    /// five sets of photographs, within 3 % of the truth; 0.003 for a turntable ring, whose axes all meet.)
    pub min_confidence: f64,
}

impl Default for FocalVotingOptions {
    fn default() -> Self {
        Self {
            candidates: 256,
            min_focal_ratio: 0.3,
            max_focal_ratio: 4.0,
            sigma: 0.01,
            rounds: 5,
            min_confidence: 0.05,
        }
    }
}

impl FocalVotingOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if self.candidates < MIN_CANDIDATES {
            errors.push(format!("candidates must be at least {MIN_CANDIDATES}, not {}", self.candidates));
        }
        if !(self.min_focal_ratio > 0.0
            && self.max_focal_ratio > self.min_focal_ratio
            && self.max_focal_ratio.is_finite())
        {
            errors.push(format!(
                "min_focal_ratio {} and max_focal_ratio {} must be positive and ascending",
                self.min_focal_ratio, self.max_focal_ratio
            ));
        }
        if !(self.sigma > 0.0 && self.sigma < 1.0) {
            errors.push(format!("sigma must lie between 0 and 1, not {}", self.sigma));
        }
        if !(0.0..=1.0).contains(&self.min_confidence) {
            errors.push(format!("min_confidence must lie in [0, 1], not {}", self.min_confidence));
        }
    }
}

/// Fewer candidates can't show a peak.
const MIN_CANDIDATES: usize = 16;

/// A fundamental matrix with what is known of its images.
#[derive(Clone, Debug)]
pub struct FocalVote {
    /// `p_b^T F p_a = 0` between undistorted pixels.
    pub fundamental: Matrix3<f64>,
    /// The principal point of image a in pixels.
    pub principal_point_a_px: (f64, f64),
    /// The principal point of image b in pixels.
    pub principal_point_b_px: (f64, f64),
    /// The group of image a: an index into the groups.
    pub group_a: usize,
    /// The group of image b.
    pub group_b: usize,
    /// How much the pair counts: 1, or more for pairs with many inliers.
    pub weight: f64,
}

/// A set of images that share a focal length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalGroup {
    /// The longer side of the images in pixels: what candidates are relative to.
    pub long_side_px: f64,
    /// The focal length in pixels to start from and, when `fixed`, to keep.
    pub focal_px: f64,
    /// Whether the focal length is known.
    pub fixed: bool,
}

/// What a group's pairs say.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FocalEstimate {
    /// The focal length in pixels; the one given where the group is fixed, the confidence is too low, or the votes only rise
    /// towards the border of the candidates.
    pub focal_px: f64,
    /// From 0 to 1: how far the votes for it rise above those for focal lengths elsewhere, relative to the most that the pairs
    /// could give; see [`FocalVotingOptions::min_confidence`] for values. Optical axes that all meet give about 0.
    pub confidence: f64,
    /// Number of pairs that voted.
    pub num_pairs: usize,
}

/// `|diag(f_b, f_b, 1) F diag(f_a, f_a, 1)|^2` and the same of the cofactors, as sums over the four blocks of the matrix.
#[derive(Clone, Copy, Debug)]
struct Blocks {
    /// Squared norms of the upper left 2x2, upper right 2x1, lower left 1x2 and lower right 1x1 block of F.
    entries: [f64; 4],
    /// The same of the matrix of cofactors.
    cofactors: [f64; 4],
}

impl Blocks {
    fn new(vote: &FocalVote, unit_px: f64) -> Option<Self> {
        let centered = |(x, y): (f64, f64)| Matrix3::new(unit_px, 0.0, x, 0.0, unit_px, y, 0.0, 0.0, 1.0);
        let f =
            centered(vote.principal_point_b_px).transpose() * vote.fundamental * centered(vote.principal_point_a_px);
        let norm = f.norm();
        if !norm.is_finite() || norm <= 0.0 {
            return None;
        }
        let f = f / norm;
        let row = |i: usize| f.row(i).transpose();
        let (r0, r1, r2) = (row(0), row(1), row(2));
        let cofactors =
            Matrix3::from_rows(&[r1.cross(&r2).transpose(), r2.cross(&r0).transpose(), r0.cross(&r1).transpose()]);
        let blocks = |m: &Matrix3<f64>| {
            [
                m.fixed_view::<2, 2>(0, 0).norm_squared(),
                m.fixed_view::<2, 1>(0, 2).norm_squared(),
                m.fixed_view::<1, 2>(2, 0).norm_squared(),
                m[(2, 2)] * m[(2, 2)],
            ]
        };
        Some(Self { entries: blocks(&f), cofactors: blocks(&cofactors) })
    }

    /// `1 - s2 / s1` at the focal lengths of a and b, in the unit given to [`Blocks::new`].
    #[inline]
    fn imbalance(&self, focal_a: f64, focal_b: f64) -> f64 {
        let (a, b) = (focal_a * focal_a, focal_b * focal_b);
        let e = &self.entries;
        let total = e[0] * a * b + e[1] * b + e[2] * a + e[3];
        // Cofactors of diag(b) F diag(a) are those of F times the product of the scales of the other rows and columns.
        let c = &self.cofactors;
        let product_sq = c[0] * a * b + c[1] * a * a * b + c[2] * a * b * b + c[3] * a * a * b * b;
        let difference = (total * total - 4.0 * product_sq).max(0.0).sqrt();
        1.0 - ((total - difference) / (total + difference)).max(0.0).sqrt()
    }
}

/// The focal length of every group.
///
/// # Panics
/// When a vote names a group that is not there.
pub fn vote_focals(votes: &[FocalVote], groups: &[FocalGroup], options: &FocalVotingOptions) -> Vec<FocalEstimate> {
    let mut estimates: Vec<FocalEstimate> = groups
        .iter()
        .map(|group| FocalEstimate {
            focal_px: group.focal_px,
            confidence: f64::from(u8::from(group.fixed)),
            num_pairs: 0,
        })
        .collect();
    // One unit of length for all pairs keeps their polynomials of order 1.
    let unit_px = groups.iter().map(|group| group.long_side_px).fold(1.0, f64::max);
    let pairs: Vec<(&FocalVote, Blocks)> =
        votes.iter().filter_map(|vote| Some((vote, Blocks::new(vote, unit_px)?))).collect();
    let mut members = vec![Vec::new(); groups.len()];
    for (index, (vote, _)) in pairs.iter().enumerate() {
        members[vote.group_a].push(index);
        if vote.group_b != vote.group_a {
            members[vote.group_b].push(index);
        }
    }
    for round in 0..options.rounds {
        let mut settled = true;
        for (id, group) in groups.iter().enumerate() {
            if group.fixed || members[id].is_empty() {
                continue;
            }
            // In the first round partners without a focal length of their own yet have nothing to say, if others do.
            let speaks = |&&index: &&usize| {
                let (vote, _) = &pairs[index];
                let other = if vote.group_a == id { vote.group_b } else { vote.group_a };
                other == id || groups[other].fixed || round > 0
            };
            let mut heard: Vec<&(&FocalVote, Blocks)> = members[id].iter().filter(speaks).map(|&i| &pairs[i]).collect();
            if heard.is_empty() {
                heard = members[id].iter().map(|&i| &pairs[i]).collect();
            }
            let next = tally(id, group, &heard, &estimates, unit_px, options);
            settled &= (next.focal_px / estimates[id].focal_px).ln().abs() < SETTLED_LOG_CHANGE;
            estimates[id] = next;
        }
        if settled {
            break;
        }
    }
    estimates
}

/// A change of the logarithm of a focal length that needs no further round.
const SETTLED_LOG_CHANGE: f64 = 1e-4;
/// Candidates within this factor of the peak belong to it; the best one outside is its rival.
const PEAK_WIDTH: f64 = 1.25;

/// The votes of some pairs on the focal length of one group.
fn tally(
    id: usize,
    group: &FocalGroup,
    heard: &[&(&FocalVote, Blocks)],
    estimates: &[FocalEstimate],
    unit_px: f64,
    options: &FocalVotingOptions,
) -> FocalEstimate {
    let n = options.candidates.max(MIN_CANDIDATES);
    let low = (options.min_focal_ratio * group.long_side_px).ln();
    let step = ((options.max_focal_ratio * group.long_side_px).ln() - low) / (n - 1) as f64;
    let candidate_px = |k: f64| (low + step * k).exp();
    let focals: Vec<f64> = (0..n).map(|k| candidate_px(k as f64) / unit_px).collect();
    let mut score = vec![0.0; n];
    let mut curve = vec![0.0; n];
    let mut possible = 0.0;
    let inverse = 0.5 / (options.sigma * options.sigma);
    for (vote, blocks) in heard {
        let other = |side: usize| if side == id { None } else { Some(estimates[side].focal_px / unit_px) };
        let (fixed_a, fixed_b) = (other(vote.group_a), other(vote.group_b));
        let mut sum = 0.0;
        for (value, &focal) in curve.iter_mut().zip(&focals) {
            let imbalance = blocks.imbalance(fixed_a.unwrap_or(focal), fixed_b.unwrap_or(focal));
            *value = (-imbalance * imbalance * inverse).exp();
            sum += *value;
        }
        let mean = sum / n as f64;
        for (total, value) in score.iter_mut().zip(&curve) {
            *total += vote.weight * (value - mean);
        }
        possible += vote.weight;
    }
    let best = (0..n).fold(0, |best, k| if score[k] > score[best] { k } else { best });
    // A peak at the border is no peak: the votes rise beyond it.
    if best == 0 || best + 1 == n || possible <= 0.0 {
        return FocalEstimate { focal_px: group.focal_px, confidence: 0.0, num_pairs: heard.len() };
    }
    // A parabola through the peak and its neighbours.
    let (left, top, right) = (score[best - 1], score[best], score[best + 1]);
    let bend = left - 2.0 * top + right;
    let offset = if bend < 0.0 { (0.5 * (left - right) / bend).clamp(-0.5, 0.5) } else { 0.0 };
    let reach = (PEAK_WIDTH.ln() / step).ceil() as usize;
    let rival = (0..n).filter(|&k| k.abs_diff(best) > reach).map(|k| score[k]).fold(f64::NEG_INFINITY, f64::max);
    let confidence = ((score[best] - rival) / possible).clamp(0.0, 1.0);
    let focal_px =
        if confidence < options.min_confidence { group.focal_px } else { candidate_px(best as f64 + offset) };
    FocalEstimate { focal_px, confidence, num_pairs: heard.len() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::camera::Normalized;
    use crate::geometry::Rigid3;
    use crate::math::Rng;
    use crate::solvers::eight_point::eight_point;
    use nalgebra::{UnitQuaternion, Vector2, Vector3};

    const LONG_SIDE_PX: f64 = 1600.0;

    fn toward(center: &Vector3<f64>, target: &Vector3<f64>, roll: f64) -> Rigid3 {
        let z = (target - center).normalize();
        let x = Vector3::y().cross(&z).normalize();
        let y = z.cross(&x);
        let world_from_cam = Matrix3::from_columns(&[x, y, z]);
        let mut pose = Rigid3::from_matrix(&world_from_cam.transpose(), Vector3::zeros());
        pose.rotation = UnitQuaternion::from_scaled_axis(Vector3::z() * roll) * pose.rotation;
        Rigid3::from_center(pose.rotation, center)
    }

    /// The fundamental matrix of 200 noisy pairs of two cameras around a scene; `free` lets the cameras look past each other.
    fn vote(rng: &mut Rng, focals_px: (f64, f64), free: bool, noise_px: f64) -> FocalVote {
        let mut pose = |angle: f64| {
            let center = Vector3::new(6.0 * angle.sin(), rng.range(-0.8, 0.8), -6.0 * angle.cos());
            let aim = if free { Vector3::from_fn(|_, _| rng.range(-1.0, 1.0)) } else { Vector3::zeros() };
            let (center, roll) = if free {
                (center * rng.range(0.8, 1.3), rng.range(-0.2, 0.2))
            } else {
                (Vector3::new(center.x, 0.0, center.z), 0.0)
            };
            toward(&center, &aim, roll)
        };
        let (a, b) = (pose(-0.15), pose(0.25));
        let project = |pose: &Rigid3, x: &Vector3<f64>, focal_px: f64| {
            let x = pose.apply(x);
            Vector2::new(800.0, 600.0) + Normalized(x.xy() / x.z).0 * focal_px
        };
        let pairs: Vec<_> = (0..200)
            .map(|_| {
                let x = Vector3::from_fn(|_, _| rng.range(-2.0, 2.0));
                let mut shake = || Vector2::new(rng.normal(), rng.normal()) * noise_px;
                (project(&a, &x, focals_px.0) + shake(), project(&b, &x, focals_px.1) + shake())
            })
            .collect();
        FocalVote {
            fundamental: eight_point(&pairs).unwrap(),
            principal_point_a_px: (800.0, 600.0),
            principal_point_b_px: (800.0, 600.0),
            group_a: 0,
            group_b: 0,
            weight: 1.0,
        }
    }

    fn group(focal_px: f64, fixed: bool) -> FocalGroup {
        FocalGroup { long_side_px: LONG_SIDE_PX, focal_px, fixed }
    }

    #[test]
    fn the_closed_form_agrees_with_singular_values() {
        let mut rng = Rng::from_parts(&[1]);
        let vote = vote(&mut rng, (1500.0, 1500.0), true, 0.5);
        let blocks = Blocks::new(&vote, 1000.0).unwrap();
        for (fa, fb) in [(700.0, 700.0), (1500.0, 1500.0), (900.0, 2500.0)] {
            let k = |f: f64| Matrix3::new(f, 0.0, 800.0, 0.0, f, 600.0, 0.0, 0.0, 1.0);
            let values = (k(fb).transpose() * vote.fundamental * k(fa)).singular_values();
            let imbalance = blocks.imbalance(fa / 1000.0, fb / 1000.0);
            assert!((1.0 - values[1] / values[0] - imbalance).abs() < 1e-6);
        }
    }

    #[test]
    fn a_shared_focal_length_is_found() {
        let mut rng = Rng::from_parts(&[2]);
        for focal_px in [800.0, 1500.0, 4000.0] {
            let votes: Vec<_> = (0..30).map(|_| vote(&mut rng, (focal_px, focal_px), true, 0.5)).collect();
            let found = vote_focals(&votes, &[group(1920.0, false)], &FocalVotingOptions::default())[0];
            assert!((found.focal_px / focal_px - 1.0).abs() < 0.05, "{focal_px}: {found:?}");
            assert!(found.confidence > 0.1, "{focal_px}: {found:?}");
        }
    }

    #[test]
    fn wrong_matrices_do_not_carry_the_vote() {
        let mut rng = Rng::from_parts(&[3]);
        let mut votes: Vec<_> = (0..40).map(|_| vote(&mut rng, (1500.0, 1500.0), true, 0.5)).collect();
        for wrong in votes.iter_mut().step_by(3) {
            wrong.fundamental = random_matrix(&mut rng);
        }
        let found = vote_focals(&votes, &[group(1920.0, false)], &FocalVotingOptions::default())[0];
        assert!((found.focal_px / 1500.0 - 1.0).abs() < 0.05, "{found:?}");
    }

    fn random_matrix(rng: &mut Rng) -> Matrix3<f64> {
        let focals_px = (rng.range(600.0, 4000.0), rng.range(600.0, 4000.0));
        vote(rng, focals_px, true, 5.0).fundamental
    }

    #[test]
    fn axes_that_meet_say_little() {
        let mut rng = Rng::from_parts(&[5]);
        let votes: Vec<_> = (0..30).map(|_| vote(&mut rng, (1500.0, 1500.0), false, 0.5)).collect();
        let found = vote_focals(&votes, &[group(1920.0, false)], &FocalVotingOptions::default())[0];
        assert!(found.confidence < 0.05, "{found:?}");
    }

    #[test]
    fn groups_help_each_other() {
        let mut rng = Rng::from_parts(&[6]);
        let focals_px = [1500.0, 1100.0];
        let mut votes = Vec::new();
        for i in 0..60 {
            let (a, b) = [(0, 0), (0, 1), (1, 1)][i % 3];
            let mut vote = vote(&mut rng, (focals_px[a], focals_px[b]), true, 0.5);
            (vote.group_a, vote.group_b) = (a, b);
            votes.push(vote);
        }
        for fixed in [false, true] {
            let groups = [group(if fixed { 1500.0 } else { 1920.0 }, fixed), group(1920.0, false)];
            let found = vote_focals(&votes, &groups, &FocalVotingOptions::default());
            for (estimate, focal_px) in found.iter().zip(focals_px) {
                assert!((estimate.focal_px / focal_px - 1.0).abs() < 0.05, "{found:?}");
            }
        }
        assert_eq!(vote_focals(&[], &[group(1920.0, false)], &FocalVotingOptions::default())[0].focal_px, 1920.0);
    }
}
