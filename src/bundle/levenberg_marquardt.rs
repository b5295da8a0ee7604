//! The Levenberg-Marquardt loop.
//!
//! Steps solve `(H + lambda D) d = -g` with `D` the diagonal of the Gauss-Newton matrix `H` (Marquardt, 1963). `lambda` follows
//! the ratio of the cost's decrease to the one the model promises (Nielsen, "Damping parameter in Marquardt's method", 1999):
//! an accepted step multiplies it by `max(1/3, 1 - (2 ratio - 1)^3)`, each rejected one by 2, 4, 8, ...

use rayon::prelude::*;

#[cfg(test)]
mod tests;

use super::KeepGoing;
use super::back_substitution::{StepSums, step_points};
use super::elimination::PartialSums;
use super::options::{BundleOptions, StopReason};
use super::pattern::Pattern;
use super::point_block::{MAX_DAMPED_DIAGONAL, MIN_DAMPED_DIAGONAL};
use super::problem::{POSE, Problem, State};
use super::solver::Solver;
use nalgebra::Vector3;

/// Least ratio of actual to promised decrease for a step to be taken. Ceres' default.
const MIN_RATIO: f64 = 1e-3;
/// Bounds of the damping: below, it no longer matters; above, no step is left.
const MIN_DAMPING: f64 = 1e-12;
const MAX_DAMPING: f64 = 1e16;

/// How the loop went.
pub(super) struct Outcome {
    pub stop: StopReason,
    pub iterations: usize,
    pub accepted: usize,
    pub initial_cost: f64,
    pub final_cost: f64,
}

/// The adaptive damping.
struct Damping {
    lambda: f64,
    growth: f64,
}

impl Damping {
    fn accepted(&mut self, ratio: f64) {
        self.lambda = (self.lambda * (1.0 - (2.0 * ratio - 1.0).powi(3)).max(1.0 / 3.0)).max(MIN_DAMPING);
        self.growth = 2.0;
    }

    fn rejected(&mut self) {
        self.lambda *= self.growth;
        self.growth *= 2.0;
    }

    fn is_exhausted(&self) -> bool {
        self.lambda > MAX_DAMPING
    }
}

/// A problem with everything the loop needs, allocated once.
pub(super) struct Minimizer<'a> {
    problem: &'a Problem,
    options: &'a BundleOptions,
    pattern: Pattern,
    solver: Solver,
    parts: Vec<PartialSums>,
    step: Vec<f64>,
    damping_diagonal: Vec<f64>,
}

impl<'a> Minimizer<'a> {
    /// None when the reduced system does not fit into memory.
    pub fn new(problem: &'a Problem, options: &'a BundleOptions) -> Option<Self> {
        let pattern = Pattern::new(problem, options.max_dense_unknowns);
        let solver = Solver::new(&pattern, &problem.slots, problem.num_unknowns).ok()?;
        let parts = pattern.parts.iter().map(|_| PartialSums::default()).collect();
        let step = vec![0.0; problem.num_unknowns];
        let damping_diagonal = step.clone();
        Some(Self { problem, options, pattern, solver, parts, step, damping_diagonal })
    }

    /// Minimises from `state`, which becomes the best state found, as long as `keep_going` allows.
    pub fn run(&mut self, state: &mut State, keep_going: &KeepGoing) -> Outcome {
        let mut trial = state.clone();
        let mut damping = Damping { lambda: self.options.initial_damping, growth: 2.0 };
        let mut outcome =
            Outcome { stop: StopReason::MaxIterations, iterations: 0, accepted: 0, initial_cost: 0.0, final_cost: 0.0 };
        while outcome.iterations < self.options.max_iterations || outcome.iterations == 0 {
            self.linearise(state, damping.lambda);
            let cost = self.parts[0].cost;
            if outcome.iterations == 0 {
                outcome.initial_cost = cost;
                if self.options.max_iterations == 0 {
                    outcome.final_cost = cost;
                    break;
                }
            }
            outcome.final_cost = cost;
            if !keep_going() {
                outcome.stop = StopReason::Interrupted;
                break;
            }
            if self.gradient_vanished() {
                outcome.stop = StopReason::GradientConverged;
                break;
            }
            outcome.iterations += 1;
            let is_solved = self.solve_reduced(damping.lambda);
            if !keep_going() {
                outcome.stop = StopReason::Interrupted;
                break;
            }
            let sums = is_solved.then(|| self.advance(state, &mut trial, damping.lambda));
            let ratio = sums.map(|sums| (cost - sums.cost) / (0.5 * (sums.descent + sums.damped_sq)));
            match (sums, ratio) {
                (Some(sums), Some(ratio)) if ratio > MIN_RATIO && sums.cost < cost => {
                    std::mem::swap(state, &mut trial);
                    outcome.accepted += 1;
                    outcome.final_cost = sums.cost;
                    damping.accepted(ratio);
                    if self.cost_converged(cost, sums.cost) {
                        outcome.stop = StopReason::CostConverged;
                        break;
                    }
                    if self.parameters_converged(&sums) {
                        outcome.stop = StopReason::ParametersConverged;
                        break;
                    }
                }
                (sums, _) => {
                    damping.rejected();
                    if sums.is_some_and(|sums| self.parameters_converged(&sums)) {
                        outcome.stop = StopReason::ParametersConverged;
                        break;
                    }
                    if damping.is_exhausted() {
                        outcome.stop = StopReason::NoDescent;
                        break;
                    }
                }
            }
        }
        outcome
    }

    fn gradient_vanished(&self) -> bool {
        let sums = &self.parts[0];
        let largest = sums.gradient.iter().fold(sums.max_point_gradient, |max, g| max.max(g.abs()));
        largest <= self.options.gradient_tolerance
    }

    fn cost_converged(&self, before: f64, after: f64) -> bool {
        before - after <= self.options.function_tolerance * before
    }

    fn parameters_converged(&self, sums: &StepSums) -> bool {
        let tolerance = self.options.parameter_tolerance;
        sums.step_sq.sqrt() <= tolerance * (sums.size_sq.sqrt() + tolerance)
    }

    /// The reduced system at `state` in the sums of the first part, priors included, without damping of the cameras.
    fn linearise(&mut self, state: &State, damping: f64) {
        let Self { problem, pattern, parts, options, .. } = self;
        let (problem, pattern, loss) = (*problem, &*pattern, options.loss);
        match (&mut parts[..], &pattern.parts[..]) {
            ([sums], [part]) => sums.eliminate(problem, pattern, part, state, loss, damping),
            (sums, ranges) => sums
                .par_iter_mut()
                .zip(ranges)
                .for_each(|(sums, part)| sums.eliminate(problem, pattern, part, state, loss, damping)),
        }
        let (first, others) = parts.split_first_mut().expect("there is at least one part");
        for other in others {
            first.add(other);
        }
        for prior in &problem.priors {
            let (error, slope) = prior.residual(state);
            let slot = problem.cameras[prior.camera].slot.expect("priors are on free parameters") as usize;
            let offset = prior.unknown - problem.slots[slot].first;
            first.values[pattern.diagonal[slot] + offset * (pattern.stride[slot] + 1)] += slope * slope;
            first.diagonal[prior.unknown] += slope * slope;
            first.gradient[prior.unknown] += slope * error;
            first.cost += 0.5 * error * error;
        }
        for &unknown in &problem.held {
            first.gradient[unknown] = 0.0;
        }
    }

    /// Damps the reduced system and solves it for the step of the cameras. False when it is not positive definite.
    fn solve_reduced(&mut self, damping: f64) -> bool {
        let sums = &mut self.parts[0];
        for (slot, at) in self.problem.slots.iter().enumerate() {
            let (diagonal, stride) = (self.pattern.diagonal[slot], self.pattern.stride[slot]);
            for k in 0..at.len {
                let unknown = at.first + k;
                let added = damping * sums.diagonal[unknown].clamp(MIN_DAMPED_DIAGONAL, MAX_DAMPED_DIAGONAL);
                self.damping_diagonal[unknown] = added;
                sums.values[diagonal + k * (stride + 1)] += added;
                self.step[unknown] = -(sums.gradient[unknown] + sums.reduced_gradient[unknown]);
            }
        }
        for &unknown in &self.problem.held {
            self.pattern.isolate(self.problem, unknown, &mut sums.values);
            self.step[unknown] = 0.0;
        }
        self.problem.num_unknowns == 0
            || (self.solver.solve(&mut sums.values, &mut self.step) && self.step.iter().all(|s| s.is_finite()))
    }

    /// Takes the step from `state` into `trial`.
    fn advance(&self, state: &State, trial: &mut State, damping: f64) -> StepSums {
        let mut sums = StepSums::default();
        let gradient = &self.parts[0].gradient;
        for (unknown, step) in self.step.iter().enumerate() {
            sums.descent -= step * gradient[unknown];
            sums.damped_sq += self.damping_diagonal[unknown] * step * step;
            sums.step_sq += step * step;
        }
        for (rank, block) in self.problem.poses.iter().enumerate() {
            let Some(slot) = block.slot else { continue };
            let step = &self.step[self.problem.slots[slot as usize].first..][..POSE];
            let (omega, v) = (Vector3::from_row_slice(&step[..3]), Vector3::from_row_slice(&step[3..]));
            trial.poses[rank] = state.poses[rank].step(&omega, &v);
            sums.size_sq += 1.0 + state.poses[rank].translation.norm_squared();
        }
        let mut is_possible = true;
        for (rank, block) in self.problem.cameras.iter().enumerate() {
            let Some(slot) = block.slot else { continue };
            let first = self.problem.slots[slot as usize].first;
            let (before, camera) = (&state.cameras[rank], &mut trial.cameras[rank]);
            for (step, &(parameter, _)) in self.step[first..].iter().zip(&block.free) {
                camera.params[parameter] = before.params[parameter] + step;
                sums.size_sq += before.params[parameter].powi(2);
            }
            let (fx, fy) = camera.focal();
            is_possible &= fx > 0.0 && fy > 0.0;
        }
        trial.refresh();
        let mut points = std::mem::take(&mut trial.points);
        sums = sums.plus(self.step_points(state, trial, damping, &mut points));
        trial.points = points;
        for prior in &self.problem.priors {
            let (error, _) = prior.residual(trial);
            sums.cost += 0.5 * error * error;
        }
        if !is_possible {
            sums.cost = f64::INFINITY;
        }
        sums
    }

    fn step_points(&self, state: &State, trial: &State, damping: f64, points: &mut [[f64; 3]]) -> StepSums {
        let (problem, loss, dc) = (self.problem, self.options.loss, &self.step[..]);
        if let [part] = &self.pattern.parts[..] {
            return step_points(problem, part, (state, trial), dc, loss, damping, points);
        }
        let mut rest = points;
        let mut slices = Vec::with_capacity(self.pattern.parts.len());
        for part in &self.pattern.parts {
            let (own, others) = rest.split_at_mut(part.end_point - part.first_point);
            slices.push((part, own));
            rest = others;
        }
        let sums: Vec<StepSums> = slices
            .into_par_iter()
            .map(|(part, own)| step_points(problem, part, (state, trial), dc, loss, damping, own))
            .collect();
        sums.into_iter().fold(StepSums::default(), StepSums::plus)
    }
}
