//! Table `dataset_images`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A stored photograph.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct DatasetImageRow {
    /// Relative path, with `/`.
    pub path: String,
    /// Its length.
    pub size_bytes: i64,
    /// Of its bytes, in hexadecimal.
    pub sha256: String,
}

/// Adds a photograph; its file must be durable.
pub async fn insert(db: &mut SqliteConnection, dataset: Uuid, image: &DatasetImageRow) -> sqlx::Result<()> {
    sqlx::query("INSERT INTO dataset_images (dataset_id, path, size_bytes, sha256) VALUES (?, ?, ?, ?)")
        .bind(dataset.to_string())
        .bind(&image.path)
        .bind(image.size_bytes)
        .bind(&image.sha256)
        .execute(db)
        .await?;
    Ok(())
}

/// The photograph with this path.
pub async fn find(db: impl SqliteExecutor<'_>, dataset: Uuid, path: &str) -> sqlx::Result<Option<DatasetImageRow>> {
    sqlx::query_as("SELECT path, size_bytes, sha256 FROM dataset_images WHERE dataset_id = ? AND path = ?")
        .bind(dataset.to_string())
        .bind(path)
        .fetch_optional(db)
        .await
}

/// Photographs after `after` in path order.
pub async fn list(
    db: impl SqliteExecutor<'_>,
    dataset: Uuid,
    after: &str,
    limit: u32,
) -> sqlx::Result<Vec<DatasetImageRow>> {
    sqlx::query_as(
        "SELECT path, size_bytes, sha256 FROM dataset_images WHERE dataset_id = ? AND path > ? ORDER BY path LIMIT ?",
    )
    .bind(dataset.to_string())
    .bind(after)
    .bind(limit)
    .fetch_all(db)
    .await
}
