//! A guess at how long a job will still take, from the job's own measured rates.
//!
//! What is left of the running stage is told by its own rate: the time it took so far over the units it did. Stages to come
//! are told by the stages done: every stage has a weight, its usual share of a run, and the job's own seconds per weight say
//! how fast this machine is on these photographs. Stages that were re-used took no time and count neither way.

use serde::Serialize;

use crate::store::db::job_stages::JobStageRow;

/// Usual shares of a run, features 100: between those of small photographs, few of which share what they show, and large
/// ones that all do. Only their ratios matter. (Measured on sets of 11, 30 and 128 photographs; see [`LATER_ROUND_SHARE`] too.)
const WEIGHTS: [(&str, f64); 8] = [
    ("intake", 1.0),
    ("features", 100.0),
    ("coarse_match", 14.0),
    ("coarse_model", 8.0),
    ("add_cameras", 1.0),
    ("add_points", 40.0),
    ("refine", 4.0),
    ("export", 10.0),
];
/// A later round of adding points matches only pairs with cameras that are new since the last, as a rule a small share.
const LATER_ROUND_SHARE: f64 = 0.1;
/// A weight for a stage without one.
const UNKNOWN_WEIGHT: f64 = 1.0;
/// Below this share of the work a guess is worth nothing.
const LEAST_KNOWN_SHARE: f64 = 0.03;
/// Below this share of a stage its own rate is worth nothing.
const LEAST_SHARE_FOR_RATE: f64 = 0.05;
/// By what factor the rest of a running stage may be off.
const RUNNING_SPREAD: f64 = 1.15;
/// By what factor the stages to come may be off.
const PENDING_SPREAD: f64 = 1.7;

/// Seconds left.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Eta {
    /// If it goes well.
    pub low: f64,
    /// If it does not.
    pub high: f64,
}

impl Eta {
    /// One after the other.
    pub fn plus(self, other: Self) -> Self {
        Self { low: self.low + other.low, high: self.high + other.high }
    }
}

fn weight(stage: &JobStageRow) -> f64 {
    let known = WEIGHTS.iter().find(|(name, _)| *name == stage.name);
    let weight = known.map_or(UNKNOWN_WEIGHT, |(_, weight)| *weight);
    let later_round = stage.name == "add_points" && stage.iteration.is_some_and(|round| round > 1);
    if later_round { weight * LATER_ROUND_SHARE } else { weight }
}

/// The share of a job's work that is done, from 0 to 1, each stage counted by its usual share of a run; 0 without a plan.
pub fn share_done(stages: &[JobStageRow]) -> f64 {
    let (mut done, mut all) = (0.0, 0.0);
    for stage in stages {
        let weight = weight(stage);
        all += weight;
        done += match stage.state.as_str() {
            "done" | "reused" => weight,
            "running" => weight * running_share(stage),
            _ => 0.0,
        };
    }
    if all > 0.0 { done / all } else { 0.0 }
}

fn running_share(stage: &JobStageRow) -> f64 {
    match stage.total {
        Some(total) if total > 0 => (stage.done as f64 / total as f64).clamp(0.0, 1.0),
        _ => 0.0,
    }
}

/// The guess for a running job; none while too little is done.
pub fn estimate(stages: &[JobStageRow], now_ms: i64) -> Option<Eta> {
    // Weights, and the seconds they took.
    let (mut done, mut elapsed_s, mut pending) = (0.0, 0.0, 0.0);
    // The running stage: the share done, the seconds it took, its weight.
    let mut running: Option<(f64, f64, f64)> = None;
    for stage in stages {
        let weight = weight(stage);
        match stage.state.as_str() {
            "done" => {
                done += weight;
                elapsed_s += stage.wall_s.unwrap_or(0.0);
            }
            "running" => {
                let share = running_share(stage);
                // The system's clock may jump.
                let seconds = stage.started_ms.map_or(0.0, |start| (now_ms - start).max(0) as f64 / 1000.0);
                done += weight * share;
                elapsed_s += seconds;
                running = Some((share, seconds, weight));
            }
            "pending" => pending += weight,
            _ => {}
        }
    }
    let running_left = running.map_or(0.0, |(share, _, weight)| weight * (1.0 - share));
    let share_done = done / (done + running_left + pending);
    if elapsed_s <= 0.0 || share_done.is_nan() || share_done < LEAST_KNOWN_SHARE {
        return None;
    }
    let s_per_weight = elapsed_s / done;
    let running_s = match running {
        Some((share, seconds, _)) if share >= LEAST_SHARE_FOR_RATE => seconds * (1.0 - share) / share,
        _ => running_left * s_per_weight,
    };
    let pending_s = pending * s_per_weight;
    Some(Eta {
        low: running_s / RUNNING_SPREAD + pending_s / PENDING_SPREAD,
        high: running_s * RUNNING_SPREAD + pending_s * PENDING_SPREAD,
    })
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn stage(name: &str, state: &str, done: i64, wall_s: Option<f64>) -> JobStageRow {
        JobStageRow {
            ord: 0,
            name: name.into(),
            iteration: None,
            state: state.into(),
            done,
            total: Some(10),
            started_ms: Some(0),
            finished_ms: None,
            wall_s,
            cpu_s: None,
            counts: "{}".into(),
        }
    }

    /// Asked ever so often during a run whose stages take their usual shares, the guess brackets what is left.
    #[test]
    fn the_guess_brackets_a_usual_run_from_start_to_end() {
        let names = ["features", "coarse_match", "coarse_model", "add_points", "refine", "export"];
        let seconds = [100.0, 16.0, 6.0, 35.0, 5.0, 9.0];
        let total_s: f64 = seconds.iter().sum();
        for running in 0..names.len() {
            for tenths in 1..10 {
                let spent_s = seconds[running] * tenths as f64 / 10.0;
                let stages: Vec<_> = (0..names.len())
                    .map(|at| match at.cmp(&running) {
                        std::cmp::Ordering::Less => stage(names[at], "done", 10, Some(seconds[at])),
                        std::cmp::Ordering::Equal => stage(names[at], "running", tenths, None),
                        std::cmp::Ordering::Greater => stage(names[at], "pending", 0, None),
                    })
                    .collect();
                let left_s = total_s - seconds[..running].iter().sum::<f64>() - spent_s;
                let eta = estimate(&stages, (1000.0 * spent_s) as i64).unwrap();
                assert!(eta.low < left_s && left_s < eta.high, "{left_s} s left in {}: {eta:?}", names[running]);
                assert!(eta.high < 3.0 * eta.low, "{eta:?}");
            }
        }
    }

    /// A stage that is slower than usual is told by its own rate, not by the stages before it.
    #[test]
    fn a_running_stage_is_told_by_its_own_rate() {
        let stages = [stage("features", "done", 10, Some(10.0)), stage("coarse_match", "running", 5, None)];
        let eta = estimate(&stages, 60_000).unwrap();
        assert!(eta.low < 60.0 && 60.0 < eta.high && eta.high < 80.0, "{eta:?}");
    }

    #[test]
    fn the_share_done_grows_from_nothing_to_all() {
        let mut stages = [stage("features", "pending", 0, None), stage("export", "pending", 0, None)];
        let mut shares = vec![share_done(&[]), share_done(&stages)];
        assert_eq!(shares, [0.0, 0.0]);
        for (at, state, done) in [(0, "running", 5), (0, "reused", 10), (1, "running", 5), (1, "done", 10)] {
            (stages[at].state, stages[at].done) = (state.to_owned(), done);
            shares.push(share_done(&stages));
        }
        assert!(shares[1..].is_sorted_by(|a, b| a < b) && shares.last() == Some(&1.0), "{shares:?}");
    }

    /// The second round of adding points hardly adds to what is left.
    #[test]
    fn later_rounds_are_short() {
        let mut rounds = [stage("add_points", "running", 5, None), stage("add_points", "pending", 0, None)];
        (rounds[0].iteration, rounds[1].iteration) = (Some(1), Some(2));
        let eta = estimate(&rounds, 10_000).unwrap();
        assert!(eta.low < 12.0 && eta.high < 16.0, "{eta:?}");
    }

    #[test]
    fn nothing_is_said_too_early_or_when_the_clock_jumps_back() {
        assert_eq!(estimate(&[], 5), None);
        let early = [stage("intake", "running", 1, None), stage("features", "pending", 0, None)];
        assert_eq!(estimate(&early, 1_000), None);
        let jumped = [stage("features", "running", 5, None)];
        assert_eq!(estimate(&jumped, -5_000), None);
    }
}
