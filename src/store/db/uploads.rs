//! Table `uploads`.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

use super::dataset_images::DatasetImageRow;
use super::datasets::{PlaceRow, select_place};

/// A resumable upload.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct UploadRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// When it was made.
    pub created_ms: i64,
    /// Until when it is kept without a further byte.
    pub expires_ms: i64,
    /// `whole`, `partial` or `final`.
    pub kind: String,
    /// Its bytes in the end, once the sender said.
    pub length: Option<i64>,
    /// Bytes that are durable.
    pub offset: i64,
    /// The metadata header as it came.
    pub metadata: String,
    /// The concatenation header as it came.
    pub concat: Option<String>,
    /// The dataset a complete upload goes to; none for a partial one.
    pub dataset_id: Option<String>,
    /// Its path there.
    pub path: Option<String>,
    /// Whether its bytes are in the dataset.
    pub stored: bool,
    /// Whose it is.
    pub owner_token: Option<String>,
}

/// Inserts a row of all columns, in the order in which [`bind_row`] binds them; what follows gives their values.
macro_rules! insert_into_uploads {
    () => {
        "INSERT INTO uploads (id, created_ms, expires_ms, kind, length, offset, metadata, concat, dataset_id, path, stored, owner_token) "
    };
}

/// Binds all columns of an upload, to whatever kind of query.
macro_rules! bind_row {
    ($query:expr, $upload:expr) => {
        $query
            .bind(&$upload.id)
            .bind($upload.created_ms)
            .bind($upload.expires_ms)
            .bind(&$upload.kind)
            .bind($upload.length)
            .bind($upload.offset)
            .bind(&$upload.metadata)
            .bind(&$upload.concat)
            .bind(&$upload.dataset_id)
            .bind(&$upload.path)
            .bind($upload.stored)
            .bind(&$upload.owner_token)
    };
}

/// Adds an upload.
pub async fn insert(db: &mut SqliteConnection, upload: &UploadRow) -> sqlx::Result<()> {
    let query = sqlx::query(concat!(insert_into_uploads!(), "VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)"));
    bind_row!(query, upload).execute(db).await?;
    Ok(())
}

/// Adds an upload that is a photograph of its dataset already, and the photograph, all in one request to SQLite; gives
/// what was known of the path before, and none without such a dataset. Where a photograph was known before, it stays.
pub async fn insert_stored(
    db: &mut SqliteConnection,
    upload: &UploadRow,
    image: &DatasetImageRow,
    now_ms: i64,
) -> sqlx::Result<Option<PlaceRow>> {
    let dataset = &upload.dataset_id;
    let query = sqlx::query_as(concat!(
        select_place!(),
        ";",
        insert_into_uploads!(),
        "SELECT ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ? FROM datasets WHERE id = ?;
         INSERT INTO dataset_images (path, size_bytes, sha256, dataset_id)
         SELECT ?, ?, ?, id FROM datasets WHERE id = ? ON CONFLICT DO NOTHING;
         UPDATE datasets SET changed_ms = ? WHERE id = ?",
    ));
    let rows = bind_row!(query.bind(&image.path).bind(dataset), upload)
        .bind(dataset)
        .bind(&image.path)
        .bind(image.size_bytes)
        .bind(&image.sha256)
        .bind(dataset)
        .bind(now_ms)
        .bind(dataset)
        // All statements run to their ends; only the first has a row.
        .fetch_all(db)
        .await?;
    Ok(rows.into_iter().next())
}

/// One upload.
pub async fn find(db: impl SqliteExecutor<'_>, id: Uuid) -> sqlx::Result<Option<UploadRow>> {
    sqlx::query_as("SELECT * FROM uploads WHERE id = ?").bind(id.to_string()).fetch_optional(db).await
}

/// Writes what changes while bytes arrive.
pub async fn update(db: &mut SqliteConnection, upload: &UploadRow) -> sqlx::Result<()> {
    sqlx::query("UPDATE uploads SET expires_ms = ?, length = ?, offset = ?, stored = ? WHERE id = ?")
        .bind(upload.expires_ms)
        .bind(upload.length)
        .bind(upload.offset)
        .bind(upload.stored)
        .bind(&upload.id)
        .execute(db)
        .await?;
    Ok(())
}

/// Removes an upload; whether it was there.
pub async fn delete(db: &mut SqliteConnection, id: Uuid) -> sqlx::Result<bool> {
    let deleted = sqlx::query("DELETE FROM uploads WHERE id = ?").bind(id.to_string()).execute(db).await?;
    Ok(deleted.rows_affected() > 0)
}

/// Uploads whose time is over.
pub async fn expired(db: impl SqliteExecutor<'_>, now_ms: i64) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT id FROM uploads WHERE expires_ms <= ?").bind(now_ms).fetch_all(db).await
}

/// Uploads whose bytes are still in their own file.
pub async fn with_file(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT id FROM uploads WHERE stored = 0").fetch_all(db).await
}

/// Bytes that open uploads have announced and not yet sent.
pub async fn outstanding_bytes(db: impl SqliteExecutor<'_>) -> sqlx::Result<i64> {
    sqlx::query_scalar("SELECT COALESCE(SUM(length - offset), 0) FROM uploads WHERE length IS NOT NULL AND stored = 0")
        .fetch_one(db)
        .await
}
