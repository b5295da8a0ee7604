//! The web service: a router over the job queue and the store. `openapi.yaml` is its contract.

mod access;
mod connection;
mod disposition;
mod download;
mod extract;
mod metrics;
mod nodeodm;
mod page;
mod problem;
mod routes;
mod server;
mod submission;
mod thumbnail;
mod tus;
mod unread;
mod upload;
mod wire;

use std::any::Any;
use std::sync::Arc;
use std::time::Instant;

use axum::Router;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::{HeaderName, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::timeout::TimeoutLayer;
use tracing::Instrument;
use uuid::Uuid;

use access::RateLimits;
pub use metrics::Metrics;
pub use problem::{Code, Problem};
pub use server::{Server, ServerError};

use crate::config::ServerConfig;
use crate::jobs::Jobs;

/// Photographs decoded for thumbnails at once.
const DECODERS: usize = 2;

/// What every handler can reach.
#[derive(Clone)]
pub struct AppState {
    /// The queue and the store.
    pub jobs: Jobs,
    /// Settings of the process.
    pub config: Arc<ServerConfig>,
    /// Counters of the process.
    pub metrics: Arc<Metrics>,
    /// Cancelled when the service stops: open event streams end.
    pub shutdown: CancellationToken,
    /// Requests of tokens and guesses of addresses.
    rates: Arc<RateLimits>,
    /// The resumable uploads that requests work on.
    uploads: tus::UploadLocks,
    /// Bounds the memory that photographs on their way take.
    waiting: tus::WaitingRoom,
    /// Bounds the memory that decoding takes.
    decoders: Arc<Semaphore>,
}

impl AppState {
    /// A state around a queue.
    pub fn new(jobs: Jobs, config: ServerConfig, shutdown: CancellationToken) -> Self {
        let rates = RateLimits::new(config.access.requests_per_s, config.access.failures_per_min);
        Self {
            jobs,
            waiting: tus::WaitingRoom::new(&config.uploads),
            config: Arc::new(config),
            rates: Arc::new(rates),
            metrics: Arc::default(),
            shutdown,
            uploads: tus::UploadLocks::default(),
            decoders: Arc::new(Semaphore::new(DECODERS)),
        }
    }
}

/// The whole service. Layers from the outside in: request id, log and problems; panics; headers for browsers; other
/// sites; then, by route, who asks.
pub fn router(state: AppState) -> Router {
    let timeout = TimeoutLayer::with_status_code(StatusCode::REQUEST_TIMEOUT, state.config.request_timeout);
    let quick = Router::new()
        .merge(routes::jobs::router())
        .merge(routes::datasets::router())
        .merge(routes::job_images::router())
        .merge(routes::webhooks::router())
        .merge(routes::outputs::router())
        .merge(routes::service::router())
        .layer(timeout);
    // What tells nothing about anybody's things, and the page, which asks for the rest.
    let open = routes::service::open_router().layer(timeout);
    // Uploads have an idle limit of their own; downloads and event streams last as long as they last.
    let slow = Router::new()
        .merge(routes::jobs::upload_router())
        .merge(routes::datasets::upload_router())
        .merge(routes::uploads::router())
        .merge(routes::outputs::download_router())
        .merge(routes::job_events::router())
        // The upload counts for itself, and its limit is far above what any other body may have.
        .layer(DefaultBodyLimit::disable());
    quick
        .merge(slow)
        .layer(middleware::from_fn_with_state(state.clone(), access::admit))
        .merge(open)
        .fallback(|| async { Problem::new(Code::NotFound) })
        .method_not_allowed_fallback(|| async { Problem::new(Code::MethodNotAllowed) })
        .layer(middleware::from_fn_with_state(state.clone(), access::guard_browsers))
        .layer(middleware::map_response(browser_headers))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn_with_state(state.clone(), account))
        .with_state(state)
}

/// Gives the request an id, logs it, counts it, and makes every error answer a problem.
async fn account(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let request_id = Uuid::now_v7().to_string();
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let span = tracing::info_span!("request", %request_id, %method, path);
    let start = Instant::now();
    let mut response = next.run(request).instrument(span.clone()).await;
    let status = response.status();
    if status.is_client_error() || status.is_server_error() {
        let problem = response.extensions_mut().remove().unwrap_or_else(|| Problem::of_status(status));
        state.metrics.refused(problem.code());
        problem.write(&mut response, &request_id);
    }
    if let Ok(value) = HeaderValue::from_str(&request_id) {
        response.headers_mut().insert("x-request-id", value);
    }
    state.metrics.answered(status);
    let duration_ms = start.elapsed().as_millis();
    span.in_scope(|| tracing::info!(status = status.as_u16(), duration_ms, "answered"));
    response
}

/// What keeps a browser from guessing types, framing the page or telling other sites where it was.
async fn browser_headers(mut response: Response) -> Response {
    const HEADERS: [(HeaderName, &str); 5] = [
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::REFERRER_POLICY, "no-referrer"),
        (header::X_FRAME_OPTIONS, "DENY"),
        (HeaderName::from_static("cross-origin-resource-policy"), "same-origin"),
        (header::CONTENT_SECURITY_POLICY, "default-src 'none'; frame-ancestors 'none'"),
    ];
    for (name, value) in HEADERS {
        response.headers_mut().entry(name).or_insert(HeaderValue::from_static(value));
    }
    if !response.headers().contains_key(header::CACHE_CONTROL) {
        response.headers_mut().insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    }
    response
}

/// A panic ends its request alone. What it said is in the log already.
fn panicked(_: Box<dyn Any + Send>) -> Response {
    Problem::new(Code::InternalError).into_response()
}
