//! A guess at how long a job will still take.
//!
//! Every stage has a weight, its usual share of a run. With `W` the weight of what is done (a running stage counts by its units)
//! and `t` the time it took, the rest takes about `t (1 - W) / W`; the spread around it is wide while little is known and
//! narrows as the work goes on. Stages that were re-used took no time and count neither way.

use serde::Serialize;

use crate::store::db::job_stages::JobStageRow;

/// Usual shares of a run, measured on sets of 10 to 130 photographs; only their ratios matter.
const WEIGHTS: [(&str, f64); 8] = [
    ("intake", 1.0),
    ("features", 20.0),
    ("coarse_match", 12.0),
    ("coarse_model", 15.0),
    ("add_cameras", 4.0),
    ("add_points", 20.0),
    ("refine", 15.0),
    ("export", 3.0),
];
/// Below this share of the work a guess is worth nothing.
const LEAST_KNOWN_SHARE: f64 = 0.03;

/// Seconds left.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct Eta {
    /// If it goes well.
    pub low: f64,
    /// If it does not.
    pub high: f64,
}

/// The guess for a running job; none while too little is done.
pub fn estimate(stages: &[JobStageRow], now_ms: i64) -> Option<Eta> {
    let (mut done, mut left, mut elapsed_s) = (0.0, 0.0, 0.0);
    for stage in stages {
        let weight = WEIGHTS.iter().find(|(name, _)| *name == stage.name).map_or(1.0, |(_, weight)| *weight);
        match stage.state.as_str() {
            "done" => {
                done += weight;
                elapsed_s += stage.wall_s.unwrap_or(0.0);
            }
            "running" => {
                let share = match stage.total {
                    Some(total) if total > 0 => (stage.done as f64 / total as f64).clamp(0.0, 1.0),
                    _ => 0.0,
                };
                done += weight * share;
                left += weight * (1.0 - share);
                // The system's clock may jump.
                elapsed_s += stage.started_ms.map_or(0.0, |start| (now_ms - start).max(0) as f64 / 1000.0);
            }
            "pending" => left += weight,
            _ => {}
        }
    }
    let share = done / (done + left);
    if elapsed_s <= 0.0 || share.is_nan() || share < LEAST_KNOWN_SHARE {
        return None;
    }
    let middle = elapsed_s * left / done;
    let spread = 1.0 - 0.6 * share;
    Some(Eta { low: middle / (1.0 + spread), high: middle * (1.0 + spread) })
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

    #[test]
    fn the_guess_brackets_work_that_goes_on_evenly() {
        let stages = [
            stage("features", "done", 10, Some(20.0)),
            stage("coarse_match", "running", 5, None),
            stage("coarse_model", "pending", 0, None),
        ];
        let eta = estimate(&stages, 6_000).unwrap();
        assert!(eta.low < 21.0 && 21.0 < eta.high, "{eta:?}");
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
