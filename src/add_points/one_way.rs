//! The nearest candidate of each query of one image in another, and the ratio test (paper, sections 6.2.2 and 6.2.3): one
//! direction of a guided match.
//!
//! Two ways: a sweep of all queries' bands ([`super::sweep`]), or, as the paper has it, the queries in groups with a
//! common line whose candidates are gathered once ([`super::line_groups`], [`super::candidate_search`]).
//!
//! A sweep sees the distance of every query from every candidate, so it also tells which query is nearest to a candidate:
//! whether a match is mutual needs no way back.

use nalgebra::Vector2;

use super::candidate_search::{CandidateSearch, SeenMarks};
use super::epipolar::{BoundingBox, EpipolarGeometry, EpipolarLine, finite};
use super::line_groups::group_by_line;
use super::options::GuidedMatchOptions;
use super::pencil::Turn;
use super::prepared::PreparedImage;
use super::sweep::Sweep;
use crate::camera::Normalized;
use crate::matching::descriptor::{
    BandQuery, BandTop2, BandedRows, NearestQueries, PackedDescriptors, Top2, distance_sq, least_distance_sq,
    nearest_off_bands, top2, top2_in_bands,
};
use crate::math::Rng;
use crate::scene::Descriptor;

/// A query's match.
#[derive(Clone, Copy, Debug)]
pub struct Found {
    /// The query's keypoint.
    pub query: u32,
    /// The target's keypoint.
    pub target: u32,
    /// Squared distance of their descriptors.
    pub distance_sq: u32,
    /// Whether it passes the stricter ratio test of matches that nothing else confirms.
    pub distinctive: bool,
}

/// The search for one image's queries in another.
pub struct OneWay<'a> {
    /// The image that asks.
    pub query: &'a PreparedImage,
    /// The image searched.
    pub target: &'a PreparedImage,
    /// From query to target.
    pub geometry: &'a EpipolarGeometry,
    /// How.
    pub options: &'a GuidedMatchOptions,
    /// Whether the ratio test must pass.
    pub check_ratio: bool,
}

impl OneWay<'_> {
    /// The matches of these queries, by query. `rng` chooses the rivals of small candidate sets.
    pub fn run(&self, queries: impl Iterator<Item = u32>, mut rng: Rng) -> Vec<Found> {
        let Some(bounds) = self.target.finder.bounds() else { return Vec::new() };
        let mut found = match self.options.search {
            CandidateSearch::Sweep => self.by_sweep(queries, &bounds, |_, _, _| true, &mut rng),
            _ => self.by_groups(queries, &bounds, &mut rng),
        };
        found.sort_unstable_by_key(|found| found.query);
        found
    }

    /// By a sweep, the matches of the queries that `open` names, by query, as far as no other query is nearer to the target.
    /// All queries compete for the targets. A target too near to its epipole has no match, as it would have none if it asked.
    pub fn run_mutual(&self, open: impl Fn(u32) -> bool, mut rng: Rng) -> Vec<Found> {
        let Some(bounds) = self.target.finder.bounds() else { return Vec::new() };
        let queries = self.query.finder.members().iter().copied();
        let epipole = finite(&self.geometry.epipole_in_target());
        let is_mutual = |query: (usize, u32), target: (u32, u32), nearest: &NearestQueries| {
            nearest.of(target.0) == Some(query.0) && open(query.1) && self.is_clear(self.target, epipole, target.1)
        };
        let mut found = self.by_sweep(queries, &bounds, is_mutual, &mut rng);
        found.sort_unstable_by_key(|found| found.query);
        found
    }

    /// Whether a feature of either image is far enough from the image's epipole for its line to say something.
    fn is_clear(&self, image: &PreparedImage, epipole: Option<Vector2<f64>>, feature: u32) -> bool {
        let clearance_px = self.options.epipole_clearance_bands * self.options.band_px * image.px_scale;
        epipole.is_none_or(|e| (image.finder.positions()[feature as usize] - e).norm() >= clearance_px)
    }

    /// Those of the queries that are clear of the epipole, with their positions.
    fn clear(&self, queries: impl Iterator<Item = u32>) -> impl Iterator<Item = (u32, Normalized)> {
        let epipole = self.geometry.epipole_in_query();
        let clear = queries.filter(move |&query| self.is_clear(self.query, epipole, query));
        clear.map(|query| (query, self.query.normalized[query as usize]))
    }

    fn band_px(&self) -> f64 {
        self.options.band_px * self.target.px_scale
    }

    /// The matches of the queries by a sweep. A query (its rank and feature) and its nearest candidate (its slot and feature)
    /// are judged only where they are `wanted`, given which query is nearest to each slot.
    fn by_sweep(
        &self,
        queries: impl Iterator<Item = u32>,
        bounds: &BoundingBox,
        wanted: impl Fn((usize, u32), (u32, u32), &NearestQueries) -> bool,
        rng: &mut Rng,
    ) -> Vec<Found> {
        let (target, band_px) = (self.target, self.band_px());
        let (positions, members) = (target.finder.positions(), target.finder.members());
        let descriptors = &target.features.descriptors;
        let sweep = Sweep::new(&self.geometry.epipole_in_target(), bounds, positions, descriptors, members);
        let asked: Vec<_> = self
            .clear(queries)
            .filter_map(|(query, at)| {
                let coefficients = self.geometry.line_coefficients(&at);
                let line = EpipolarLine::from_coefficients(&coefficients)?;
                Some((sweep.pencil().line(&coefficients), line, query))
            })
            .collect();
        // Only what the order depends on is sorted, an eighth of the bytes.
        let mut order: Vec<(Turn, u32)> =
            asked.iter().zip(0..).map(|((of_pencil, ..), at)| (of_pencil.turn, at)).collect();
        order.sort_unstable();
        let asked: Vec<_> = order.into_iter().map(|(_, at)| asked[at as usize]).collect();

        let (mut bands, mut windows) = (Vec::with_capacity(asked.len()), Vec::new());
        let mut cursor = sweep.cursor();
        for (of_pencil, line, query) in &asked {
            bands.push(sweep.query(&self.query.features.descriptors[*query as usize], line, band_px));
            sweep.windows(of_pencil, band_px, &mut cursor, &mut windows);
        }
        let (mut nearest, mut of_rows) = (Vec::new(), NearestQueries::default());
        top2_in_bands(&bands, &windows, sweep.rows(), &mut nearest, &mut of_rows);
        for (at, (nearest, &(_, _, query))) in nearest.iter_mut().zip(&asked).enumerate() {
            nearest.nearest = nearest.nearest.filter(|&(slot, _)| {
                sweep.feature(slot).is_some_and(|feature| wanted((at, query), (slot, feature), &of_rows))
            });
        }
        let rivals = self.random_rivals(&sweep, &bands, &nearest, rng);

        let per_line = sweep.windows_per_line();
        let (mut found, mut elsewhere) = (Vec::new(), Vec::new());
        for (at, (&(_, _, query), nearest)) in asked.iter().zip(&nearest).enumerate() {
            let Some((slot, best_sq)) = nearest.nearest else { continue };
            let Some(best) = sweep.feature(slot) else { continue };
            let second = least(nearest.second_distance_sq, rivals[at]);
            let second_elsewhere = || {
                // The second is a rival unless it is at the best one's place; only then are all candidates looked at again.
                let here = target.same_place.others(best);
                let to = |feature: u32| distance_sq(bands[at].descriptor, &descriptors[feature as usize]);
                let in_band = |feature: u32| sweep.contains(&bands[at], &positions[feature as usize]);
                let is_here = |&feature: &u32| in_band(feature) && Some(to(feature)) == nearest.second_distance_sq;
                if !here.iter().any(is_here) {
                    return second;
                }
                let others = sweep.features_in_band(&bands[at], &windows[at * per_line..(at + 1) * per_line]);
                let others = others.filter(|feature| *feature != best && here.binary_search(feature).is_err());
                elsewhere.clear();
                elsewhere.extend(others);
                least(least_distance_sq(bands[at].descriptor, descriptors, &elsewhere), rivals[at])
            };
            self.judge(query, best, best_sq, second, second_elsewhere, &mut found);
        }
        found
    }

    /// For every query with few candidates the squared distance to the nearest of some random features beyond its band, which
    /// fill its candidates up.
    fn random_rivals(
        &self,
        sweep: &Sweep,
        bands: &[BandQuery<'_>],
        nearest: &[BandTop2],
        rng: &mut Rng,
    ) -> Vec<Option<u32>> {
        let members = self.target.finder.members();
        let mut chosen = Vec::new();
        Padding::new(members, rng).fill(&mut chosen, self.options.pad_to, |_| true, rng);
        let mut pads = BandedRows::default();
        sweep.append_to(&mut pads, &self.target.features.descriptors, &chosen, self.target.finder.positions());
        let wanted = |nearest: &BandTop2| (self.options.pad_to as u32).saturating_sub(nearest.candidates);
        let few: Vec<usize> =
            (0..bands.len()).filter(|&at| nearest[at].nearest.is_some() && wanted(&nearest[at]) > 0).collect();
        let queries: Vec<BandQuery<'_>> = few.iter().map(|&at| bands[at]).collect();
        let ranks: Vec<u32> = few.iter().map(|&at| wanted(&nearest[at])).collect();
        let mut distances = Vec::new();
        nearest_off_bands(&queries, &ranks, &pads, &mut distances);
        let mut rivals = vec![None; bands.len()];
        for (at, distance) in few.into_iter().zip(distances) {
            rivals[at] = distance;
        }
        rivals
    }

    fn by_groups(&self, queries: impl Iterator<Item = u32>, bounds: &BoundingBox, rng: &mut Rng) -> Vec<Found> {
        let band_px = self.band_px();
        let tolerance_px = self.options.group_tolerance_px * self.target.px_scale;
        let groups = group_by_line(self.geometry, self.clear(queries), &bounds.grown(band_px), tolerance_px);
        let pads = Padding::new(self.target.finder.members(), rng);
        let (mut marks, mut rows) = (SeenMarks::default(), Vec::new());
        let (mut packed, mut nearest) = (PackedDescriptors::new(), Vec::new());
        let mut descriptors: Vec<Descriptor> = Vec::new();
        let mut found = Vec::new();
        for group in &groups {
            self.target.finder.near_line(&group.anchor, &mut marks, &mut rows);
            let candidates = rows.len();
            if candidates == 0 {
                continue;
            }
            pads.fill(&mut rows, self.options.pad_to, |feature| marks.mark(feature), rng);
            packed.repack_subset(&self.target.features.descriptors, &rows);
            descriptors.clear();
            descriptors.extend(group.queries.iter().map(|&q| self.query.features.descriptors[q as usize]));
            top2(&descriptors, &packed, &mut nearest);
            for (&query, nearest) in group.queries.iter().zip(&nearest) {
                if nearest.index as usize >= candidates || !self.is_near(query, rows[nearest.index as usize], band_px) {
                    continue;
                }
                let target = rows[nearest.index as usize];
                let elsewhere = || self.second_distance_sq(query, nearest, &rows, &marks);
                self.judge(query, target, nearest.distance_sq, nearest.second_distance_sq, elsewhere, &mut found);
            }
        }
        found
    }

    /// The ratio test. `second_sq` belongs to the nearest rival, which may be at the best one's place and so none; `elsewhere`
    /// then gives the nearest that is not, which is no nearer and costs more.
    fn judge(
        &self,
        query: u32,
        target: u32,
        distance_sq: u32,
        second_sq: Option<u32>,
        elsewhere: impl FnOnce() -> Option<u32>,
        found: &mut Vec<Found>,
    ) {
        let passes = |second: Option<u32>, max_ratio: f64| {
            let allowed = |second: u32| max_ratio * max_ratio * f64::from(second);
            second.is_some_and(|second| f64::from(distance_sq) <= allowed(second))
        };
        let distinctive_ratio = self.options.distinctive_ratio;
        let second = if passes(second_sq, distinctive_ratio) { second_sq } else { elsewhere() };
        if !self.check_ratio || passes(second, self.options.max_ratio) {
            found.push(Found { query, target, distance_sq, distinctive: passes(second, distinctive_ratio) });
        }
    }

    /// The exact distance test (equation 3) against the query's own line, not only its group's.
    fn is_near(&self, query: u32, target: u32, band_px: f64) -> bool {
        let position = &self.target.finder.positions()[target as usize];
        let line = self.geometry.line_in_target(&self.query.normalized[query as usize]);
        line.is_some_and(|line| line.distance_px(position) <= band_px)
    }

    /// The squared distance to the nearest row that is not at the best one's place.
    fn second_distance_sq(&self, query: u32, nearest: &Top2, rows: &[u32], marks: &SeenMarks) -> Option<u32> {
        let second = nearest.second_distance_sq?;
        let best = rows[nearest.index as usize];
        let here = self.target.same_place.others(best);
        let descriptor = &self.query.features.descriptors[query as usize];
        let distance_to = |row: u32| distance_sq(descriptor, &self.target.features.descriptors[row as usize]);
        if !here.iter().any(|&row| marks.is_marked(row) && distance_to(row) == second) {
            return Some(second);
        }
        let elsewhere = rows.iter().filter(|&&row| row != best && here.binary_search(&row).is_err());
        elsewhere.map(|&row| distance_to(row)).min()
    }
}

/// The lesser of two distances, as far as they are there.
fn least(a: Option<u32>, b: Option<u32>) -> Option<u32> {
    match (a, b) {
        (Some(a), Some(b)) => Some(a.min(b)),
        (one, other) => one.or(other),
    }
}

/// Random features of the target to fill small candidate sets.
struct Padding {
    shuffled: Vec<u32>,
}

impl Padding {
    fn new(members: &[u32], rng: &mut Rng) -> Self {
        let mut shuffled = members.to_vec();
        rng.shuffle(&mut shuffled);
        Self { shuffled }
    }

    /// Appends features that `take` takes until there are `wanted` rows or no more features.
    fn fill(&self, rows: &mut Vec<u32>, wanted: usize, mut take: impl FnMut(u32) -> bool, rng: &mut Rng) {
        if rows.len() >= wanted {
            return;
        }
        let n = self.shuffled.len();
        let start = rng.below(n);
        for step in 0..n {
            if rows.len() >= wanted {
                return;
            }
            let feature = self.shuffled[(start + step) % n];
            if take(feature) {
                rows.push(feature);
            }
        }
    }
}
