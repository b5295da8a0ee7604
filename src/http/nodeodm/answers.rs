//! How errors are told.

use std::time::Instant;

use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderValue, StatusCode, header};
use axum::middleware::Next;
use axum::response::Response;
use serde_json::json;
use tracing::Instrument;
use uuid::Uuid;

use crate::http::AppState;
use crate::http::problem::{Code, Problem};

/// What clients look for to ask for another token.
const WRONG_TOKEN: &str = "Invalid authentication token: token does not match.";

/// Gives the request an id, logs it without its query (the token stands there), counts it, and writes problems as these clients
/// read them.
pub(super) async fn account(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let request_id = Uuid::now_v7().to_string();
    let (method, path) = (request.method().clone(), request.uri().path().to_owned());
    let span = tracing::info_span!("nodeodm", %request_id, %method, path);
    let start = Instant::now();
    let mut response = next.run(request).instrument(span.clone()).await;
    if response.status().is_client_error() || response.status().is_server_error() {
        let problem = response.extensions_mut().remove().unwrap_or_else(|| Problem::of_status(response.status()));
        write(&problem, &mut response);
    }
    if let Ok(value) = HeaderValue::from_str(&request_id) {
        response.headers_mut().insert("x-request-id", value);
    }
    state.metrics.answered(response.status());
    let duration_ms = start.elapsed().as_millis();
    span.in_scope(|| tracing::info!(status = response.status().as_u16(), duration_ms, "answered"));
    response
}

/// The status a problem has here.
fn status_of(code: Code) -> StatusCode {
    match code {
        Code::CrossSite
        | Code::NotFound
        | Code::MethodNotAllowed
        | Code::RequestTimeout
        | Code::RangeNotSatisfiable
        | Code::RateLimited
        | Code::InternalError
        | Code::NotReady
        | Code::DiskFull => code.status(),
        _ => StatusCode::OK,
    }
}

fn write(problem: &Problem, response: &mut Response) {
    let message = match problem.code() {
        Code::Unauthorized => WRONG_TOKEN.to_owned(),
        _ => problem.sentence(),
    };
    *response.status_mut() = status_of(problem.code());
    *response.body_mut() = Body::from(json!({ "error": message }).to_string());
    let headers = response.headers_mut();
    headers.remove(header::CONTENT_LENGTH);
    headers.remove(header::WWW_AUTHENTICATE);
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/json"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
}
