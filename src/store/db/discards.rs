//! Folders whose rows are deleted and whose files are still to go; triggers on `jobs` and `datasets` fill the table.

use sqlx::{SqliteConnection, SqliteExecutor};

/// Every folder to go, relative to the data directory.
pub async fn list(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT folder FROM discards ORDER BY folder").fetch_all(db).await
}

/// Takes a folder off the list: it is gone.
pub async fn remove(db: &mut SqliteConnection, folder: &str) -> sqlx::Result<()> {
    sqlx::query("DELETE FROM discards WHERE folder = ?").bind(folder).execute(db).await?;
    Ok(())
}
