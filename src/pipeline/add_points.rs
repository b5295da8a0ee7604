//! The stage `add_points`: guided matching of a model's pairs, unit by unit, and what they show brought into the model.

use std::collections::BTreeSet;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use rayon::prelude::*;

use super::features::StoredFeatures;
use super::runner::{Counts, StageProgress, counts};
use super::units::Units;
use super::{Context, PipelineError, Stage};
use crate::add_points::{
    AddPointsError, AddPointsOptions, AddPointsReport, CandidatePair, PairMatcher, PairMatches, PairOfSightings,
    add_matches, candidate_pairs, tiles,
};
use crate::scene::{Features, ImageId, Reconstruction};

/// Pairs of a unit of work. A pair of two large photographs takes 0.05 CPU seconds, so a stop costs a thread two
/// seconds at most, and storing a unit less than a hundredth of what it took to find.
const UNIT_PAIRS: usize = 32;

/// What the stage is given besides the models.
pub struct PointAdder<'a> {
    /// Features of every image.
    pub features: &'a StoredFeatures<'a>,
    /// Where finished units are kept.
    pub units: &'a Units<'a>,
    /// How.
    pub options: &'a AddPointsOptions,
    /// Seed and cancel.
    pub context: &'a Context,
}

impl PointAdder<'_> {
    /// Adds points to the model of this rank; with `new_images`, only pairs with one of them are matched. Returns matches that
    /// may still become points, too ([`add_matches`]).
    ///
    /// # Errors
    /// Cancellation, features that were lost, or units that can't be stored.
    pub fn run(
        &self,
        rank: usize,
        model: &mut Reconstruction,
        new_images: Option<&BTreeSet<ImageId>>,
        progress: &StageProgress<'_>,
    ) -> Result<(Counts, Vec<PairOfSightings>), PipelineError> {
        let pairs = candidate_pairs(model, new_images, &self.options.candidate_pairs);
        let (matches, reused) = self.match_pairs(rank, model, &pairs, progress)?;
        let cancelled = || self.context.cancel.is_cancelled();
        let (report, unconfirmed) = self.expect(add_matches(model, matches, self.options, &cancelled))?;
        Ok((totals(&report, reused), unconfirmed))
    }

    /// The matches of all pairs, and how many of these an earlier run had matched.
    fn match_pairs(
        &self,
        rank: usize,
        model: &Reconstruction,
        pairs: &[CandidatePair],
        progress: &StageProgress<'_>,
    ) -> Result<(Vec<PairMatches>, usize), PipelineError> {
        let done = AtomicUsize::new(0);
        let more = |count: usize| {
            progress.set((done.fetch_add(count, Ordering::Relaxed) + count) as u64, pairs.len() as u64);
        };
        let cancelled = || self.context.cancel.is_cancelled();
        // The matcher keeps them while it needs them.
        let features = |id: ImageId| -> Arc<Features> { Arc::new(self.features.read(id, None)) };
        let mut matcher = PairMatcher::new(model, &features, self.options, self.context.seed);
        let mut matches: Vec<PairMatches> = Vec::with_capacity(pairs.len());
        let mut reused = 0;
        for tile in tiles(model, pairs, &self.options.blocks) {
            self.context.check_cancelled()?;
            let (known, waiting): (Vec<Vec<PairMatches>>, _) = self.units.split(rank, tile.chunks(UNIT_PAIRS))?;
            let count = tile.len() - waiting.iter().map(|unit| unit.len()).sum::<usize>();
            reused += count;
            more(count);
            matches.extend(known.into_iter().flatten());
            self.expect(matcher.prepare(waiting.iter().copied().flatten(), &cancelled))?;
            let found = waiting.into_par_iter().map(|unit| {
                let found = self.expect(matcher.match_pairs(unit, &|| more(1), &cancelled))?;
                self.units.keep(&(rank, unit), &found)?;
                Ok(found)
            });
            let found: Vec<Vec<PairMatches>> = found.collect::<Result<_, PipelineError>>()?;
            matches.extend(found.into_iter().flatten());
        }
        Ok((matches, reused))
    }

    /// The outcome of a step, or why there is none: features that do not fit the model are features that were lost.
    fn expect<T>(&self, outcome: Result<T, AddPointsError>) -> Result<T, PipelineError> {
        self.context.check_cancelled()?;
        self.features.check(Stage::AddPoints)?;
        Ok(outcome.expect("neither cancelled nor with lost features"))
    }
}

fn totals(report: &AddPointsReport, reused: usize) -> Counts {
    counts([
        ("pairs_tried", report.pairs_tried),
        ("pairs_reused", reused),
        ("pairs_matched", report.pairs_matched),
        ("matches", report.matches),
        ("points_before", report.points_before),
        ("points", report.points_after),
        ("points_3plus_before", report.points_3plus_before),
        ("points_3plus", report.points_3plus_after),
        ("observations", report.observations_after),
    ])
}
