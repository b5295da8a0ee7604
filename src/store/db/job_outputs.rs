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
    /// CRC-32 of its bytes; none in rows of earlier versions.
    pub crc32: Option<u32>,
}

/// The outputs of a job, in path order.
pub async fn list(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<Vec<JobOutputRow>> {
    sqlx::query_as("SELECT path, size_bytes, blake3, crc32 FROM job_outputs WHERE job_id = ? ORDER BY path")
        .bind(job.to_string())
        .fetch_all(db)
        .await
}

/// One output.
pub async fn find(db: impl SqliteExecutor<'_>, job: Uuid, path: &str) -> sqlx::Result<Option<JobOutputRow>> {
    sqlx::query_as("SELECT path, size_bytes, blake3, crc32 FROM job_outputs WHERE job_id = ? AND path = ?")
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
        sqlx::query("INSERT INTO job_outputs (job_id, path, size_bytes, blake3, crc32) VALUES (?, ?, ?, ?, ?)")
            .bind(&job)
            .bind(&output.path)
            .bind(output.size_bytes)
            .bind(&output.blake3)
            .bind(output.crc32)
            .execute(&mut *db)
            .await?;
    }
    Ok(())
}

/// Writes the checksum of an output that had none.
pub async fn set_crc32(db: &mut SqliteConnection, job: Uuid, path: &str, crc32: u32) -> sqlx::Result<()> {
    sqlx::query("UPDATE job_outputs SET crc32 = ? WHERE job_id = ? AND path = ?")
        .bind(crc32)
        .bind(job.to_string())
        .bind(path)
        .execute(db)
        .await?;
    Ok(())
}
