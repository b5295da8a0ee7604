//! Webhooks of a job: add, list with what became of them, remove.

use std::collections::BTreeMap;

use axum::Router;
use axum::extract::State;
use axum::http::StatusCode;
use axum::response::{IntoResponse, Response};
use axum::routing::{delete, get};
use serde::Deserialize;

use crate::http::extract::{JobId, Json, WebhookId};
use crate::http::problem::{Code, Problem};
use crate::http::{AppState, wire};
use crate::jobs::webhooks::NewWebhook;
use crate::store::db::webhooks::{self, DeliveryRow};

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/jobs/{job_id}/webhooks", get(list).post(add))
        .route("/api/v1/jobs/{job_id}/webhooks/{webhook_id}", delete(remove))
}

/// Where to call, and what to sign with.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
pub(in crate::http) struct WebhookBody {
    url: String,
    secret: String,
}

impl WebhookBody {
    /// # Errors
    /// Why it is refused.
    pub(in crate::http) fn check(&self, state: &AppState) -> Result<NewWebhook, Problem> {
        Ok(NewWebhook::parse(&self.url, &self.secret, &state.config.webhooks)?)
    }
}

async fn list(State(state): State<AppState>, JobId(job): JobId) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    let reader = state.jobs.store.db.reader();
    let rows = webhooks::list(reader, job).await?;
    let mut deliveries: BTreeMap<String, Vec<DeliveryRow>> = BTreeMap::new();
    for row in webhooks::deliveries(reader, job).await? {
        deliveries.entry(row.webhook_id.clone()).or_default().push(row);
    }
    let webhooks = rows
        .into_iter()
        .map(|row| {
            let deliveries = deliveries.remove(&row.id).unwrap_or_default();
            wire::Webhook::new(row, deliveries)
        })
        .collect();
    Ok(axum::Json(wire::WebhookList { webhooks }).into_response())
}

async fn add(
    State(state): State<AppState>,
    JobId(job): JobId,
    Json(body): Json<WebhookBody>,
) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    let row = state.jobs.add_webhook(job, &body.check(&state)?).await?;
    Ok((StatusCode::CREATED, axum::Json(wire::Webhook::new(row, Vec::new()))).into_response())
}

async fn remove(
    State(state): State<AppState>,
    JobId(job): JobId,
    WebhookId(id): WebhookId,
) -> Result<StatusCode, Problem> {
    state.jobs.find(job).await?;
    let mut tx = state.jobs.store.db.write().await?;
    if !webhooks::delete(&mut tx, job, id).await? {
        return Err(Problem::new(Code::WebhookNotFound));
    }
    tx.commit().await?;
    Ok(StatusCode::NO_CONTENT)
}
