//! A second face of the service: the interface of NodeODM, which WebODM, CloudODM, ClusterODM and PyODM speak. A task
//! is the job of the same id; datasets, jobs, tokens and limits are those of the rest.
//!
//! Its clients take an error for one only when it comes as `{"error": "..."}` with status 200, and a missing token
//! likewise; what they should try again has its honest status.

mod answers;
mod console;
mod new_task;
mod node;
mod options;
mod tasks;

use axum::Router;
use axum::extract::{DefaultBodyLimit, Request, State};
use axum::http::StatusCode;
use axum::middleware::{self, Next};
use axum::response::Response;
use tower_http::catch_panic::CatchPanicLayer;
use tower_http::timeout::TimeoutLayer;

use super::problem::{Code, Problem};
use super::{AppState, access, browser_headers, panicked};

/// The whole interface, for a listener of its own: its clients take no prefix of paths.
pub(super) fn router(state: AppState) -> Router {
    let timeout = TimeoutLayer::with_status_code(StatusCode::REQUEST_TIMEOUT, state.config.request_timeout);
    let quick = Router::new().merge(node::router()).merge(tasks::router()).layer(timeout);
    // As for the service's own uploads and downloads.
    let slow =
        Router::new().merge(new_task::router()).merge(tasks::download_router()).layer(DefaultBodyLimit::disable());
    quick
        .merge(slow)
        .layer(middleware::from_fn_with_state(state.clone(), admit))
        .merge(node::open_router())
        .fallback(|| async { Problem::new(Code::NotFound) })
        .method_not_allowed_fallback(|| async { Problem::new(Code::MethodNotAllowed) })
        .layer(middleware::from_fn_with_state(state.clone(), access::guard_browsers))
        .layer(middleware::map_response(browser_headers))
        .layer(CatchPanicLayer::custom(panicked))
        .layer(middleware::from_fn_with_state(state.clone(), answers::account))
        .with_state(state)
}

/// Lets a request through once it is known who asks: by `?token=`, as these clients do, or as everywhere else.
async fn admit(State(state): State<AppState>, mut request: Request, next: Next) -> Response {
    let query = request.uri().query().unwrap_or("");
    let token = query.split('&').find_map(|pair| pair.strip_prefix("token="));
    let token = token.map(|token| percent_encoding::percent_decode_str(token).decode_utf8_lossy().into_owned());
    let secret = token.or_else(|| access::secret(request.headers()));
    match access::identify(&state, access::Sender::of(&request), secret).await {
        Ok(principal) => {
            request.extensions_mut().insert(principal);
            next.run(request).await
        }
        Err(refusal) => refusal,
    }
}
