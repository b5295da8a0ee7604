//! The tus 1.0.0 protocol of resumable uploads: its headers, its locks, and bytes on their way into an upload or,
//! whole, to the store.

mod append;
mod headers;
mod locks;
mod whole;

pub(super) use append::{Append, append};
pub(super) use headers::{Checksum, Concat, Length, Target, metadata, offset};
pub(super) use locks::{UploadGuard, UploadLocks};
pub(super) use whole::{Room, WaitingRoom};

use axum::extract::Request;
use axum::http::{HeaderName, HeaderValue, Method};
use axum::middleware::Next;
use axum::response::{IntoResponse, Response};

use super::problem::{Code, Problem};

/// The version, in every answer.
pub(super) const VERSION: &str = "1.0.0";
/// What is spoken beyond the core.
pub(super) const EXTENSIONS: &str =
    "creation,creation-with-upload,creation-defer-length,expiration,checksum,termination,concatenation";
/// What checksums may be made with.
pub(super) const CHECKSUM_ALGORITHMS: &str = "sha1,sha256";
/// The media type of bytes.
pub(super) const MEDIA_TYPE: &str = "application/offset+octet-stream";

pub(super) const TUS_RESUMABLE: HeaderName = HeaderName::from_static("tus-resumable");
pub(super) const TUS_VERSION: HeaderName = HeaderName::from_static("tus-version");
pub(super) const UPLOAD_LENGTH: HeaderName = HeaderName::from_static("upload-length");
pub(super) const UPLOAD_OFFSET: HeaderName = HeaderName::from_static("upload-offset");
pub(super) const UPLOAD_DEFER_LENGTH: HeaderName = HeaderName::from_static("upload-defer-length");
pub(super) const UPLOAD_METADATA: HeaderName = HeaderName::from_static("upload-metadata");
pub(super) const UPLOAD_CONCAT: HeaderName = HeaderName::from_static("upload-concat");
pub(super) const UPLOAD_CHECKSUM: HeaderName = HeaderName::from_static("upload-checksum");
pub(super) const UPLOAD_EXPIRES: HeaderName = HeaderName::from_static("upload-expires");
/// For senders who can't use PATCH and DELETE.
pub(super) const METHOD_OVERRIDE: HeaderName = HeaderName::from_static("x-http-method-override");

/// The method a request stands for.
pub(super) fn method(request: &Request) -> Result<Method, Problem> {
    match request.headers().get(METHOD_OVERRIDE) {
        None => Ok(request.method().clone()),
        Some(name) => Method::from_bytes(name.as_bytes()).map_err(|_| Problem::new(Code::MethodNotAllowed)),
    }
}

/// Refuses other versions before anything is done, and names ours in every answer. OPTIONS is how a sender learns it.
pub(super) async fn negotiate(request: Request, next: Next) -> Response {
    let asks = method(&request).is_ok_and(|method| method == Method::OPTIONS);
    let fits = request.headers().get(TUS_RESUMABLE).is_some_and(|version| version == VERSION);
    let mut response = if asks || fits {
        next.run(request).await
    } else {
        let message = format!("Tus-Resumable must be {VERSION}");
        let mut response = Problem::new(Code::UnsupportedTusVersion).detail(message).into_response();
        response.headers_mut().insert(TUS_VERSION, HeaderValue::from_static(VERSION));
        response
    };
    response.headers_mut().insert(TUS_RESUMABLE, HeaderValue::from_static(VERSION));
    response
}
