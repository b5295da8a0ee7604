//! The page: the files of `static/`, embedded into the program. What builds them (the npm project) lies beside them and is
//! left out.

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use rust_embed::RustEmbed;

use super::download::{etag, media_type_of, not_modified, unchanged};
use super::problem::{Code, Problem};

#[derive(RustEmbed)]
#[folder = "$CARGO_MANIFEST_DIR/static"]
#[include = "index.html"]
#[include = "css/*"]
#[include = "img/*"]
#[include = "js/*"]
#[include = "vendor/*"]
#[allow_missing = true]
struct Files;

/// Everything from this service alone; no frames around it, no plug-ins.
const CONTENT_SECURITY_POLICY: &str = "default-src 'self'; img-src 'self' data: blob:; worker-src 'self' blob:; \
     object-src 'none'; base-uri 'none'; form-action 'self'; frame-ancestors 'none'";

/// A file of the page.
pub(super) fn serve(headers: &HeaderMap, path: &str) -> Result<Response, Problem> {
    let file = Files::get(path).ok_or_else(|| Problem::new(Code::NotFound))?;
    let tag = etag(&file.metadata.sha256_hash()[..16].iter().map(|byte| format!("{byte:02x}")).collect::<String>());
    let mut response = if not_modified(headers, &tag) {
        unchanged(&tag)
    } else {
        let mut response = Body::from(file.data).into_response();
        response.headers_mut().insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type_of(path)));
        if let Ok(tag) = HeaderValue::from_str(&tag) {
            response.headers_mut().insert(header::ETAG, tag);
        }
        response
    };
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_SECURITY_POLICY, HeaderValue::from_static(CONTENT_SECURITY_POLICY));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    Ok(response)
}
