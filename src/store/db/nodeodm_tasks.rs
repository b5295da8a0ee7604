//! Table `nodeodm_tasks`: tasks of the NodeODM interface that are not committed yet. A trigger removes the row when the job of
//! the same id is made.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A task that photographs are still sent to.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct NodeOdmTaskRow {
    /// Its id, a UUID in text, and that of the job it becomes.
    pub id: String,
    /// Where its photographs go.
    pub dataset_id: String,
    /// JSON, as the engine takes them.
    pub options: String,
    /// When it last got a photograph.
    pub touched_ms: i64,
    /// Whose it is.
    pub owner_token: Option<String>,
    /// The address to tell of its end.
    pub webhook: Option<String>,
}

/// Adds a task.
pub async fn insert(db: &mut SqliteConnection, task: &NodeOdmTaskRow) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT INTO nodeodm_tasks (id, dataset_id, options, touched_ms, owner_token, webhook) VALUES (?, ?, ?, ?, ?, ?)",
    )
    .bind(&task.id)
    .bind(&task.dataset_id)
    .bind(&task.options)
    .bind(task.touched_ms)
    .bind(&task.owner_token)
    .bind(&task.webhook)
    .execute(db)
    .await?;
    Ok(())
}

/// One task.
pub async fn find(db: impl SqliteExecutor<'_>, id: Uuid) -> sqlx::Result<Option<NodeOdmTaskRow>> {
    sqlx::query_as("SELECT id, dataset_id, options, touched_ms, owner_token, webhook FROM nodeodm_tasks WHERE id = ?")
        .bind(id.to_string())
        .fetch_optional(db)
        .await
}

/// Notes that a task got a photograph.
pub async fn touch(db: &mut SqliteConnection, id: Uuid, now_ms: i64) -> sqlx::Result<()> {
    sqlx::query("UPDATE nodeodm_tasks SET touched_ms = ? WHERE id = ?")
        .bind(now_ms)
        .bind(id.to_string())
        .execute(db)
        .await?;
    Ok(())
}

/// The datasets of tasks that got no photograph since a time.
pub async fn datasets_untouched_since(db: impl SqliteExecutor<'_>, before_ms: i64) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar("SELECT dataset_id FROM nodeodm_tasks WHERE touched_ms <= ?").bind(before_ms).fetch_all(db).await
}
