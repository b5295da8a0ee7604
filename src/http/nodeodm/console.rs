//! A job's events as the lines of a console, which is all that these clients know of stages. Events are kept, so the lines are
//! the same after a restart, and a line once told keeps its number.

use serde_json::Value;

use crate::store::db::job_events::JobEventRow;

/// The lines of a job's events, in order.
pub(super) fn lines(events: &[JobEventRow]) -> Vec<String> {
    events
        .iter()
        .filter_map(|event| line(&event.kind, &serde_json::from_str(&event.data).unwrap_or_default()))
        .collect()
}

fn line(kind: &str, data: &Value) -> Option<String> {
    let text = |name: &str| data[name].as_str().unwrap_or_default();
    if kind == "state" {
        // Clients take a line that is `error` alone for an answer that failed: no line is one word.
        let mut line = format!("{} job {}", text("at"), text("state"));
        if let Some(message) = data["error"]["message"].as_str() {
            line = format!("{line}: {message}");
        }
        return Some(line);
    }
    let mut stage = text("name").to_owned();
    if let Some(iteration) = data["iteration"].as_i64() {
        stage = format!("{stage}/{iteration}");
    }
    match text("state") {
        "running" => Some(format!("{} {stage}: started", text("started_at"))),
        "reused" => Some(format!("{} {stage}: re-used", text("finished_at"))),
        "done" => {
            let counts = data["counts"].as_object().into_iter().flatten();
            let counts: Vec<_> = counts.map(|(name, count)| format!("{name} {count}")).collect();
            let seconds = data["wall_s"].as_f64().map(|seconds| format!(" in {seconds:.1} s")).unwrap_or_default();
            Some(format!("{} {stage}: done{seconds}; {}", text("finished_at"), counts.join(", ")))
        }
        _ => None,
    }
}

/// The lines from number `from` on; a negative number counts from the end.
pub(super) fn from_line(mut lines: Vec<String>, from: i64) -> Vec<String> {
    let count = i64::try_from(lines.len()).unwrap_or(i64::MAX);
    let first = if from < 0 { count.saturating_add(from).max(0) } else { from.min(count) };
    lines.split_off(usize::try_from(first).unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn lines_are_cut_from_either_end() {
        let cut = |from| from_line(["a", "b", "c"].map(str::to_owned).to_vec(), from).concat();
        for (from, left) in
            [(0, "abc"), (1, "bc"), (3, ""), (9, ""), (-1, "c"), (-3, "abc"), (-9, "abc"), (i64::MIN, "abc")]
        {
            assert_eq!(cut(from), left, "{from}");
        }
    }

    #[test]
    fn events_become_lines() {
        let event = |kind: &str, data: &str| JobEventRow { id: 1, kind: kind.into(), data: data.into() };
        let lines = lines(&[
            event("state", r#"{"state": "queued", "at": "T0", "error": null}"#),
            event("stage", r#"{"name": "features", "iteration": null, "state": "pending"}"#),
            event("stage", r#"{"name": "add_points", "iteration": 1, "state": "running", "started_at": "T1"}"#),
            event(
                "stage",
                r#"{"name": "export", "state": "done", "finished_at": "T2", "wall_s": 1.25, "counts": {"n": 3}}"#,
            ),
            event("state", r#"{"state": "failed", "at": "T3", "error": {"message": "no model"}}"#),
        ]);
        assert_eq!(
            lines,
            ["T0 job queued", "T1 add_points/1: started", "T2 export: done in 1.2 s; n 3", "T3 job failed: no model"]
        );
    }
}
