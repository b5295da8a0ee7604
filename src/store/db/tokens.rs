//! Table `tokens`, and whose the rows of other tables are.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

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
}

/// Adds a token.
pub async fn insert(db: &mut SqliteConnection, token: &TokenRow) -> sqlx::Result<()> {
    sqlx::query("INSERT INTO tokens (id, name, hash, scopes, created_ms, revoked_ms) VALUES (?, ?, ?, ?, ?, ?)")
        .bind(&token.id)
        .bind(&token.name)
        .bind(&token.hash)
        .bind(&token.scopes)
        .bind(token.created_ms)
        .bind(token.revoked_ms)
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
