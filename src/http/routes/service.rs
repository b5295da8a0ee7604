//! Health, figures, the contract and the page.

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;

use crate::http::extract::RestOfPath;
use crate::http::metrics::Readings;
use crate::http::problem::{Code, Problem};
use crate::http::{AppState, page, wire};
use crate::store::db::{jobs, now_ms};

/// With less space left, no new work is taken.
const LEAST_FREE_BYTES: u64 = 64 << 20;

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new().route("/metrics", get(metrics))
}

/// What everybody may see.
pub(in crate::http) fn open_router() -> Router<AppState> {
    Router::new()
        .route("/healthz", get(health))
        .route("/readyz", get(ready))
        .route("/openapi.yaml", get(openapi))
        .route("/", get(index))
        .route("/static/{*path}", get(file))
}

fn well() -> Response {
    axum::Json(wire::Health { status: "ok", version: env!("CARGO_PKG_VERSION") }).into_response()
}

async fn health() -> Response {
    well()
}

async fn ready(State(state): State<AppState>) -> Result<Response, Problem> {
    let not_ready = |why: String| Problem::new(Code::NotReady).detail(why);
    if state.shutdown.is_cancelled() {
        return Err(not_ready("the service is stopping".to_owned()));
    }
    let store = &state.jobs.store;
    jobs::count_by_state(store.db.reader()).await.map_err(|error| not_ready(format!("the database fails: {error}")))?;
    let space =
        rustix::fs::statvfs(store.data.root()).map_err(|error| not_ready(format!("the disk fails: {error}")))?;
    if space.f_bavail.saturating_mul(space.f_frsize) < LEAST_FREE_BYTES {
        return Err(not_ready("the disk is full".to_owned()));
    }
    Ok(well())
}

async fn metrics(State(state): State<AppState>) -> Result<Response, Problem> {
    let reader = state.jobs.store.db.reader();
    let waiting = jobs::queue(reader, "queued").await?;
    let oldest_ms = waiting.iter().map(|job| job.created_ms).min();
    let readings = Readings {
        jobs: jobs::count_by_state(reader).await?,
        oldest_wait_s: oldest_ms.map(|since| (now_ms() - since).max(0) as f64 / 1000.0),
        sums: state.jobs.figures.sums(),
        writes: state.jobs.store.db.write_figures(),
        disk_free_bytes: state.jobs.store.disk_free_bytes().ok(),
    };
    let media_type = [(header::CONTENT_TYPE, "text/plain; version=0.0.4; charset=utf-8")];
    Ok((media_type, state.metrics.text(&readings)).into_response())
}

async fn openapi() -> Response {
    ([(header::CONTENT_TYPE, "application/yaml")], include_str!("../../../openapi.yaml")).into_response()
}

async fn index(headers: HeaderMap) -> Result<Response, Problem> {
    page::serve(&headers, "index.html")
}

async fn file(RestOfPath(path): RestOfPath, headers: HeaderMap) -> Result<Response, Problem> {
    page::serve(&headers, &path)
}
