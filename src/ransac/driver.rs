//! The loop: draw a sample, solve, score, and refine what is best so far.
//!
//! LO-RANSAC (Chum, Matas, Kittler, "Locally Optimized RANSAC", DAGM 2003) with the truncated quadratic cost of MSAC (Torr
//! and Zisserman, "MLESAC", CVIU 2000): `cost = sum min(r^2, T^2)`. Scoring stops as soon as the cost exceeds the best so
//! far. The loop knows no geometry; everything it needs comes from an [`Estimator`]. It allocates before the first trial
//! only, and draws from the generator it is given, so its result depends on nothing else.

use serde::{Deserialize, Serialize};

use crate::math::Rng;
use crate::solvers::Solutions;

/// The most candidates a sample may give.
pub const MAX_MODELS: usize = 10;

/// The candidates of one sample.
pub type Models<M> = Solutions<M, MAX_MODELS>;

/// A model class: how to make models from data and how well they explain it.
pub trait Estimator<const SAMPLE_SIZE: usize> {
    /// A candidate model.
    type Model: Copy;

    /// Number of data.
    fn num_data(&self) -> usize;

    /// The models of a sample of distinct data; leaves `models` empty for a degenerate sample.
    fn solve(&self, sample: &[usize; SAMPLE_SIZE], models: &mut Models<Self::Model>);

    /// The squared residual of a datum; infinite where the model can't explain it at all.
    fn residual_sq(&self, model: &Self::Model, datum: usize) -> f64;

    /// A better model from the data `inliers` of `model`, `threshold_sq` being the squared residual up to which a datum is
    /// one; none when there is nothing to gain.
    fn refine(&self, model: &Self::Model, inliers: &[usize], threshold_sq: f64) -> Option<Self::Model>;
}

/// The most trials that options may ask for. A loop is never left in the middle, so this bounds what a cancelled run
/// still does: some seconds.
const MOST_TRIALS: usize = 100_000;

/// When to stop.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct RansacOptions {
    /// Probability with which a sample without outliers must have been drawn before the loop stops. Raising it costs
    /// trials. (COLMAP: 0.999 for two views, 0.99999 for poses.)
    pub confidence: f64,
    /// Trials made in any case.
    pub min_trials: usize,
    /// Trials never exceeded, at most 100000: what a hopeless problem costs.
    pub max_trials: usize,
    /// Inlier ratio below which the model is not wanted: trials that only a lower ratio would need are not made.
    pub min_inlier_ratio: f64,
    /// Factor on the number of trials the confidence asks for, because a sample without outliers may still be too noisy or
    /// too narrow to find all inliers. (COLMAP: 3.)
    pub trials_factor: f64,
}

impl Default for RansacOptions {
    fn default() -> Self {
        Self { confidence: 0.999, min_trials: 30, max_trials: 10_000, min_inlier_ratio: 0.25, trials_factor: 2.0 }
    }
}

impl RansacOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if !(self.confidence > 0.0 && self.confidence < 1.0) {
            errors.push(format!("confidence must lie between 0 and 1, not {}", self.confidence));
        }
        if self.max_trials == 0 || self.min_trials > self.max_trials {
            errors.push(format!("min_trials {} exceeds max_trials {}", self.min_trials, self.max_trials));
        }
        if self.max_trials > MOST_TRIALS {
            errors.push(format!("max_trials must be at most {MOST_TRIALS}, not {}", self.max_trials));
        }
        if !(0.0..=1.0).contains(&self.min_inlier_ratio) {
            errors.push(format!("min_inlier_ratio must lie in [0, 1], not {}", self.min_inlier_ratio));
        }
        if !(self.trials_factor >= 1.0 && self.trials_factor.is_finite()) {
            errors.push(format!("trials_factor must be at least 1, not {}", self.trials_factor));
        }
    }

    /// The trials that find a sample of `size` inliers among `inliers` of `data` with the confidence asked for:
    /// `log(1 - confidence) / log(1 - ratio^size)`, times the factor, between the bounds.
    pub fn trials_for(&self, inliers: usize, data: usize, size: usize) -> usize {
        let good = (0..size).fold(1.0, |p, k| p * inliers.saturating_sub(k) as f64 / (data.max(k + 1) - k) as f64);
        let trials = if good >= 1.0 {
            0.0
        } else if good <= 0.0 {
            f64::INFINITY
        } else {
            self.trials_factor * (1.0 - self.confidence).ln() / (-good).ln_1p()
        };
        // A float beyond the range of usize saturates.
        (trials.ceil() as usize).clamp(self.min_trials, self.max_trials)
    }
}

/// The best model and how it was found.
#[derive(Clone, Debug)]
pub struct RansacReport<M> {
    /// The model.
    pub model: M,
    /// Which data are within the threshold.
    pub inliers: Vec<bool>,
    /// How many.
    pub num_inliers: usize,
    /// `sum min(r^2, T^2)`.
    pub cost: f64,
    /// Samples drawn.
    pub trials: usize,
}

/// Rounds of refinement on the inliers of the refined model, for each new best model.
const LOCAL_ROUNDS: usize = 4;
/// A refinement that lowers the cost by a smaller share is the last one.
const MIN_GAIN_SHARE: f64 = 1e-3;

struct Scorer<'a, E, const SAMPLE_SIZE: usize> {
    estimator: &'a E,
    threshold_sq: f64,
    inliers: Vec<usize>,
}

impl<E: Estimator<SAMPLE_SIZE>, const SAMPLE_SIZE: usize> Scorer<'_, E, SAMPLE_SIZE> {
    /// The cost of a model, or none once it exceeds `best`.
    fn cost_below(&self, model: &E::Model, best: f64) -> Option<f64> {
        let mut cost = 0.0;
        for datum in 0..self.estimator.num_data() {
            // A NaN residual counts as an outlier: `min` returns the other operand.
            cost += self.estimator.residual_sq(model, datum).min(self.threshold_sq);
            if cost >= best {
                return None;
            }
        }
        Some(cost)
    }

    fn collect_inliers(&mut self, model: &E::Model) {
        self.inliers.clear();
        for datum in 0..self.estimator.num_data() {
            if self.estimator.residual_sq(model, datum) < self.threshold_sq {
                self.inliers.push(datum);
            }
        }
    }

    /// Refines a model on its own inliers while that lowers the cost; leaves the inliers of the result collected.
    fn optimize(&mut self, mut model: E::Model, mut cost: f64) -> (E::Model, f64) {
        self.collect_inliers(&model);
        for _ in 0..LOCAL_ROUNDS {
            let Some(refined) = self.estimator.refine(&model, &self.inliers, self.threshold_sq) else { break };
            let Some(refined_cost) = self.cost_below(&refined, cost) else { break };
            let last = refined_cost > cost * (1.0 - MIN_GAIN_SHARE);
            (model, cost) = (refined, refined_cost);
            self.collect_inliers(&model);
            if last {
                break;
            }
        }
        (model, cost)
    }
}

/// The model with the least cost at a residual threshold (in the estimator's units); none when no sample gave a model with
/// as many inliers as a sample has data.
pub fn ransac<E: Estimator<SAMPLE_SIZE>, const SAMPLE_SIZE: usize>(
    estimator: &E,
    threshold: f64,
    options: &RansacOptions,
    rng: &mut Rng,
) -> Option<RansacReport<E::Model>> {
    let data = estimator.num_data();
    if data < SAMPLE_SIZE {
        return None;
    }
    let mut scorer = Scorer { estimator, threshold_sq: threshold * threshold, inliers: Vec::with_capacity(data) };
    let fewest = (options.min_inlier_ratio * data as f64).ceil() as usize;
    let hopeless = options.trials_for(fewest.max(SAMPLE_SIZE + 1), data, SAMPLE_SIZE);
    let mut wanted = hopeless;
    let mut best: Option<(E::Model, f64, usize)> = None;
    // The best cost of an unrefined model: a new sample model must beat it to be worth refining.
    let mut best_sampled = f64::INFINITY;
    let mut models = Models::default();
    let mut trials = 0;
    while trials < wanted {
        trials += 1;
        models.clear();
        estimator.solve(&rng.distinct::<SAMPLE_SIZE>(data), &mut models);
        for model in models.iter() {
            let Some(cost) = scorer.cost_below(model, best_sampled) else { continue };
            best_sampled = cost;
            let (model, cost) = scorer.optimize(*model, cost);
            if best.as_ref().is_none_or(|(_, least, _)| cost < *least) {
                best = Some((model, cost, scorer.inliers.len()));
                wanted = options.trials_for(scorer.inliers.len(), data, SAMPLE_SIZE).min(hopeless);
            }
        }
    }
    let (model, cost, num_inliers) = best?;
    if num_inliers < SAMPLE_SIZE {
        return None;
    }
    let inliers = (0..data).map(|datum| estimator.residual_sq(&model, datum) < scorer.threshold_sq).collect();
    Some(RansacReport { model, inliers, num_inliers, cost, trials })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Lines `y = m x + c` through points.
    struct Lines(Vec<(f64, f64)>);

    impl Estimator<2> for Lines {
        type Model = (f64, f64);

        fn num_data(&self) -> usize {
            self.0.len()
        }

        fn solve(&self, &[i, j]: &[usize; 2], models: &mut Models<(f64, f64)>) {
            let ((x0, y0), (x1, y1)) = (self.0[i], self.0[j]);
            if x0 != x1 {
                let slope = (y1 - y0) / (x1 - x0);
                models.push((slope, y0 - slope * x0));
            }
        }

        fn residual_sq(&self, &(slope, offset): &(f64, f64), datum: usize) -> f64 {
            let (x, y) = self.0[datum];
            (slope * x + offset - y).powi(2)
        }

        fn refine(&self, _: &(f64, f64), inliers: &[usize], _: f64) -> Option<(f64, f64)> {
            let n = inliers.len() as f64;
            let mean = |f: &dyn Fn((f64, f64)) -> f64| inliers.iter().map(|&i| f(self.0[i])).sum::<f64>() / n;
            let (x, y) = (mean(&|p| p.0), mean(&|p| p.1));
            let slope = mean(&|p| (p.0 - x) * (p.1 - y)) / mean(&|p| (p.0 - x).powi(2));
            slope.is_finite().then_some((slope, y - slope * x))
        }
    }

    fn scene(outliers: usize) -> Lines {
        let mut rng = Rng::from_parts(&[5]);
        let mut points: Vec<_> = (0..200)
            .map(|i| {
                let x = rng.range(-1.0, 1.0);
                if i < outliers { (x, rng.range(-5.0, 5.0)) } else { (x, 2.0 * x + 0.5 + 0.01 * rng.normal()) }
            })
            .collect();
        rng.shuffle(&mut points);
        Lines(points)
    }

    #[test]
    fn finds_the_line_among_many_outliers() {
        for outliers in [0, 100, 150] {
            let options = RansacOptions { min_inlier_ratio: 0.1, ..RansacOptions::default() };
            let report = ransac(&scene(outliers), 0.04, &options, &mut Rng::from_parts(&[1])).unwrap();
            assert!((report.model.0 - 2.0).abs() < 0.01 && (report.model.1 - 0.5).abs() < 0.01, "{report:?}");
            assert!(report.num_inliers >= 200 - outliers - 2);
            assert_eq!(report.num_inliers, report.inliers.iter().filter(|&&inlier| inlier).count());
            assert!(report.trials >= options.min_trials && report.trials <= options.max_trials);
        }
    }

    #[test]
    fn the_same_seed_gives_the_same_result_and_too_few_data_none() {
        let options = RansacOptions::default();
        let run = || ransac(&scene(80), 0.04, &options, &mut Rng::from_parts(&[9])).unwrap();
        assert_eq!((run().model, run().trials), (run().model, run().trials));
        assert!(ransac(&Lines(vec![(0.0, 0.0)]), 0.1, &options, &mut Rng::from_parts(&[9])).is_none());
    }

    #[test]
    fn trials_follow_the_formula() {
        let options =
            RansacOptions { min_trials: 1, max_trials: 1_000_000, trials_factor: 1.0, ..RansacOptions::default() };
        // With replacement-free draws of 5 among half inliers of many: close to ln(0.001) / ln(1 - 1/32) = 217.6.
        assert!((218..=225).contains(&options.trials_for(5000, 10_000, 5)));
        assert_eq!(options.trials_for(10, 10, 5), 1);
        assert_eq!(options.trials_for(3, 10, 5), 1_000_000);
    }
}
