//! What a job made: the list, single files, and everything as one archive.

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use uuid::Uuid;

use crate::http::download::{self, Entity};
use crate::http::extract::{JobId, RestOfPath};
use crate::http::problem::{Code, Problem};
use crate::http::{AppState, wire};
use crate::store::db::job_outputs;

/// Outputs may be pages with scripts made out of what senders named and wrote: they run in an origin of their own and
/// load nothing.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; \
     script-src 'unsafe-inline'; sandbox allow-scripts allow-popups";

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new().route("/api/v1/jobs/{job_id}/outputs", get(list))
}

/// Answers that may take long.
pub(in crate::http) fn download_router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/jobs/{job_id}/outputs/{*path}", get(file))
        .route("/api/v1/jobs/{job_id}/outputs.zip", get(archive))
}

async fn list(State(state): State<AppState>, JobId(job): JobId) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    let rows = job_outputs::list(state.jobs.store.db.reader(), job).await?;
    Ok(axum::Json(wire::OutputList::new(job, rows)).into_response())
}

async fn file(
    State(state): State<AppState>,
    JobId(job): JobId,
    RestOfPath(path): RestOfPath,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let missing = || Problem::new(Code::OutputNotFound).path(&path);
    state.jobs.find(job).await?;
    // Only what is in the list is served, so the path can't lead anywhere else.
    let row = job_outputs::find(state.jobs.store.db.reader(), job, &path).await?.ok_or_else(missing)?;
    let file = state.jobs.store.data.out(job).join(&row.path);
    let entity = Entity {
        file: &file,
        size_bytes: u64::try_from(row.size_bytes).unwrap_or(0),
        etag: download::etag(&row.blake3),
        media_type: download::media_type_of(&row.path),
    };
    let mut response = download::serve(&headers, entity).await?;
    let policy = HeaderValue::from_static(CONTENT_SECURITY_POLICY);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(response)
}

async fn archive(State(state): State<AppState>, JobId(job): JobId, headers: HeaderMap) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    archive_of(&state, job, &headers, &format!("multistage-{job}.zip")).await
}

/// Everything a job made as one archive, under a name for the client's disk.
pub(in crate::http) async fn archive_of(
    state: &AppState,
    job: Uuid,
    headers: &HeaderMap,
    name: &str,
) -> Result<Response, Problem> {
    let outputs = state.jobs.store.outputs_to_archive(job).await?;
    if outputs.is_empty() {
        return Err(Problem::new(Code::OutputNotFound).detail("the job has made nothing yet"));
    }
    let mut response = download::serve_archive(headers, &state.jobs.store.data.out(job), &outputs);
    if let Ok(name) = HeaderValue::from_str(&format!("attachment; filename=\"{name}\"")) {
        response.headers_mut().insert(header::CONTENT_DISPOSITION, name);
    }
    Ok(response)
}
