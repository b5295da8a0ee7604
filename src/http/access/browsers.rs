//! What pages of other sites may do with this service: nothing, unless they are on the list.
//!
//! A browser sends its stored credentials along with whatever a page of another site makes it send, and reaches
//! services that listen on its own machine only. So a request that changes something is refused when the browser says
//! that another site sent it, and answers are readable for the listed sites alone.

use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderName, HeaderValue, Method, StatusCode, header};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use crate::http::AppState;
use crate::http::problem::{Code, Problem};

const METHODS: &str = "GET, HEAD, POST, PATCH, DELETE, OPTIONS";
const REQUEST_HEADERS: &str = "authorization, content-type, last-event-id, if-none-match, if-range, range, tus-resumable, \
     upload-length, upload-offset, upload-defer-length, upload-metadata, upload-concat, upload-checksum, \
     x-http-method-override";
const ANSWER_HEADERS: &str = "location, etag, content-range, accept-ranges, retry-after, x-request-id, tus-resumable, \
     tus-version, tus-extension, tus-max-size, tus-checksum-algorithm, upload-offset, upload-length, upload-expires, \
     upload-defer-length, upload-metadata, upload-concat";
/// A browser asks again after this time.
const MAX_AGE_S: &str = "3600";

/// Whether the browser's word for where the request came from is this service itself.
fn is_own(headers: &HeaderMap, origin: &str) -> bool {
    let host = headers.get(header::HOST).and_then(|host| host.to_str().ok()).unwrap_or("");
    origin.split_once("://").is_some_and(|(_, site)| site.eq_ignore_ascii_case(host))
}

/// Refuses what other sites send, answers the questions browsers ask beforehand, and lets listed sites read.
pub(in crate::http) async fn guard_browsers(State(state): State<AppState>, request: Request, next: Next) -> Response {
    let headers = request.headers();
    let origin = headers.get(header::ORIGIN).cloned();
    let named = origin.as_ref().and_then(|origin| origin.to_str().ok());
    let listed = named.is_some_and(|origin| state.config.access.cors_origins.iter().any(|known| known == origin));
    let own = named.is_some_and(|origin| is_own(headers, origin));
    let elsewhere = headers.get("sec-fetch-site").is_some_and(|site| site == "cross-site");
    let preflight = request.method() == Method::OPTIONS && headers.contains_key(header::ACCESS_CONTROL_REQUEST_METHOD);
    let changes = !matches!(*request.method(), Method::GET | Method::HEAD | Method::OPTIONS);
    let mut response = if preflight && origin.is_some() {
        // Without the headers below, a browser takes this for a no.
        StatusCode::NO_CONTENT.into_response()
    } else if changes && !listed && !own && (origin.is_some() || elsewhere) {
        Problem::new(Code::CrossSite).detail("a page of another site sent this request").into_response()
    } else {
        next.run(request).await
    };
    let answer = response.headers_mut();
    answer.append(header::VARY, HeaderValue::from_static("origin"));
    if let Some(origin) = origin.filter(|_| listed) {
        answer.insert(header::ACCESS_CONTROL_ALLOW_ORIGIN, origin);
        answer.insert(header::ACCESS_CONTROL_EXPOSE_HEADERS, HeaderValue::from_static(ANSWER_HEADERS));
        // Instead of the usual `same-origin`.
        answer
            .insert(HeaderName::from_static("cross-origin-resource-policy"), HeaderValue::from_static("cross-origin"));
        if preflight {
            answer.insert(header::ACCESS_CONTROL_ALLOW_METHODS, HeaderValue::from_static(METHODS));
            answer.insert(header::ACCESS_CONTROL_ALLOW_HEADERS, HeaderValue::from_static(REQUEST_HEADERS));
            answer.insert(header::ACCESS_CONTROL_MAX_AGE, HeaderValue::from_static(MAX_AGE_S));
        }
    }
    response
}
