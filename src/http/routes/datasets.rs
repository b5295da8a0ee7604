//! Datasets: make, list, look at, fill, delete.

use axum::Router;
use axum::extract::{Request, State};
use axum::http::{StatusCode, header};
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::Deserialize;
use uuid::Uuid;

use crate::http::access::Principal;
use crate::http::extract::{DatasetId, Json, Page, Query, cut, media_type};
use crate::http::problem::{Code, Problem};
use crate::http::upload::{Form, Parts, receive};
use crate::http::{AppState, wire};
use crate::jobs::MAX_NAME_CHARS;
use crate::store::db::datasets::DatasetRow;
use crate::store::db::{dataset_images, datasets, now_ms};

/// Quick requests.
pub(in crate::http) fn router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/datasets", get(list).post(create))
        .route("/api/v1/datasets/{dataset_id}", get(show).delete(delete))
        .route("/api/v1/datasets/{dataset_id}/images", get(images))
}

/// Requests that may take long.
pub(in crate::http) fn upload_router() -> Router<AppState> {
    Router::new().route("/api/v1/datasets/{dataset_id}/images", post(add_images))
}

async fn find(state: &AppState, id: Uuid) -> Result<DatasetRow, Problem> {
    datasets::find(state.jobs.store.db.reader(), id).await?.ok_or_else(|| Problem::new(Code::DatasetNotFound))
}

async fn list(
    State(state): State<AppState>,
    principal: Principal,
    Query(page): Query<Page>,
) -> Result<Response, Problem> {
    let limit = page.limit()?;
    let mut rows = datasets::list(
        state.jobs.store.db.reader(),
        principal.sees_only().as_deref(),
        page.number_or(i64::MAX)?,
        limit + 1,
    )
    .await?;
    let next_cursor = cut(&mut rows, limit, |row| row.seq.to_string());
    let datasets = rows.into_iter().map(wire::Dataset::new).collect();
    Ok(axum::Json(wire::DatasetPage { datasets, next_cursor }).into_response())
}

/// The JSON body of a new dataset.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct NewDatasetBody {
    #[serde(default)]
    name: String,
}

async fn create(
    State(state): State<AppState>,
    principal: Principal,
    Json(body): Json<NewDatasetBody>,
) -> Result<Response, Problem> {
    if body.name.chars().count() > MAX_NAME_CHARS {
        return Err(Problem::new(Code::InvalidName).detail(format!("a name has at most {MAX_NAME_CHARS} letters")));
    }
    let id = Uuid::now_v7();
    let mut tx = state.jobs.store.db.write().await?;
    datasets::insert(&mut tx, id, &body.name, now_ms(), None, principal.owner()).await?;
    tx.commit().await?;
    let dataset = wire::Dataset::new(find(&state, id).await?);
    let location = [(header::LOCATION, format!("/api/v1/datasets/{id}"))];
    Ok((StatusCode::CREATED, location, axum::Json(dataset)).into_response())
}

async fn show(State(state): State<AppState>, DatasetId(id): DatasetId) -> Result<Response, Problem> {
    Ok(axum::Json(wire::Dataset::new(find(&state, id).await?)).into_response())
}

async fn delete(State(state): State<AppState>, DatasetId(id): DatasetId) -> Result<StatusCode, Problem> {
    state.jobs.delete_dataset(id).await?;
    Ok(StatusCode::NO_CONTENT)
}

async fn images(
    State(state): State<AppState>,
    DatasetId(id): DatasetId,
    Query(page): Query<Page>,
) -> Result<Response, Problem> {
    let limit = page.limit()?;
    find(&state, id).await?;
    let mut rows = dataset_images::list(state.jobs.store.db.reader(), id, page.text(), limit + 1).await?;
    let next_cursor = cut(&mut rows, limit, |row| row.path.clone());
    let images = rows.into_iter().map(wire::DatasetImage::new).collect();
    Ok(axum::Json(wire::DatasetImagePage { images, next_cursor }).into_response())
}

async fn add_images(
    State(state): State<AppState>,
    DatasetId(id): DatasetId,
    request: Request,
) -> Result<Response, Problem> {
    if media_type(request.headers()) != "multipart/form-data" {
        return Err(Problem::new(Code::UnsupportedMediaType).detail("the body must be multipart/form-data"));
    }
    find(&state, id).await?;
    let parts = Parts::of(request).await?;
    let received = receive(&state, parts, id, Form::Photographs).await?;
    let result = wire::UploadResult {
        stored: received.stored,
        unchanged: received.unchanged,
        ignored: received.ignored_names,
        dataset: wire::Dataset::new(find(&state, id).await?),
    };
    Ok(axum::Json(result).into_response())
}
