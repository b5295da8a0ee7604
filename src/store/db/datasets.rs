//! Table `datasets`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A dataset with what its images sum up to.
#[derive(Clone, Debug, FromRow)]
pub struct DatasetRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// Place in the order of making.
    pub seq: i64,
    /// For people.
    pub name: String,
    /// When it was made.
    pub created_ms: i64,
    /// Stored photographs.
    pub images: i64,
    /// Their bytes.
    pub size_bytes: i64,
}

/// Adds an empty dataset.
pub async fn insert(
    db: &mut SqliteConnection,
    id: Uuid,
    name: &str,
    created_ms: i64,
    owner_job: Option<Uuid>,
    owner_token: Option<Uuid>,
) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT INTO datasets (id, seq, name, created_ms, owner_job, owner_token)
         VALUES (?, (SELECT COALESCE(MAX(seq), 0) + 1 FROM datasets), ?, ?, ?, ?)",
    )
    .bind(id.to_string())
    .bind(name)
    .bind(created_ms)
    .bind(owner_job.map(|job| job.to_string()))
    .bind(owner_token.map(|token| token.to_string()))
    .execute(db)
    .await?;
    Ok(())
}

/// One dataset.
pub async fn find(db: impl SqliteExecutor<'_>, id: Uuid) -> sqlx::Result<Option<DatasetRow>> {
    sqlx::query_as(
        "SELECT d.id, d.seq, d.name, d.created_ms, COUNT(i.path) AS images, COALESCE(SUM(i.size_bytes), 0) AS size_bytes
         FROM datasets d LEFT JOIN dataset_images i ON i.dataset_id = d.id
         WHERE d.id = ? GROUP BY d.id",
    )
    .bind(id.to_string())
    .fetch_optional(db)
    .await
}

/// Whether a job on a dataset is queued or running; none without such a dataset.
pub async fn in_use(db: impl SqliteExecutor<'_>, id: Uuid) -> sqlx::Result<Option<bool>> {
    sqlx::query_scalar(
        "SELECT EXISTS (SELECT 1 FROM jobs WHERE dataset_id = d.id AND state IN ('queued', 'running')) FROM datasets d WHERE d.id = ?",
    )
    .bind(id.to_string())
    .fetch_optional(db)
    .await
}

/// Selects a [`PlaceRow`] by path and dataset.
macro_rules! select_place {
    () => {
        "SELECT EXISTS (SELECT 1 FROM jobs WHERE dataset_id = d.id AND state IN ('queued', 'running')) AS in_use, i.sha256,
         i.size_bytes, d.owner_token
         FROM datasets d LEFT JOIN dataset_images i ON i.dataset_id = d.id AND i.path = ? WHERE d.id = ?"
    };
}
pub(super) use select_place;

/// What is known of a path before a photograph goes there.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct PlaceRow {
    /// Whether a job on the dataset is queued or running.
    pub in_use: bool,
    /// Of the bytes that are stored there, in hexadecimal.
    pub sha256: Option<String>,
    /// Their number.
    pub size_bytes: Option<i64>,
    /// Whose the dataset is.
    pub owner_token: Option<String>,
}

/// A path of a dataset; none without such a dataset.
pub async fn place(db: impl SqliteExecutor<'_>, id: Uuid, path: &str) -> sqlx::Result<Option<PlaceRow>> {
    sqlx::query_as(select_place!()).bind(path).bind(id.to_string()).fetch_optional(db).await
}

/// Datasets older than the one with `seq` `before`, newest first, of one token or of all. One whose upload is not
/// complete yet is left out.
pub async fn list(
    db: impl SqliteExecutor<'_>,
    owner_token: Option<&str>,
    before: i64,
    limit: u32,
) -> sqlx::Result<Vec<DatasetRow>> {
    sqlx::query_as(
        "SELECT d.id, d.seq, d.name, d.created_ms, COUNT(i.path) AS images, COALESCE(SUM(i.size_bytes), 0) AS size_bytes
         FROM datasets d LEFT JOIN dataset_images i ON i.dataset_id = d.id
         WHERE d.seq < ? AND (? IS NULL OR d.owner_token = ?) AND (d.owner_job IS NULL OR d.owner_job IN (SELECT id FROM jobs))
         GROUP BY d.id ORDER BY d.seq DESC LIMIT ?",
    )
    .bind(before)
    .bind(owner_token)
    .bind(owner_token)
    .bind(limit)
    .fetch_all(db)
    .await
}

/// Notes that photographs were added; gives the token that the dataset belongs to.
pub async fn touch(db: &mut SqliteConnection, id: Uuid, now_ms: i64) -> sqlx::Result<Option<String>> {
    let owner: Option<Option<String>> =
        sqlx::query_scalar("UPDATE datasets SET changed_ms = ? WHERE id = ? RETURNING owner_token")
            .bind(now_ms)
            .bind(id.to_string())
            .fetch_optional(db)
            .await?;
    Ok(owner.flatten())
}

/// Removes a dataset with its image rows; whether it was there.
pub async fn delete(db: &mut SqliteConnection, id: Uuid) -> sqlx::Result<bool> {
    let deleted = sqlx::query("DELETE FROM datasets WHERE id = ?").bind(id.to_string()).execute(db).await?;
    Ok(deleted.rows_affected() > 0)
}

/// The dataset that belongs to `job` alone: its upload made it and no other job uses it.
pub async fn owned_only_by(db: &mut SqliteConnection, job: Uuid) -> sqlx::Result<Option<String>> {
    let job = job.to_string();
    sqlx::query_scalar(
        "SELECT id FROM datasets d WHERE owner_job = ?
         AND NOT EXISTS (SELECT 1 FROM jobs j WHERE j.dataset_id = d.id AND j.id <> d.owner_job)",
    )
    .bind(job)
    .fetch_optional(db)
    .await
}

/// Turns the dataset of a job that goes into one that stands alone, because other jobs use it.
pub async fn release_owner(db: &mut SqliteConnection, job: Uuid) -> sqlx::Result<()> {
    sqlx::query("UPDATE datasets SET owner_job = NULL WHERE owner_job = ?").bind(job.to_string()).execute(db).await?;
    Ok(())
}

/// Datasets that no job refers to, no upload goes to, and to which nothing was added since a time. Those whose upload
/// is still under way are left out.
pub async fn unused_since(db: impl SqliteExecutor<'_>, before_ms: i64) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar(
        "SELECT id FROM datasets d WHERE owner_job IS NULL AND MAX(created_ms, COALESCE(changed_ms, 0)) < ?
         AND NOT EXISTS (SELECT 1 FROM jobs WHERE dataset_id = d.id)
         AND NOT EXISTS (SELECT 1 FROM uploads WHERE dataset_id = d.id AND stored = 0) ORDER BY seq",
    )
    .bind(before_ms)
    .fetch_all(db)
    .await
}

/// Datasets on which no job waits or runs.
pub async fn without_active_job(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar(
        "SELECT id FROM datasets WHERE id NOT IN (SELECT dataset_id FROM jobs WHERE state IN ('queued', 'running'))",
    )
    .fetch_all(db)
    .await
}

/// Datasets of uploads that were never acknowledged: made for a job that does not exist.
pub async fn abandoned(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT id FROM datasets WHERE owner_job IS NOT NULL AND owner_job NOT IN (SELECT id FROM jobs)")
        .fetch_all(db)
        .await
}
