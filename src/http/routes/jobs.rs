//! Jobs: make, list, look at, cancel, resume, delete.

use std::collections::BTreeMap;

use axum::Router;
use axum::extract::{FromRequest, Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use uuid::Uuid;

use super::webhooks::WebhookBody;
use crate::http::access::Principal;
use crate::http::extract::{JobId, Json, Page, Query, cut, media_type, whole_number};
use crate::http::problem::{Code, Problem};
use crate::http::submission::{Order, submit};
use crate::http::upload::{Form, Parts, Received};
use crate::http::{AppState, wire};
use crate::jobs::{JobState, NewJob, QueuePlace, state_of};
use crate::store::db::jobs::JobRow;
use crate::store::db::tokens::Owned;
use crate::store::db::{job_images, job_stages, jobs};

/// Quick requests.
pub(in crate::http) fn router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/jobs", get(list))
        .route("/api/v1/jobs/{job_id}", get(show).patch(change).delete(delete))
        .route("/api/v1/jobs/{job_id}/cancel", post(cancel))
        .route("/api/v1/jobs/{job_id}/resume", post(resume))
}

/// Requests that may take long.
pub(in crate::http) fn upload_router() -> Router<AppState> {
    Router::new().route("/api/v1/jobs", post(create))
}

/// A job as it is shown.
async fn view(state: &AppState, row: JobRow) -> Result<wire::Job, Problem> {
    let place = match state_of(&row) {
        JobState::Queued => state.jobs.places(state.config.parallel_jobs).await?.remove(&row.id),
        _ => None,
    };
    view_at(state, row, place).await
}

async fn view_at(state: &AppState, row: JobRow, place: Option<QueuePlace>) -> Result<wire::Job, Problem> {
    let reader = state.jobs.store.db.reader();
    let id: Uuid = row.id.parse().map_err(|error| Problem::internal(&error))?;
    let stages = job_stages::list(reader, id).await?;
    let images = job_images::counts(reader, id).await?;
    Ok(wire::Job::new(row, &stages, images, place))
}

async fn list(
    State(state): State<AppState>,
    principal: Principal,
    Query(page): Query<Page>,
) -> Result<Response, Problem> {
    let limit = page.limit()?;
    let mut rows = jobs::list(
        state.jobs.store.db.reader(),
        principal.sees_only().as_deref(),
        page.number_or(i64::MAX)?,
        limit + 1,
    )
    .await?;
    let next_cursor = cut(&mut rows, limit, |row| row.seq.to_string());
    let mut places = match rows.iter().any(|row| state_of(row) == JobState::Queued) {
        true => state.jobs.places(state.config.parallel_jobs).await?,
        false => BTreeMap::new(),
    };
    let mut shown = Vec::with_capacity(rows.len());
    for row in rows {
        let place = places.remove(&row.id);
        shown.push(view_at(&state, row, place).await?);
    }
    Ok(axum::Json(wire::JobPage { jobs: shown, next_cursor }).into_response())
}

async fn show(State(state): State<AppState>, JobId(id): JobId) -> Result<Response, Problem> {
    let row = state.jobs.find(id).await?;
    Ok(axum::Json(view(&state, row).await?).into_response())
}

/// The JSON body of a change.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct JobChange {
    #[serde(deserialize_with = "whole_number")]
    priority: i64,
}

async fn change(
    State(state): State<AppState>,
    principal: Principal,
    JobId(id): JobId,
    Json(body): Json<JobChange>,
) -> Result<Response, Problem> {
    principal.check_priority(body.priority)?;
    let row = state.jobs.set_priority(id, body.priority).await?;
    Ok(axum::Json(view(&state, row).await?).into_response())
}

async fn delete(State(state): State<AppState>, JobId(id): JobId) -> Result<StatusCode, Problem> {
    state.jobs.delete(id).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn cancel(State(state): State<AppState>, JobId(id): JobId) -> Result<Response, Problem> {
    let row = state.jobs.cancel(id).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(view(&state, row).await?)).into_response())
}

async fn resume(State(state): State<AppState>, JobId(id): JobId) -> Result<Response, Problem> {
    let row = state.jobs.resume(id).await?;
    Ok((StatusCode::ACCEPTED, axum::Json(view(&state, row).await?)).into_response())
}

/// The JSON body of a new job.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NewJobBody {
    dataset_id: Uuid,
    #[serde(default)]
    name: String,
    #[serde(default, deserialize_with = "whole_number")]
    priority: i64,
    options: Option<serde_json::Map<String, serde_json::Value>>,
    webhook: Option<WebhookBody>,
}

async fn create(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let row = match media_type(request.headers()).as_str() {
        "multipart/form-data" => {
            let parts = Parts::of(request).await?;
            submit(&state, &principal, Uuid::now_v7(), parts, Form::Job, |received| {
                Ok(Order {
                    name: received.text("name").unwrap_or_default().to_owned(),
                    options: options_of(received)?,
                    priority: priority_of(received)?,
                    webhook: webhook_of(received)?.map(|webhook| webhook.check(&state)).transpose()?,
                })
            })
            .await?
        }
        "application/json" => {
            let Json(body): Json<NewJobBody> = Json::from_request(request, &state).await?;
            principal.check_sees(&state, Owned::Dataset(body.dataset_id)).await?;
            principal.check_priority(body.priority)?;
            let new = NewJob {
                id: Uuid::now_v7(),
                name: body.name,
                dataset: body.dataset_id,
                options: serde_json::Value::Object(body.options.unwrap_or_default()),
                ignored: None,
                priority: body.priority,
                owner_token: principal.owner(),
                webhook: body.webhook.map(|webhook| webhook.check(&state)).transpose()?,
            };
            state.jobs.enqueue(new).await?
        }
        _ => {
            let message = "the body must be multipart/form-data or application/json";
            return Err(Problem::new(Code::UnsupportedMediaType).detail(message));
        }
    };
    let location = wire::job_link(&row.id);
    let mut response = (StatusCode::ACCEPTED, axum::Json(view(&state, row).await?)).into_response();
    if let Ok(location) = HeaderValue::from_str(&location) {
        response.headers_mut().insert(header::LOCATION, location);
    }
    Ok(response)
}

fn priority_of(received: &Received) -> Result<i64, Problem> {
    let text = received.text("priority").unwrap_or("0");
    serde_json::from_str::<serde_json::Value>(text)
        .and_then(whole_number)
        .map_err(|_| Problem::new(Code::InvalidPriority).detail(format!("priority {text:?} is no whole number")))
}

fn options_of(received: &Received) -> Result<serde_json::Value, Problem> {
    let options: serde_json::Value = serde_json::from_str(received.text("options").unwrap_or("{}"))
        .map_err(|error| Problem::new(Code::InvalidJson).detail(format!("options: {error}")))?;
    if !options.is_object() {
        return Err(Problem::new(Code::InvalidOptions).detail("the options must be a JSON object"));
    }
    Ok(options)
}

fn webhook_of(received: &Received) -> Result<Option<WebhookBody>, Problem> {
    let invalid = |error| Problem::new(Code::InvalidJson).detail(format!("webhook: {error}"));
    received.text("webhook").map(|text| serde_json::from_str(text).map_err(invalid)).transpose()
}
