//! Table `job_stages`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A stage of a job's latest attempt.
#[derive(Clone, Debug, PartialEq, FromRow)]
pub struct JobStageRow {
    /// Place in the plan.
    pub ord: i64,
    /// The stage's name.
    pub name: String,
    /// 1-based for iterated stages.
    pub iteration: Option<i64>,
    /// `pending`, `running`, `done` or `reused`.
    pub state: String,
    /// Units of work done.
    pub done: i64,
    /// Units of work, where known.
    pub total: Option<i64>,
    /// When it began.
    pub started_ms: Option<i64>,
    /// When it ended.
    pub finished_ms: Option<i64>,
    /// Wall-clock seconds, once it ended.
    pub wall_s: Option<f64>,
    /// CPU seconds, once it ended.
    pub cpu_s: Option<f64>,
    /// JSON object of numbers.
    pub counts: String,
}

/// The stages of a job, in order.
pub async fn list(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<Vec<JobStageRow>> {
    sqlx::query_as(
        "SELECT ord, name, iteration, state, done, total, started_ms, finished_ms, wall_s, cpu_s, counts
         FROM job_stages WHERE job_id = ? ORDER BY ord",
    )
    .bind(job.to_string())
    .fetch_all(db)
    .await
}

/// Writes a stage, new or changed.
pub async fn upsert(db: &mut SqliteConnection, job: Uuid, stage: &JobStageRow) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT OR REPLACE INTO job_stages
         (job_id, ord, name, iteration, state, done, total, started_ms, finished_ms, wall_s, cpu_s, counts)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(job.to_string())
    .bind(stage.ord)
    .bind(&stage.name)
    .bind(stage.iteration)
    .bind(&stage.state)
    .bind(stage.done)
    .bind(stage.total)
    .bind(stage.started_ms)
    .bind(stage.finished_ms)
    .bind(stage.wall_s)
    .bind(stage.cpu_s)
    .bind(&stage.counts)
    .execute(db)
    .await?;
    Ok(())
}

/// Forgets the stages of a job, before a new attempt.
pub async fn clear(db: &mut SqliteConnection, job: Uuid) -> sqlx::Result<()> {
    sqlx::query("DELETE FROM job_stages WHERE job_id = ?").bind(job.to_string()).execute(db).await?;
    Ok(())
}
