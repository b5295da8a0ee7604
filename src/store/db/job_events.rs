//! Table `job_events`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// An event of a job.
#[derive(Clone, Debug, FromRow)]
pub struct JobEventRow {
    /// Counts up within the job.
    pub id: i64,
    /// `state` or `stage`.
    pub kind: String,
    /// JSON.
    pub data: String,
}

/// Adds an event and gives it the job's next id.
pub async fn append(db: &mut SqliteConnection, job: Uuid, kind: &str, data: &str) -> sqlx::Result<()> {
    let job = job.to_string();
    sqlx::query(
        "INSERT INTO job_events (job_id, id, kind, data)
         VALUES (?, (SELECT COALESCE(MAX(id), 0) + 1 FROM job_events WHERE job_id = ?), ?, ?)",
    )
    .bind(&job)
    .bind(&job)
    .bind(kind)
    .bind(data)
    .execute(db)
    .await?;
    Ok(())
}

/// Events after `after`, in order.
pub async fn list_after(db: impl SqliteExecutor<'_>, job: Uuid, after: i64) -> sqlx::Result<Vec<JobEventRow>> {
    sqlx::query_as("SELECT id, kind, data FROM job_events WHERE job_id = ? AND id > ? ORDER BY id")
        .bind(job.to_string())
        .bind(after)
        .fetch_all(db)
        .await
}
