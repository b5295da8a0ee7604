//! Folders whose rows are deleted and whose files are still to go; triggers on `jobs` and `datasets` fill the table.
//! While a copy of the data directory is under way, they stay.

use sqlx::{SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// Keeps files of what is deleted where they are, until a time at most.
pub async fn hold(db: &mut SqliteConnection, backup: Uuid, until_ms: i64) -> sqlx::Result<()> {
    sqlx::query("INSERT OR REPLACE INTO backups (id, until_ms) VALUES (?, ?)")
        .bind(backup.to_string())
        .bind(until_ms)
        .execute(db)
        .await?;
    Ok(())
}

/// Ends [`hold`].
pub async fn release(db: &mut SqliteConnection, backup: Uuid) -> sqlx::Result<()> {
    sqlx::query("DELETE FROM backups WHERE id = ?").bind(backup.to_string()).execute(db).await?;
    Ok(())
}

/// Whether files must stay where they are.
pub async fn is_held(db: impl SqliteExecutor<'_>, now_ms: i64) -> sqlx::Result<bool> {
    let held: i64 =
        sqlx::query_scalar("SELECT COUNT(*) FROM backups WHERE until_ms > ?").bind(now_ms).fetch_one(db).await?;
    Ok(held > 0)
}

/// Every folder to go, relative to the data directory.
pub async fn list(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT folder FROM discards ORDER BY folder").fetch_all(db).await
}

/// Takes a folder off the list: it is gone.
pub async fn remove(db: &mut SqliteConnection, folder: &str) -> sqlx::Result<()> {
    sqlx::query("DELETE FROM discards WHERE folder = ?").bind(folder).execute(db).await?;
    Ok(())
}
