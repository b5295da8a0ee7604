//! Progress on its way from the worker threads into the database.
//!
//! The run's threads only change a value in memory; the executor looks at it at most four times a second, writes what
//! changed in one transaction and tells the event streams. However fast units of work end, the database sees few commits.

use std::time::Duration;

use tokio::sync::watch;
use uuid::Uuid;

use super::hub::Hub;
use super::view::StageView;
use crate::pipeline::{ProgressEvent, ProgressSink, StageKey};
use crate::store::db::job_stages::JobStageRow;
use crate::store::db::{Db, job_events, job_stages, now_ms};

/// Time between two writes.
pub(super) const WRITE_INTERVAL: Duration = Duration::from_millis(250);

/// Every stage of the running attempt, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub(super) struct Progress(Vec<JobStageRow>);

impl Progress {
    fn stage(&mut self, key: StageKey) -> &mut JobStageRow {
        let iteration = key.iteration.map(i64::from);
        let known = self.0.iter().position(|row| row.name == key.stage.name() && row.iteration == iteration);
        let at = known.unwrap_or_else(|| {
            self.0.push(JobStageRow {
                ord: i64::try_from(self.0.len()).unwrap_or(i64::MAX),
                name: key.stage.name().to_owned(),
                iteration,
                state: "pending".to_owned(),
                done: 0,
                total: None,
                started_ms: None,
                finished_ms: None,
                wall_s: None,
                cpu_s: None,
                counts: "{}".to_owned(),
            });
            self.0.len() - 1
        });
        &mut self.0[at]
    }

    fn apply(&mut self, event: ProgressEvent, now_ms: i64) {
        let units = |n: u64| i64::try_from(n).unwrap_or(i64::MAX);
        match event {
            ProgressEvent::Plan(stages) => {
                for key in stages {
                    self.stage(key);
                }
            }
            ProgressEvent::StageStarted { stage, total } => {
                let row = self.stage(stage);
                row.state = "running".to_owned();
                row.total = (total > 0).then(|| units(total));
                row.started_ms = Some(now_ms);
            }
            ProgressEvent::StageProgress { stage, done, total } => {
                let row = self.stage(stage);
                row.total = (total > 0).then(|| units(total));
                // Threads may tell out of order.
                row.done = row.done.max(units(done));
            }
            ProgressEvent::StageFinished { stage, reused, wall_s, cpu_s, counts } => {
                let row = self.stage(stage);
                row.state = if reused { "reused" } else { "done" }.to_owned();
                row.done = row.total.unwrap_or(row.done);
                row.started_ms.get_or_insert(now_ms);
                row.finished_ms = Some(now_ms);
                row.wall_s = wall_s.is_finite().then_some(wall_s);
                row.cpu_s = cpu_s.is_finite().then_some(cpu_s);
                let counts: serde_json::Map<_, _> = counts
                    .into_iter()
                    .filter_map(|(name, value)| Some((name, serde_json::Number::from_f64(value)?.into())))
                    .collect();
                row.counts = serde_json::Value::Object(counts).to_string();
            }
        }
    }

    /// The stage that runs, or else the last that ended: where a failure belongs.
    pub(super) fn current(&self) -> Option<String> {
        let running = self.0.iter().rev().find(|row| row.state == "running");
        let row = running.or_else(|| self.0.iter().rev().find(|row| row.state != "pending"))?;
        Some(match row.iteration {
            Some(iteration) => format!("{}/{iteration}", row.name),
            None => row.name.clone(),
        })
    }
}

/// The run's ear: keeps the latest progress.
pub(super) struct WatchSink(pub(super) watch::Sender<Progress>);

impl ProgressSink for WatchSink {
    fn report(&self, event: ProgressEvent) {
        let now = now_ms();
        self.0.send_modify(|progress| progress.apply(event, now));
    }
}

/// Writes what changed since the last write.
pub(super) struct Recorder {
    job: Uuid,
    written: Progress,
}

impl Recorder {
    pub(super) fn new(job: Uuid) -> Self {
        Self { job, written: Progress::default() }
    }

    pub(super) async fn write(&mut self, db: &Db, hub: &Hub, progress: Progress) -> sqlx::Result<()> {
        if progress == self.written {
            return Ok(());
        }
        let mut tx = db.write().await?;
        for (at, row) in progress.0.iter().enumerate() {
            let before = self.written.0.get(at);
            if before == Some(row) {
                continue;
            }
            job_stages::upsert(&mut tx, self.job, row).await?;
            if before.is_none_or(|before| before.state != row.state) {
                let data =
                    serde_json::to_string(&StageView::of(row)).map_err(|error| sqlx::Error::Encode(error.into()))?;
                job_events::append(&mut tx, self.job, "stage", &data).await?;
            }
        }
        tx.commit().await?;
        self.written = progress;
        hub.announce();
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::pipeline::Stage;

    #[test]
    fn events_add_up_to_rows() {
        let key = |stage, iteration| StageKey { stage, iteration };
        let mut progress = Progress::default();
        let (features, points) = (key(Stage::Features, None), key(Stage::AddPoints, Some(1)));
        progress.apply(ProgressEvent::Plan(vec![features, points]), 1);
        assert_eq!(progress.current(), None);
        progress.apply(ProgressEvent::StageStarted { stage: features, total: 4 }, 2);
        progress.apply(ProgressEvent::StageProgress { stage: features, done: 3, total: 4 }, 3);
        progress.apply(ProgressEvent::StageProgress { stage: features, done: 2, total: 4 }, 3);
        assert_eq!((progress.0[0].done, progress.0[0].total), (3, Some(4)));
        assert_eq!(progress.current().as_deref(), Some("features"));
        let counts = [("features".to_owned(), 7.0), ("broken".to_owned(), f64::NAN)].into();
        progress.apply(
            ProgressEvent::StageFinished { stage: features, reused: false, wall_s: 1.5, cpu_s: f64::NAN, counts },
            9,
        );
        let row = &progress.0[0];
        assert_eq!((row.state.as_str(), row.done, row.cpu_s, row.finished_ms), ("done", 4, None, Some(9)));
        assert_eq!(row.counts, r#"{"features":7.0}"#);
        progress.apply(ProgressEvent::StageStarted { stage: points, total: 0 }, 10);
        assert_eq!(progress.current().as_deref(), Some("add_points/1"));
        assert_eq!(progress.0.len(), 2);
    }
}
