//! What the node is and can: information, options, and the address where clients ask how to log in.

use axum::Router;
use axum::extract::State;
use axum::response::{IntoResponse, Response};
use axum::routing::{get, post};
use serde::Serialize;
use serde_json::json;

use super::options;
use crate::http::AppState;
use crate::http::problem::Problem;
use crate::store::db::jobs;

/// The version of NodeODM whose interface this is; clients choose by it how they upload.
const INTERFACE_VERSION: &str = "2.2.4";

pub(super) fn router() -> Router<AppState> {
    Router::new().route("/info", get(info)).route("/options", get(list_options))
}

/// What needs no token: how to come by one.
pub(super) fn open_router() -> Router<AppState> {
    Router::new().route("/auth/info", get(login)).route("/auth/login", post(login)).route("/auth/register", post(login))
}

#[derive(Serialize)]
#[serde(rename_all = "camelCase")]
struct Info {
    version: &'static str,
    task_queue_count: i64,
    total_memory: Option<u64>,
    available_memory: Option<u64>,
    cpu_cores: usize,
    /// None: no limit that these clients should plan by.
    max_images: Option<usize>,
    max_parallel_tasks: usize,
    engine: &'static str,
    engine_version: &'static str,
}

async fn info(State(state): State<AppState>) -> Result<Response, Problem> {
    let jobs = jobs::count_by_state(state.jobs.store.db.reader()).await?;
    let count = |state: &str| jobs.get(state).copied().unwrap_or(0);
    let memory = tokio::fs::read_to_string("/proc/meminfo").await.unwrap_or_default();
    Ok(axum::Json(Info {
        version: INTERFACE_VERSION,
        task_queue_count: count("queued") + count("running"),
        total_memory: memory_bytes(&memory, "MemTotal"),
        available_memory: memory_bytes(&memory, "MemAvailable"),
        cpu_cores: std::thread::available_parallelism().map_or(1, usize::from),
        max_images: None,
        max_parallel_tasks: state.config.parallel_jobs,
        engine: env!("CARGO_PKG_NAME"),
        engine_version: env!("CARGO_PKG_VERSION"),
    })
    .into_response())
}

/// A figure of Linux's `/proc/meminfo`, which counts in KiB.
fn memory_bytes(meminfo: &str, name: &str) -> Option<u64> {
    let line = meminfo.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(':'))?;
    let kibibytes: u64 = line.trim().strip_suffix("kB")?.trim().parse().ok()?;
    Some(kibibytes * 1024)
}

async fn list_options() -> Response {
    axum::Json(options::descriptions()).into_response()
}

/// There is nothing to log in to: a token is made by whoever runs the service.
async fn login(State(state): State<AppState>) -> Response {
    let message = if state.config.access.token_required {
        "Add ?token=<token>: whoever runs this node makes tokens with `multistage token create`."
    } else {
        "Authentication is not required."
    };
    axum::Json(json!({ "message": message, "loginUrl": null, "registerUrl": null })).into_response()
}
