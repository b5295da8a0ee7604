//! Table `job_outputs`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A published output.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct JobOutputRow {
    /// Relative path, with `/`.
    pub path: String,
    /// Its length.
    pub size_bytes: i64,
    /// Of its bytes, in hexadecimal; serves as the entity tag.
    pub blake3: String,
}

/// The outputs of a job, in path order.
pub async fn list(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<Vec<JobOutputRow>> {
    sqlx::query_as("SELECT path, size_bytes, blake3 FROM job_outputs WHERE job_id = ? ORDER BY path")
        .bind(job.to_string())
        .fetch_all(db)
        .await
}

/// One output.
pub async fn find(db: impl SqliteExecutor<'_>, job: Uuid, path: &str) -> sqlx::Result<Option<JobOutputRow>> {
    sqlx::query_as("SELECT path, size_bytes, blake3 FROM job_outputs WHERE job_id = ? AND path = ?")
        .bind(job.to_string())
        .bind(path)
        .fetch_optional(db)
        .await
}

/// Replaces the list of a job's outputs.
pub async fn replace(db: &mut SqliteConnection, job: Uuid, outputs: &[JobOutputRow]) -> sqlx::Result<()> {
    let job = job.to_string();
    sqlx::query("DELETE FROM job_outputs WHERE job_id = ?").bind(&job).execute(&mut *db).await?;
    for output in outputs {
        sqlx::query("INSERT INTO job_outputs (job_id, path, size_bytes, blake3) VALUES (?, ?, ?, ?)")
            .bind(&job)
            .bind(&output.path)
            .bind(output.size_bytes)
            .bind(&output.blake3)
            .execute(&mut *db)
            .await?;
    }
    Ok(())
}
