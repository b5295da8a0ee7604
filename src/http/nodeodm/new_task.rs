//! New tasks: begun, filled and committed in three kinds of requests, or sent in one. Every one of them may be sent
//! again when its answer was lost.

use axum::Router;
use axum::extract::{Path, Request, State};
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use axum::routing::post;
use serde_json::{Value, json};
use uuid::Uuid;

use super::options;
use super::tasks::{parse_id, unknown};
use crate::http::AppState;
use crate::http::access::Principal;
use crate::http::problem::{Code, Problem};
use crate::http::submission::{Order, submit};
use crate::http::upload::{Form, Parts, Received, receive};
use crate::jobs::view::time_text;
use crate::jobs::webhooks::NewWebhook;
use crate::jobs::{JobsError, NewJob};
use crate::store::db::nodeodm_tasks::{self, NodeOdmTaskRow};
use crate::store::db::{datasets, now_ms, tokens};

/// That a task got a photograph is noted so often; it is kept for days.
const TOUCH_EVERY_MS: i64 = 60_000;

pub(super) fn router() -> Router<AppState> {
    Router::new()
        .route("/task/new", post(at_once))
        .route("/task/new/init", post(begin))
        .route("/task/new/upload/{uuid}", post(upload))
        .route("/task/new/commit/{uuid}", post(commit))
}

fn named(id: Uuid) -> Response {
    axum::Json(json!({ "uuid": id.to_string() })).into_response()
}

/// The id that the sender wants, or a new one.
fn wanted_id(headers: &HeaderMap) -> Result<Uuid, Problem> {
    let invalid = || Problem::new(Code::BadRequest).detail("set-uuid is no UUID");
    match headers.get("set-uuid") {
        None => Ok(Uuid::now_v7()),
        Some(id) => id.to_str().ok().and_then(|id| id.parse().ok()).ok_or_else(invalid),
    }
}

/// Name, options and webhook of a task.
fn read(state: &AppState, received: &Received) -> Result<Order, Problem> {
    if received.text("zipurl").is_some() {
        return Err(Problem::new(Code::BadRequest).detail("zipurl is not supported: send the photographs"));
    }
    let name = received.text("name").map_or_else(|| format!("Task of {}", time_text(now_ms())), str::to_owned);
    let options = received.text("options").map_or(Value::Null, |text| Value::String(text.to_owned()));
    let webhook = received.text("webhook").map(|url| NewWebhook::of_task(url, &state.config.webhooks)).transpose()?;
    Ok(Order { name, options: options::read(&options)?, priority: 0, webhook })
}

/// Whether a task with this id is a job already; an error when it is somebody else's.
async fn is_committed(state: &AppState, principal: &Principal, id: Uuid) -> Result<bool, Problem> {
    match tokens::owner(state.jobs.store.db.reader(), tokens::Owned::Job(id)).await? {
        None => Ok(false),
        Some(owner) if principal.sees_only().is_none_or(|own| owner == Some(own)) => Ok(true),
        Some(_) => Err(taken()),
    }
}

fn taken() -> Problem {
    Problem::new(Code::BadRequest).detail("the UUID is taken")
}

/// The task that photographs are still sent to.
async fn find_open(state: &AppState, principal: &Principal, id: Uuid) -> Result<Option<NodeOdmTaskRow>, Problem> {
    let task = nodeodm_tasks::find(state.jobs.store.db.reader(), id).await?;
    Ok(task.filter(|task| principal.sees_only().is_none_or(|own| task.owner_token == Some(own))))
}

async fn begin(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let id = wanted_id(request.headers())?;
    // Photographs do not come yet, so the dataset they would go to need not be there.
    let received = receive(&state, Parts::of(request).await?, Uuid::nil(), Form::NodeOdm).await?;
    let Order { name, options, webhook, .. } = read(&state, &received)?;
    state.jobs.check(&name, &options)?;
    if is_committed(&state, &principal, id).await? {
        return Err(taken());
    }
    let store = &state.jobs.store;
    let (now, owner) = (now_ms(), principal.owner());
    let task = NodeOdmTaskRow {
        id: id.to_string(),
        dataset_id: Uuid::now_v7().to_string(),
        options: options.to_string(),
        touched_ms: now,
        owner_token: owner.map(|token| token.to_string()),
        webhook: webhook.map(|webhook| webhook.url().to_owned()),
    };
    let mut tx = store.db.write().await?;
    match nodeodm_tasks::find(&mut *tx, id).await? {
        // Sent again, because the answer was lost.
        Some(begun) if begun.owner_token == task.owner_token => return Ok(named(id)),
        Some(_) => return Err(taken()),
        None => {}
    }
    let dataset = parse_id(&task.dataset_id)?;
    datasets::insert(&mut tx, dataset, &name, now, None, owner).await?;
    nodeodm_tasks::insert(&mut tx, &task).await?;
    tx.commit().await?;
    Ok(named(id))
}

async fn upload(
    State(state): State<AppState>,
    principal: Principal,
    Path(uuid): Path<String>,
    request: Request,
) -> Result<Response, Problem> {
    let id = parse_id(&uuid)?;
    let task = find_open(&state, &principal, id).await?.ok_or_else(|| unknown(&uuid))?;
    let received = receive(&state, Parts::of(request).await?, parse_id(&task.dataset_id)?, Form::NodeOdm).await?;
    if !received.has_files() {
        return Ok(axum::Json(json!({ "error": "Need at least 1 file.", "noRetry": true })).into_response());
    }
    let now = now_ms();
    if now - task.touched_ms > TOUCH_EVERY_MS {
        let mut tx = state.jobs.store.db.write().await?;
        nodeodm_tasks::touch(&mut tx, id, now).await?;
        tx.commit().await?;
    }
    Ok(axum::Json(json!({ "success": true })).into_response())
}

async fn commit(
    State(state): State<AppState>,
    principal: Principal,
    Path(uuid): Path<String>,
) -> Result<Response, Problem> {
    let id = parse_id(&uuid)?;
    let Some(task) = find_open(&state, &principal, id).await? else {
        // Sent again, because the answer was lost.
        return if is_committed(&state, &principal, id).await? { Ok(named(id)) } else { Err(unknown(&uuid)) };
    };
    let webhook = task.webhook.as_deref().map(|url| NewWebhook::of_task(url, &state.config.webhooks)).transpose()?;
    let new = NewJob {
        id,
        // The dataset has it.
        name: String::new(),
        dataset: parse_id(&task.dataset_id)?,
        options: serde_json::from_str(&task.options).map_err(|error| Problem::internal(&error))?,
        ignored: None,
        priority: 0,
        owner_token: principal.owner(),
        webhook,
    };
    match state.jobs.enqueue(new).await {
        Ok(_) => Ok(named(id)),
        Err(JobsError::NoImages) => Err(Problem::new(Code::NoImages).detail("Not enough images")),
        // Another request committed it meanwhile.
        Err(JobsError::Store(_)) if is_committed(&state, &principal, id).await? => Ok(named(id)),
        Err(error) => Err(error.into()),
    }
}

async fn at_once(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    let id = wanted_id(request.headers())?;
    if is_committed(&state, &principal, id).await? || find_open(&state, &principal, id).await?.is_some() {
        return Err(taken());
    }
    submit(&state, &principal, id, Parts::of(request).await?, Form::NodeOdm, |received| read(&state, received)).await?;
    Ok(named(id))
}
