//! Table `jobs`.

use std::collections::BTreeMap;

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// A job.
#[derive(Clone, Debug, FromRow)]
pub struct JobRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// Place in the order of making.
    pub seq: i64,
    /// For people.
    pub name: String,
    /// `queued`, `running`, `succeeded`, `failed` or `cancelled`.
    pub state: String,
    /// Whether somebody asked the running job to stop.
    pub cancel_requested: bool,
    /// When it was made.
    pub created_ms: i64,
    /// When the latest attempt started.
    pub started_ms: Option<i64>,
    /// When it came to its end.
    pub finished_ms: Option<i64>,
    /// Its photographs.
    pub dataset_id: String,
    /// JSON, as given.
    pub options: String,
    /// Files of its upload that were no photographs.
    pub ignored: Option<i64>,
    /// How often in a row the process ended under it without a further stage finished.
    pub interruptions: i64,
    /// Stages that were finished when the process last ended under it.
    pub stages_finished: i64,
    /// JSON, null without a report.
    pub models: Option<String>,
    /// The stage that failed.
    pub error_stage: Option<String>,
    /// Why it failed, for machines.
    pub error_code: Option<String>,
    /// Why it failed, for people.
    pub error_message: Option<String>,
    /// Of two waiting jobs the one of higher priority starts first.
    pub priority: i64,
    /// The token it belongs to.
    pub owner_token: Option<String>,
    /// Bytes on disk that a run takes, as estimated.
    pub needed_bytes: Option<i64>,
    /// Memory that a run takes, as estimated.
    pub memory_bytes: Option<i64>,
    /// Threads of the latest attempt.
    pub threads: Option<i64>,
    /// Why it could not have all.
    pub resource_note: Option<String>,
    /// What it waits for besides its turn.
    pub held: Option<String>,
}

/// What a new job is made of.
#[derive(Clone, Debug)]
pub struct NewJobRow {
    /// Its id.
    pub id: Uuid,
    /// For people.
    pub name: String,
    /// When it was made.
    pub created_ms: i64,
    /// Its photographs.
    pub dataset: Uuid,
    /// JSON.
    pub options: String,
    /// Files of its upload that were no photographs.
    pub ignored: Option<i64>,
    /// Of two waiting jobs the one of higher priority starts first.
    pub priority: i64,
    /// Whose it is.
    pub owner_token: Option<Uuid>,
}

/// A waiting or running job as far as the queue's order needs it.
#[derive(Clone, Debug, FromRow)]
pub struct QueuedRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// The token it belongs to.
    pub owner_token: Option<String>,
    /// Higher goes first.
    pub priority: i64,
    /// Place in the order of making.
    pub seq: i64,
    /// Photographs.
    pub images: i64,
    /// Their bytes.
    pub size_bytes: i64,
    /// What it waits for besides its turn.
    pub held: Option<String>,
    /// When it was made.
    pub created_ms: i64,
    /// When the latest attempt started.
    pub started_ms: Option<i64>,
    /// When it came to its end.
    pub finished_ms: Option<i64>,
}

/// What the columns of a [`QueuedRow`] are.
macro_rules! queued_columns {
    () => {
        "SELECT id, owner_token, priority, seq, held, created_ms, started_ms, finished_ms,
         (SELECT COUNT(*) FROM job_images WHERE job_id = jobs.id) AS images,
         (SELECT COALESCE(SUM(size_bytes), 0) FROM job_images WHERE job_id = jobs.id) AS size_bytes FROM jobs "
    };
}

/// Adds a queued job.
pub async fn insert(db: &mut SqliteConnection, job: &NewJobRow) -> sqlx::Result<()> {
    sqlx::query(
        "INSERT INTO jobs (id, seq, name, state, created_ms, dataset_id, options, ignored, priority, owner_token)
         VALUES (?, (SELECT COALESCE(MAX(seq), 0) + 1 FROM jobs), ?, 'queued', ?, ?, ?, ?, ?, ?)",
    )
    .bind(job.id.to_string())
    .bind(&job.name)
    .bind(job.created_ms)
    .bind(job.dataset.to_string())
    .bind(&job.options)
    .bind(job.ignored)
    .bind(job.priority)
    .bind(job.owner_token.map(|token| token.to_string()))
    .execute(db)
    .await?;
    Ok(())
}

/// One job.
pub async fn find(db: impl SqliteExecutor<'_>, id: Uuid) -> sqlx::Result<Option<JobRow>> {
    sqlx::query_as("SELECT * FROM jobs WHERE id = ?").bind(id.to_string()).fetch_optional(db).await
}

/// Jobs older than the one with `seq` `before`, newest first, of one token or of all.
pub async fn list(
    db: impl SqliteExecutor<'_>,
    owner_token: Option<&str>,
    before: i64,
    limit: u32,
) -> sqlx::Result<Vec<JobRow>> {
    sqlx::query_as("SELECT * FROM jobs WHERE seq < ? AND (? IS NULL OR owner_token = ?) ORDER BY seq DESC LIMIT ?")
        .bind(before)
        .bind(owner_token)
        .bind(owner_token)
        .bind(limit)
        .fetch_all(db)
        .await
}

/// The jobs that wait, or those that run.
pub async fn queue(db: impl SqliteExecutor<'_>, state: &str) -> sqlx::Result<Vec<QueuedRow>> {
    sqlx::query_as(concat!(queued_columns!(), "WHERE state = ? ORDER BY seq")).bind(state).fetch_all(db).await
}

/// The latest runs that came to a model without help of an earlier attempt.
pub async fn latest_whole_runs(db: impl SqliteExecutor<'_>, limit: u32) -> sqlx::Result<Vec<QueuedRow>> {
    sqlx::query_as(concat!(
        queued_columns!(),
        "WHERE state = 'succeeded'
         AND NOT EXISTS (SELECT 1 FROM job_stages WHERE job_id = jobs.id AND job_stages.state = 'reused')
         ORDER BY finished_ms DESC LIMIT ?"
    ))
    .bind(limit)
    .fetch_all(db)
    .await
}

/// Per token: its jobs that run, and when its latest started.
pub async fn turns(db: impl SqliteExecutor<'_>) -> sqlx::Result<Vec<(Option<String>, i64, Option<i64>)>> {
    sqlx::query_as("SELECT owner_token, SUM(state = 'running'), MAX(started_ms) FROM jobs GROUP BY owner_token")
        .fetch_all(db)
        .await
}

/// Every job in a state.
pub async fn in_state(db: &mut SqliteConnection, state: &str) -> sqlx::Result<Vec<JobRow>> {
    sqlx::query_as("SELECT * FROM jobs WHERE state = ? ORDER BY seq").bind(state).fetch_all(db).await
}

/// Writes the columns that change with the state.
pub async fn update_state(db: &mut SqliteConnection, job: &JobRow) -> sqlx::Result<()> {
    sqlx::query(
        "UPDATE jobs SET state = ?, cancel_requested = ?, started_ms = ?, finished_ms = ?, interruptions = ?, stages_finished = ?,
         priority = ?, needed_bytes = ?, memory_bytes = ?, threads = ?, resource_note = ?, held = ?, models = ?, error_stage = ?, error_code = ?, error_message = ? WHERE id = ?",
    )
    .bind(&job.state)
    .bind(job.cancel_requested)
    .bind(job.started_ms)
    .bind(job.finished_ms)
    .bind(job.interruptions)
    .bind(job.stages_finished)
    .bind(job.priority)
    .bind(job.needed_bytes)
    .bind(job.memory_bytes)
    .bind(job.threads)
    .bind(&job.resource_note)
    .bind(&job.held)
    .bind(&job.models)
    .bind(&job.error_stage)
    .bind(&job.error_code)
    .bind(&job.error_message)
    .bind(&job.id)
    .execute(db)
    .await?;
    Ok(())
}

/// Gives a job other options (JSON).
pub async fn set_options(db: &mut SqliteConnection, id: Uuid, options: &str) -> sqlx::Result<()> {
    sqlx::query("UPDATE jobs SET options = ? WHERE id = ?").bind(options).bind(id.to_string()).execute(db).await?;
    Ok(())
}

/// Removes a job with all its rows.
pub async fn delete(db: &mut SqliteConnection, id: Uuid) -> sqlx::Result<()> {
    sqlx::query("DELETE FROM jobs WHERE id = ?").bind(id.to_string()).execute(db).await?;
    Ok(())
}

/// Jobs that came to their end before a time.
pub async fn ended_before(db: impl SqliteExecutor<'_>, before_ms: i64) -> sqlx::Result<Vec<String>> {
    sqlx::query_scalar(
        "SELECT id FROM jobs WHERE state IN ('succeeded', 'failed', 'cancelled') AND finished_ms < ? ORDER BY seq",
    )
    .bind(before_ms)
    .fetch_all(db)
    .await
}

/// Whether any job refers to a dataset, and whether one of them is queued or running.
pub async fn use_of_dataset(db: &mut SqliteConnection, dataset: Uuid) -> sqlx::Result<(bool, bool)> {
    let (all, active): (i64, i64) = sqlx::query_as(
        "SELECT COUNT(*), COALESCE(SUM(state IN ('queued', 'running')), 0) FROM jobs WHERE dataset_id = ?",
    )
    .bind(dataset.to_string())
    .fetch_one(db)
    .await?;
    Ok((all > 0, active > 0))
}

/// Jobs per state.
pub async fn count_by_state(db: impl SqliteExecutor<'_>) -> sqlx::Result<BTreeMap<String, i64>> {
    let rows: Vec<(String, i64)> =
        sqlx::query_as("SELECT state, COUNT(*) FROM jobs GROUP BY state").fetch_all(db).await?;
    Ok(rows.into_iter().collect())
}
