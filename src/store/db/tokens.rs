//! Table `tokens`, and whose the rows of other tables are.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

use crate::store::{Quantity, Quota};

/// A token, without its secret.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct TokenRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// For people; no two have the same.
    pub name: String,
    /// Of its secret.
    pub hash: String,
    /// With commas between.
    pub scopes: String,
    /// When it was made.
    pub created_ms: i64,
    /// Since when it opens nothing.
    pub revoked_ms: Option<i64>,
    /// Bytes that it may keep.
    pub quota_bytes: Option<i64>,
    /// Jobs that it may keep.
    pub quota_jobs: Option<i64>,
    /// Photographs that it may keep.
    pub quota_images: Option<i64>,
}

impl TokenRow {
    /// What it may keep.
    pub fn quota(&self) -> Quota {
        let limit = |limit: Option<i64>| limit.and_then(|limit| u64::try_from(limit).ok());
        Quota { bytes: limit(self.quota_bytes), jobs: limit(self.quota_jobs), images: limit(self.quota_images) }
    }
}

/// What a token keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, FromRow)]
pub struct Usage {
    /// Bytes of photographs, those of open uploads included.
    pub bytes: i64,
    /// Jobs.
    pub jobs: i64,
    /// Photographs.
    pub images: i64,
}

impl Usage {
    /// How much of one quantity.
    pub fn of(&self, quantity: Quantity) -> u64 {
        let count = match quantity {
            Quantity::Bytes => self.bytes,
            Quantity::Jobs => self.jobs,
            Quantity::Images => self.images,
        };
        u64::try_from(count).unwrap_or(0)
    }
}

/// Adds a token.
pub async fn insert(db: &mut SqliteConnection, token: &TokenRow) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT INTO tokens (id, name, hash, scopes, created_ms, revoked_ms, quota_bytes, quota_jobs, quota_images)
         VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)",
    )
    .bind(&token.id)
    .bind(&token.name)
    .bind(&token.hash)
    .bind(&token.scopes)
    .bind(token.created_ms)
    .bind(token.revoked_ms)
    .bind(token.quota_bytes)
    .bind(token.quota_jobs)
    .bind(token.quota_images)
    .execute(db)
    .await?;
    Ok(())
}

/// Every token, oldest first.
pub async fn list(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<TokenRow>> {
    sqlx::query_as("SELECT * FROM tokens ORDER BY id").fetch_all(db).await
}

/// Ends a token by its name or id; whether there was one that still held.
pub async fn revoke(db: &mut SqliteConnection, name_or_id: &str, now_ms: i64) -> sqlx::Result<bool> {
    let revoked = sqlx::query("UPDATE tokens SET revoked_ms = ? WHERE (name = ? OR id = ?) AND revoked_ms IS NULL")
        .bind(now_ms)
        .bind(name_or_id)
        .bind(name_or_id)
        .execute(db)
        .await?;
    Ok(revoked.rows_affected() > 0)
}

/// Changes what a token may keep; whether there is one of this name or id that still holds.
pub async fn set_quota(db: &mut SqliteConnection, name_or_id: &str, quota: &Quota) -> sqlx::Result<bool> {
    let limit = |limit: Option<u64>| limit.map(|limit| i64::try_from(limit).unwrap_or(i64::MAX));
    let changed = sqlx::query(
        "UPDATE tokens SET quota_bytes = ?, quota_jobs = ?, quota_images = ? WHERE (name = ? OR id = ?) AND revoked_ms IS NULL",
    )
    .bind(limit(quota.bytes))
    .bind(limit(quota.jobs))
    .bind(limit(quota.images))
    .bind(name_or_id)
    .bind(name_or_id)
    .execute(db)
    .await?;
    Ok(changed.rows_affected() > 0)
}

/// What a token may keep.
pub async fn quota(db: impl SqliteExecutor<'_>, id: &str) -> sqlx::Result<Option<Quota>> {
    let row: Option<TokenRow> = sqlx::query_as("SELECT * FROM tokens WHERE id = ?").bind(id).fetch_optional(db).await?;
    Ok(row.map(|row| row.quota()))
}

/// What a token keeps. An upload that is stored counts as the photograph it became.
pub async fn usage(db: &mut SqliteConnection, id: &str) -> sqlx::Result<Usage> {
    sqlx::query_as(
        "WITH stored AS (SELECT COUNT(*) AS images, COALESCE(SUM(size_bytes), 0) AS bytes FROM dataset_images
             WHERE dataset_id IN (SELECT id FROM datasets WHERE owner_token = ?1)),
         open AS (SELECT COALESCE(SUM(kind <> 'partial'), 0) AS images, COALESCE(SUM(COALESCE(length, offset)), 0) AS bytes FROM uploads
             WHERE owner_token = ?1 AND stored = 0)
         SELECT stored.bytes + open.bytes AS bytes, stored.images + open.images AS images,
             (SELECT COUNT(*) FROM jobs WHERE owner_token = ?1) AS jobs FROM stored, open",
    )
    .bind(id)
    .fetch_one(db)
    .await
}

/// A thing that belongs to a token.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Owned {
    /// A dataset.
    Dataset(Uuid),
    /// A job.
    Job(Uuid),
    /// A resumable upload.
    Upload(Uuid),
}

/// The token a thing belongs to, none without one; nothing when there is no such thing.
pub async fn owner(db: impl SqliteExecutor<'_>, thing: Owned) -> sqlx::Result<Option<Option<String>>> {
    let (query, id) = match thing {
        Owned::Dataset(id) => ("SELECT owner_token FROM datasets WHERE id = ?", id),
        Owned::Job(id) => ("SELECT owner_token FROM jobs WHERE id = ?", id),
        Owned::Upload(id) => ("SELECT owner_token FROM uploads WHERE id = ?", id),
    };
    sqlx::query_scalar(query).bind(id.to_string()).fetch_optional(db).await
}
