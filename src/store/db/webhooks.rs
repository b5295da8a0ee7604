//! Tables `webhooks` and `webhook_deliveries`. A trigger on `job_events` makes the deliveries.

use sqlx::{FromRow, SqliteConnection, SqliteExecutor};
use uuid::Uuid;

/// Who listens to a webhook.
#[derive(Clone, Copy, Debug, PartialEq, Eq, sqlx::Type)]
#[sqlx(rename_all = "lowercase")]
pub enum Audience {
    /// Hears of every change of state, signed.
    Jobs,
    /// Hears of a task's end alone, in the words of NodeODM.
    NodeOdm,
}

/// An address that is told of a job's changes of state.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct WebhookRow {
    /// Its id, a UUID in text.
    pub id: String,
    /// The job it hears of.
    pub job_id: String,
    /// Where it is.
    pub url: String,
    /// Signs what is sent; empty for clients of NodeODM.
    pub secret: String,
    /// When it was made.
    pub created_ms: i64,
    /// Who listens.
    pub audience: Audience,
}

/// A change of state on its way to an address.
#[derive(Clone, Debug, PartialEq, Eq, FromRow)]
pub struct DeliveryRow {
    /// To which.
    pub webhook_id: String,
    /// The event it tells.
    pub event_id: i64,
    /// `pending`, `delivered` or `given_up`.
    pub state: String,
    /// How often it was tried.
    pub attempts: i64,
    /// When it is tried next, while pending.
    pub next_ms: i64,
    /// When it was tried last.
    pub last_ms: Option<i64>,
    /// The status that was answered last.
    pub last_status: Option<i64>,
    /// Why the last attempt failed.
    pub last_error: Option<String>,
}

/// A delivery with what it sends and where.
#[derive(Clone, Debug, FromRow)]
pub struct DueRow {
    /// The delivery.
    #[sqlx(flatten)]
    pub delivery: DeliveryRow,
    /// Where to.
    pub url: String,
    /// Signs it; empty for clients of NodeODM.
    pub secret: String,
    /// Who listens.
    pub audience: Audience,
    /// The job it is about.
    pub job_id: String,
    /// The job's name.
    pub job_name: String,
    /// When the job was made.
    pub created_ms: i64,
    /// When it began.
    pub started_ms: Option<i64>,
    /// When it ended.
    pub finished_ms: Option<i64>,
    /// Its photographs.
    pub images: i64,
    /// The event's data, JSON.
    pub data: String,
}

/// Adds a webhook; it hears of every later change.
pub async fn insert(db: &mut SqliteConnection, webhook: &WebhookRow) -> sqlx::Result<()> {
    sqlx::query("INSERT INTO webhooks (id, job_id, url, secret, created_ms, audience) VALUES (?, ?, ?, ?, ?, ?)")
        .bind(&webhook.id)
        .bind(&webhook.job_id)
        .bind(&webhook.url)
        .bind(&webhook.secret)
        .bind(webhook.created_ms)
        .bind(webhook.audience)
        .execute(db)
        .await?;
    Ok(())
}

/// The webhooks of a job, oldest first.
pub async fn list(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<Vec<WebhookRow>> {
    sqlx::query_as("SELECT id, job_id, url, secret, created_ms, audience FROM webhooks WHERE job_id = ? ORDER BY id")
        .bind(job.to_string())
        .fetch_all(db)
        .await
}

/// Removes a webhook of a job with its deliveries; whether it was there.
pub async fn delete(db: &mut SqliteConnection, job: Uuid, id: Uuid) -> sqlx::Result<bool> {
    let deleted = sqlx::query("DELETE FROM webhooks WHERE job_id = ? AND id = ?")
        .bind(job.to_string())
        .bind(id.to_string())
        .execute(db)
        .await?;
    Ok(deleted.rows_affected() > 0)
}

/// What was and is to be told to the webhooks of a job, in order.
pub async fn deliveries(db: impl SqliteExecutor<'_>, job: Uuid) -> sqlx::Result<Vec<DeliveryRow>> {
    sqlx::query_as(
        "SELECT d.* FROM webhook_deliveries d JOIN webhooks w ON w.id = d.webhook_id
         WHERE w.job_id = ? ORDER BY d.webhook_id, d.event_id",
    )
    .bind(job.to_string())
    .fetch_all(db)
    .await
}

/// Deliveries to be tried now, the longest overdue first: of every webhook the first that is pending alone, so that
/// each hears of changes in their order.
pub async fn due(db: impl SqliteExecutor<'_>, now_ms: i64, limit: u32) -> sqlx::Result<Vec<DueRow>> {
    sqlx::query_as(
        "SELECT d.*, w.url, w.secret, w.audience, w.job_id, j.name AS job_name, j.created_ms, j.started_ms, j.finished_ms,
                (SELECT COUNT(*) FROM job_images i WHERE i.job_id = j.id) AS images, e.data
         FROM webhook_deliveries d
         JOIN webhooks w ON w.id = d.webhook_id
         JOIN jobs j ON j.id = w.job_id
         JOIN job_events e ON e.job_id = w.job_id AND e.id = d.event_id
         WHERE d.state = 'pending' AND d.next_ms <= ? AND NOT EXISTS (
             SELECT 1 FROM webhook_deliveries f
             WHERE f.webhook_id = d.webhook_id AND f.state = 'pending' AND f.event_id < d.event_id)
         ORDER BY d.next_ms LIMIT ?",
    )
    .bind(now_ms)
    .bind(limit)
    .fetch_all(db)
    .await
}

/// When the next delivery is to be tried; none when none is pending.
pub async fn next_due_ms(db: impl SqliteExecutor<'_>) -> sqlx::Result<Option<i64>> {
    sqlx::query_scalar(
        "SELECT MIN(d.next_ms) FROM webhook_deliveries d WHERE d.state = 'pending' AND NOT EXISTS (
             SELECT 1 FROM webhook_deliveries f
             WHERE f.webhook_id = d.webhook_id AND f.state = 'pending' AND f.event_id < d.event_id)",
    )
    .fetch_one(db)
    .await
}

/// Writes what came of an attempt.
pub async fn update_delivery(db: &mut SqliteConnection, delivery: &DeliveryRow) -> sqlx::Result<()> {
    sqlx::query(
        "UPDATE webhook_deliveries SET state = ?, attempts = ?, next_ms = ?, last_ms = ?, last_status = ?, last_error = ?
         WHERE webhook_id = ? AND event_id = ?",
    )
    .bind(&delivery.state)
    .bind(delivery.attempts)
    .bind(delivery.next_ms)
    .bind(delivery.last_ms)
    .bind(delivery.last_status)
    .bind(&delivery.last_error)
    .bind(&delivery.webhook_id)
    .bind(delivery.event_id)
    .execute(db)
    .await?;
    Ok(())
}
