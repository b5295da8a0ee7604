//! Table `job_images`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A photograph of a job.
#[derive(Clone, Debug, FromRow)]
pub struct JobImageRow {
    /// Its number in the job.
    pub n: i64,
    /// Relative path, with `/`.
    pub path: String,
    /// Its length.
    pub size_bytes: i64,
    /// Of its bytes, in hexadecimal.
    pub sha256: String,
    /// `pending`, `registered`, `unregistered` or `rejected`.
    pub state: String,
    /// JSON: the report's entry, null while pending.
    pub verdict: Option<String>,
}

/// Photographs of a job per verdict.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromRow)]
pub struct JobImageCounts {
    /// All.
    pub uploaded: i64,
    /// Without a verdict yet.
    pub pending: i64,
    /// In a model.
    pub registered: i64,
    /// Read, but without a pose.
    pub unregistered: i64,
    /// Not usable.
    pub rejected: i64,
}

/// Takes the photographs of the dataset as they are now, in path order, every verdict pending.
pub async fn freeze(db: &mut SqliteConnection, job: Uuid, dataset: Uuid) -> sqlx::Result<()> {
    let job = job.to_string();
    sqlx::query("DELETE FROM job_images WHERE job_id = ?").bind(&job).execute(&mut *db).await?;
    sqlx::query(
        "INSERT INTO job_images (job_id, n, path, size_bytes, sha256, state)
         SELECT ?, ROW_NUMBER() OVER (ORDER BY path) - 1, path, size_bytes, sha256, 'pending'
         FROM dataset_images WHERE dataset_id = ?",
    )
    .bind(&job)
    .bind(dataset.to_string())
    .execute(db)
    .await?;
    Ok(())
}

/// Counts per verdict.
pub async fn counts(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<JobImageCounts> {
    sqlx::query_as(
        "SELECT COUNT(*) AS uploaded, COALESCE(SUM(state = 'pending'), 0) AS pending,
         COALESCE(SUM(state = 'registered'), 0) AS registered, COALESCE(SUM(state = 'unregistered'), 0) AS unregistered,
         COALESCE(SUM(state = 'rejected'), 0) AS rejected FROM job_images WHERE job_id = ?",
    )
    .bind(job.to_string())
    .fetch_one(db)
    .await
}

/// Photographs after number `after`, of one verdict or of all.
pub async fn list(
    db: impl SqliteExecutor<'_>,
    job: Uuid,
    state: Option<&str>,
    after: i64,
    limit: u32,
) -> sqlx::Result<Vec<JobImageRow>> {
    sqlx::query_as(
        "SELECT n, path, size_bytes, sha256, state, verdict FROM job_images
         WHERE job_id = ? AND n > ? AND (? IS NULL OR state = ?) ORDER BY n LIMIT ?",
    )
    .bind(job.to_string())
    .bind(after)
    .bind(state)
    .bind(state)
    .bind(limit)
    .fetch_all(db)
    .await
}

/// One photograph.
pub async fn find(db: impl SqliteExecutor<'_>, job: Uuid, n: i64) -> sqlx::Result<Option<JobImageRow>> {
    sqlx::query_as("SELECT n, path, size_bytes, sha256, state, verdict FROM job_images WHERE job_id = ? AND n = ?")
        .bind(job.to_string())
        .bind(n)
        .fetch_optional(db)
        .await
}

/// Writes the verdict on the photograph with this path.
pub async fn set_verdict(
    db: &mut SqliteConnection,
    job: Uuid,
    n: i64,
    state: &str,
    verdict: Option<&str>,
) -> sqlx::Result<()> {
    sqlx::query("UPDATE job_images SET state = ?, verdict = ? WHERE job_id = ? AND n = ?")
        .bind(state)
        .bind(verdict)
        .bind(job.to_string())
        .bind(n)
        .execute(db)
        .await?;
    Ok(())
}
