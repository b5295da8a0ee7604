//! Tasks that are jobs: list, look at, download, cancel, remove, restart.

use std::time::Duration;

use axum::Router;
use axum::extract::{FromRequest, Path, Request, State};
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use uuid::Uuid;

use super::{console, options};
use crate::http::AppState;
use crate::http::access::Principal;
use crate::http::extract::{Json, Query, media_type};
use crate::http::problem::{Code, Problem};
use crate::http::routes::outputs::archive_of;
use crate::jobs::{JobState, share_done, state_of};
use crate::store::db::jobs::{self, JobRow};
use crate::store::db::tokens::Owned;
use crate::store::db::{job_events, job_images, job_stages, now_ms};

/// A running job that is to be cancelled or removed is waited for so long; it stops within five seconds.
const STOP_WAIT: Duration = Duration::from_secs(15);

pub(super) fn router() -> Router<AppState> {
    Router::new()
        .route("/task/list", get(list))
        .route("/task/{uuid}/info", get(info))
        .route("/task/{uuid}/output", get(output))
        .route("/task/cancel", post(cancel))
        .route("/task/remove", post(remove))
        .route("/task/restart", post(restart))
}

/// Answers that may take long.
pub(super) fn download_router() -> Router<AppState> {
    Router::new().route("/task/{uuid}/download/{asset}", get(download))
}

/// The refusal of a task that is not there, or not the sender's.
pub(super) fn unknown(uuid: &str) -> Problem {
    Problem::new(Code::JobNotFound).detail(format!("{uuid} not found"))
}

pub(super) fn parse_id(uuid: &str) -> Result<Uuid, Problem> {
    uuid.parse().map_err(|_| unknown(uuid))
}

/// The job that a task is.
async fn find(state: &AppState, principal: &Principal, uuid: &str) -> Result<(Uuid, JobRow), Problem> {
    let id = parse_id(uuid)?;
    principal.check_sees(state, Owned::Job(id)).await.map_err(|_| unknown(uuid))?;
    let row = jobs::find(state.jobs.store.db.reader(), id).await?.ok_or_else(|| unknown(uuid))?;
    Ok((id, row))
}

async fn list(State(state): State<AppState>, principal: Principal) -> Result<Response, Problem> {
    let owner = principal.sees_only();
    let rows = jobs::list(state.jobs.store.db.reader(), owner.as_deref(), i64::MAX, u32::MAX).await?;
    let tasks: Vec<_> = rows.into_iter().rev().map(|row| json!({ "uuid": row.id })).collect();
    Ok(axum::Json(tasks).into_response())
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct TaskInfo {
    uuid: String,
    name: String,
    date_created: i64,
    /// Milliseconds, -1 before the start.
    processing_time: i64,
    status: Status,
    options: Vec<options::Chosen>,
    images_count: i64,
    /// Per cent.
    progress: f64,
    #[serde(skip_serializing_if = "Option::is_none")]
    output: Option<Vec<String>>,
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Status {
    code: u32,
    #[serde(skip_serializing_if = "Option::is_none")]
    error_message: Option<String>,
}

#[derive(Deserialize)]
struct WithOutput {
    with_output: Option<i64>,
}

async fn info(
    State(state): State<AppState>,
    principal: Principal,
    Path(uuid): Path<String>,
    Query(query): Query<WithOutput>,
) -> Result<Response, Problem> {
    let (id, row) = find(&state, &principal, &uuid).await?;
    let reader = state.jobs.store.db.reader();
    let stages = job_stages::list(reader, id).await?;
    let images = job_images::counts(reader, id).await?;
    let output = match query.with_output {
        Some(from) => Some(console_of(&state, id, from).await?),
        None => None,
    };
    let now = state_of(&row);
    let until = row.finished_ms.unwrap_or_else(now_ms);
    Ok(axum::Json(TaskInfo {
        uuid: row.id,
        name: row.name,
        date_created: row.created_ms,
        processing_time: row.started_ms.map_or(-1, |start| (until - start).max(0)),
        status: Status { code: now.nodeodm_code(), error_message: row.error_message },
        options: options::chosen(&serde_json::from_str(&row.options).unwrap_or_default()),
        images_count: images.uploaded,
        progress: if now == JobState::Succeeded { 100.0 } else { 100.0 * share_done(&stages) },
        output,
    })
    .into_response())
}

async fn console_of(state: &AppState, id: Uuid, from: i64) -> Result<Vec<String>, Problem> {
    let events = job_events::list_after(state.jobs.store.db.reader(), id, 0).await?;
    Ok(console::from_line(console::lines(&events), from))
}

#[derive(Deserialize)]
struct FromLine {
    #[serde(default)]
    line: i64,
}

async fn output(
    State(state): State<AppState>,
    principal: Principal,
    Path(uuid): Path<String>,
    Query(query): Query<FromLine>,
) -> Result<Response, Problem> {
    let (id, _) = find(&state, &principal, &uuid).await?;
    Ok(axum::Json(console_of(&state, id, query.line).await?).into_response())
}

async fn download(
    State(state): State<AppState>,
    principal: Principal,
    Path((uuid, asset)): Path<(String, String)>,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let (id, row) = find(&state, &principal, &uuid).await?;
    if asset != "all.zip" {
        return Err(Problem::new(Code::OutputNotFound).detail("Invalid asset: there is all.zip alone"));
    }
    if state_of(&row) != JobState::Succeeded {
        return Err(Problem::new(Code::OutputNotFound).detail("Invalid asset: the task is not completed"));
    }
    archive_of(&state, id, &headers, "all.zip").await
}

/// The body of a request that changes a task, as a form or as JSON.
#[derive(Deserialize)]
struct Change {
    uuid: String,
    options: Option<Value>,
}

impl Change {
    async fn of(request: Request, state: &AppState) -> Result<Self, Problem> {
        if media_type(request.headers()) == "application/json" {
            let Json(change) = Json::from_request(request, state).await?;
            return Ok(change);
        }
        let form = axum::Form::<Self>::from_request(request, state).await;
        form.map(|axum::Form(change)| change).map_err(|error| Problem::new(Code::BadRequest).detail(error.body_text()))
    }
}

fn success() -> Response {
    axum::Json(json!({ "success": true })).into_response()
}

async fn cancel(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let change = Change::of(request, &state).await?;
    let (id, _) = find(&state, &principal, &change.uuid).await?;
    state.jobs.withdraw(id).await?;
    state.jobs.stopped(id, STOP_WAIT).await?;
    Ok(success())
}

async fn remove(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let change = Change::of(request, &state).await?;
    let (id, row) = find(&state, &principal, &change.uuid).await?;
    if !state_of(&row).is_final() {
        state.jobs.withdraw(id).await?;
        state.jobs.stopped(id, STOP_WAIT).await?;
    }
    state.jobs.delete(id).await?;
    Ok(success())
}

async fn restart(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let change = Change::of(request, &state).await?;
    let (id, _) = find(&state, &principal, &change.uuid).await?;
    let options = change.options.as_ref().map(options::read).transpose()?;
    state.jobs.restart(id, options.as_ref()).await?;
    Ok(success())
}
