//! What the database's rows mean to a reader: the shapes of `openapi.yaml` that events carry and jobs are shown with.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::JobState;
use crate::formats::report::ModelReport;
use crate::store::db::job_stages::JobStageRow;
use crate::store::db::jobs::JobRow;

/// An RFC 3339 time out of milliseconds since 1970.
pub fn time_text(ms: i64) -> String {
    jiff::Timestamp::from_millisecond(ms).map(|time| format!("{time:.3}")).unwrap_or_default()
}

/// Why a job failed.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct ErrorView {
    /// The stage, with its iteration.
    pub stage: Option<String>,
    /// For machines.
    pub code: String,
    /// For people.
    pub message: String,
}

impl ErrorView {
    /// The error of a failed job.
    pub fn of(job: &JobRow) -> Option<Self> {
        Some(Self {
            stage: job.error_stage.clone(),
            code: job.error_code.clone()?,
            message: job.error_message.clone().unwrap_or_default(),
        })
    }
}

/// Data of a `state` event.
#[derive(Clone, Debug, Serialize)]
pub struct StateEvent {
    /// The new state.
    pub state: JobState,
    /// Since when.
    pub at: String,
    /// Why, when it is `failed`.
    pub error: Option<ErrorView>,
}

/// A stage of a job; also the data of a `stage` event.
#[derive(Clone, Debug, Serialize)]
pub struct StageView {
    /// The stage's name.
    pub name: String,
    /// 1-based for iterated stages.
    pub iteration: Option<i64>,
    /// `pending`, `running`, `done` or `reused`.
    pub state: String,
    /// Units of work done.
    pub done: i64,
    /// Units of work.
    pub total: Option<i64>,
    /// When it began.
    pub started_at: Option<String>,
    /// When it ended.
    pub finished_at: Option<String>,
    /// Wall-clock seconds.
    pub wall_s: Option<f64>,
    /// CPU seconds.
    pub cpu_s: Option<f64>,
    /// Named counts.
    pub counts: BTreeMap<String, f64>,
}

impl StageView {
    /// A row for readers.
    pub fn of(row: &JobStageRow) -> Self {
        Self {
            name: row.name.clone(),
            iteration: row.iteration,
            state: row.state.clone(),
            done: row.done,
            total: row.total,
            started_at: row.started_ms.map(time_text),
            finished_at: row.finished_ms.map(time_text),
            wall_s: row.wall_s,
            cpu_s: row.cpu_s,
            counts: serde_json::from_str(&row.counts).unwrap_or_default(),
        }
    }
}

/// The stage that runs now.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct CurrentStage {
    /// The stage's name.
    pub name: String,
    /// 1-based for iterated stages.
    pub iteration: Option<i64>,
    /// Units of work done.
    pub done: i64,
    /// Units of work.
    pub total: Option<i64>,
}

impl CurrentStage {
    /// The running one of a job's stages.
    pub fn among(stages: &[JobStageRow]) -> Option<Self> {
        let row = stages.iter().rev().find(|row| row.state == "running")?;
        Some(Self { name: row.name.clone(), iteration: row.iteration, done: row.done, total: row.total })
    }
}

/// A model in a job's summary, as it is kept with the job.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ModelSummary {
    /// Rank, 0 the largest.
    pub id: usize,
    /// Registered images.
    pub images: usize,
    /// Points.
    pub points: usize,
    /// Points with at least three observations.
    pub points_3plus: usize,
    /// Observations.
    pub observations: usize,
    /// Mean observations of a point.
    pub mean_track_length: Option<f64>,
    /// Mean reprojection error.
    pub mean_reprojection_error_px: Option<f64>,
    /// Median reprojection error.
    pub median_reprojection_error_px: Option<f64>,
}

impl ModelSummary {
    /// The report's model without its history.
    pub fn of(model: &ModelReport) -> Self {
        Self {
            id: model.id,
            images: model.images,
            points: model.points,
            points_3plus: model.points_3plus,
            observations: model.observations,
            mean_track_length: model.mean_track_length,
            mean_reprojection_error_px: model.mean_reprojection_error_px,
            median_reprojection_error_px: model.median_reprojection_error_px,
        }
    }
}
