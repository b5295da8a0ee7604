//! Errors as RFC 9457 problems. A handler returns a [`Problem`]; the outermost layer writes the body, because it knows the
//! request's id, and turns every other error answer into a problem too, so that a client meets no second format.

use axum::body::Body;
use axum::http::{HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use serde::Serialize;

use crate::jobs::JobsError;
use crate::store::{ArchiveError, InvalidFileName, Quantity, StoreError, UploadError};

/// Defines the codes with their status, in the order of `openapi.yaml`.
macro_rules! codes {
    ($($variant:ident $name:literal $status:literal),+ $(,)?) => {
        /// The stable name of a problem.
        #[derive(Clone, Copy, Debug, PartialEq, Eq)]
        pub enum Code {
            $(#[doc = concat!("`", $name, "`")] $variant,)+
        }

        impl Code {
            /// Every code.
            pub const ALL: &[Self] = &[$(Self::$variant),+];

            /// The name on the wire.
            pub fn as_str(self) -> &'static str {
                match self { $(Self::$variant => $name),+ }
            }

            /// The status that goes with it.
            pub fn status(self) -> StatusCode {
                let status = match self { $(Self::$variant => $status),+ };
                StatusCode::from_u16(status).unwrap_or(StatusCode::INTERNAL_SERVER_ERROR)
            }
        }
    };
}

codes! {
    BadRequest "bad_request" 400,
    InvalidJson "invalid_json" 400,
    InvalidMultipart "invalid_multipart" 400,
    InvalidQuery "invalid_query" 400,
    InvalidUpload "invalid_upload" 400,
    Unauthorized "unauthorized" 401,
    UploadFinal "upload_final" 403,
    Forbidden "forbidden" 403,
    CrossSite "cross_site" 403,
    BytesQuotaExceeded "bytes_quota_exceeded" 403,
    ImagesQuotaExceeded "images_quota_exceeded" 403,
    JobsQuotaExceeded "jobs_quota_exceeded" 403,
    NotFound "not_found" 404,
    JobNotFound "job_not_found" 404,
    DatasetNotFound "dataset_not_found" 404,
    ImageNotFound "image_not_found" 404,
    OutputNotFound "output_not_found" 404,
    UploadNotFound "upload_not_found" 404,
    WebhookNotFound "webhook_not_found" 404,
    MethodNotAllowed "method_not_allowed" 405,
    RequestTimeout "request_timeout" 408,
    FileConflict "file_conflict" 409,
    DatasetInUse "dataset_in_use" 409,
    JobRunning "job_running" 409,
    JobNotActive "job_not_active" 409,
    JobNotResumable "job_not_resumable" 409,
    JobNotQueued "job_not_queued" 409,
    OffsetMismatch "offset_mismatch" 409,
    UploadExpired "upload_expired" 410,
    UnsupportedTusVersion "unsupported_tus_version" 412,
    PayloadTooLarge "payload_too_large" 413,
    TooManyFiles "too_many_files" 413,
    ArchiveTooLarge "archive_too_large" 413,
    UnsupportedMediaType "unsupported_media_type" 415,
    RangeNotSatisfiable "range_not_satisfiable" 416,
    InvalidFileName "invalid_file_name" 422,
    InvalidArchive "invalid_archive" 422,
    InvalidName "invalid_name" 422,
    InvalidOptions "invalid_options" 422,
    InvalidPriority "invalid_priority" 422,
    NoImages "no_images" 422,
    ThumbnailUnavailable "thumbnail_unavailable" 422,
    UploadConflict "upload_conflict" 422,
    InvalidWebhook "invalid_webhook" 422,
    UploadLocked "upload_locked" 423,
    RateLimited "rate_limited" 429,
    ChecksumMismatch "checksum_mismatch" 460,
    InternalError "internal_error" 500,
    NotReady "not_ready" 503,
    DiskFull "disk_full" 507,
    DiskError "disk_error" 507,
}

/// What went wrong.
#[derive(Clone, Debug)]
pub struct Problem {
    code: Code,
    detail: Option<String>,
    errors: Vec<String>,
    path: Option<String>,
}

/// The body.
#[derive(Serialize)]
struct Envelope<'a> {
    r#type: &'static str,
    title: &'static str,
    status: u16,
    code: &'static str,
    #[serde(skip_serializing_if = "Option::is_none")]
    detail: Option<&'a str>,
    request_id: &'a str,
    #[serde(skip_serializing_if = "<[_]>::is_empty")]
    errors: &'a [String],
    #[serde(skip_serializing_if = "Option::is_none")]
    path: Option<&'a str>,
}

impl Problem {
    /// A problem without further words.
    pub fn new(code: Code) -> Self {
        Self { code, detail: None, errors: Vec::new(), path: None }
    }

    /// Its code.
    pub fn code(&self) -> Code {
        self.code
    }

    /// Adds a sentence for people.
    pub fn detail(mut self, detail: impl ToString) -> Self {
        self.detail = Some(detail.to_string());
        self
    }

    /// Names the file it is about.
    pub fn path(mut self, path: impl ToString) -> Self {
        self.path = Some(path.to_string());
        self
    }

    /// Lists single violations.
    fn errors(mut self, errors: Vec<String>) -> Self {
        self.errors = errors;
        self
    }

    /// Everything it says to people, in one line.
    pub(super) fn sentence(&self) -> String {
        let title = || self.code.status().canonical_reason().unwrap_or_default().to_owned();
        let mut sentence = self.detail.clone().unwrap_or_else(title);
        if !self.errors.is_empty() {
            sentence = format!("{sentence}: {}", self.errors.join("; "));
        }
        match &self.path {
            Some(path) => format!("{path}: {sentence}"),
            None => sentence,
        }
    }

    /// Logs what happened inside and says no more than that it did.
    pub fn internal(error: &dyn std::fmt::Display) -> Self {
        tracing::error!(%error, "a request failed inside");
        Self::new(Code::InternalError)
    }

    /// A name that was refused.
    pub fn file_name(name: &str, why: InvalidFileName) -> Self {
        Self::new(Code::InvalidFileName).detail(why).path(name)
    }

    /// The problem that an error answer of the framework stands for.
    pub(super) fn of_status(status: StatusCode) -> Self {
        Self::new(match status {
            StatusCode::NOT_FOUND => Code::NotFound,
            StatusCode::METHOD_NOT_ALLOWED => Code::MethodNotAllowed,
            StatusCode::REQUEST_TIMEOUT => Code::RequestTimeout,
            StatusCode::PAYLOAD_TOO_LARGE => Code::PayloadTooLarge,
            StatusCode::UNSUPPORTED_MEDIA_TYPE => Code::UnsupportedMediaType,
            StatusCode::RANGE_NOT_SATISFIABLE => Code::RangeNotSatisfiable,
            StatusCode::SERVICE_UNAVAILABLE => Code::NotReady,
            status if status.is_client_error() => Code::BadRequest,
            _ => Code::InternalError,
        })
    }

    /// Writes the problem into an answer, whose other headers stay.
    pub(super) fn write(&self, response: &mut Response, request_id: &str) {
        let status = self.code.status();
        let envelope = Envelope {
            r#type: "about:blank",
            // 460 is known to tus alone.
            title: status.canonical_reason().unwrap_or("Checksum Mismatch"),
            status: status.as_u16(),
            code: self.code.as_str(),
            detail: self.detail.as_deref(),
            request_id,
            errors: &self.errors,
            path: self.path.as_deref(),
        };
        *response.status_mut() = status;
        *response.body_mut() = Body::from(serde_json::to_vec(&envelope).unwrap_or_default());
        let headers = response.headers_mut();
        headers.remove(header::CONTENT_LENGTH);
        headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/problem+json"));
        headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    }
}

impl IntoResponse for Problem {
    fn into_response(self) -> Response {
        let mut response = self.code.status().into_response();
        response.extensions_mut().insert(self);
        response
    }
}

/// Why a path is in conflict: other bytes, or a folder where there is a photograph, or the other way round.
const OTHERWISE_STORED: &str = "something else is stored already at this path or at one of its folders";

impl From<StoreError> for Problem {
    fn from(error: StoreError) -> Self {
        if error.is_disk_full() {
            return Self::new(Code::DiskFull).detail("the disk is full");
        }
        if error.is_disk_error() {
            tracing::error!(%error, "the disk fails");
            return Self::new(Code::DiskError).detail("the disk can't be read or written");
        }
        match error {
            StoreError::FileConflict(path) => Self::new(Code::FileConflict).detail(OTHERWISE_STORED).path(path),
            StoreError::QuotaExceeded { quantity, .. } => Self::new(match quantity {
                Quantity::Bytes => Code::BytesQuotaExceeded,
                Quantity::Images => Code::ImagesQuotaExceeded,
                Quantity::Jobs => Code::JobsQuotaExceeded,
            })
            .detail(error),
            StoreError::DatasetInUse => Self::new(Code::DatasetInUse).detail(error),
            StoreError::NotFound => Self::new(Code::DatasetNotFound),
            StoreError::Io(_) | StoreError::Db(_) => Self::internal(&error),
        }
    }
}

impl From<std::io::Error> for Problem {
    fn from(error: std::io::Error) -> Self {
        StoreError::from(error).into()
    }
}

impl From<sqlx::Error> for Problem {
    fn from(error: sqlx::Error) -> Self {
        StoreError::from(error).into()
    }
}

impl From<JobsError> for Problem {
    fn from(error: JobsError) -> Self {
        let code = match error {
            JobsError::Store(error) => return error.into(),
            JobsError::InvalidOptions(errors) => {
                return Self::new(Code::InvalidOptions).detail("the options can't be used").errors(errors);
            }
            JobsError::JobNotFound => Code::JobNotFound,
            JobsError::DatasetNotFound => Code::DatasetNotFound,
            JobsError::NoImages => Code::NoImages,
            JobsError::InvalidName => Code::InvalidName,
            JobsError::InvalidPriority => Code::InvalidPriority,
            JobsError::NotQueued(_) => Code::JobNotQueued,
            JobsError::InvalidWebhook(_) => Code::InvalidWebhook,
            JobsError::Running => Code::JobRunning,
            JobsError::NotActive(_) => Code::JobNotActive,
            JobsError::NotResumable(_) => Code::JobNotResumable,
        };
        Self::new(code).detail(error)
    }
}

impl From<UploadError> for Problem {
    fn from(error: UploadError) -> Self {
        let code = match error {
            UploadError::Store(error) => return error.into(),
            UploadError::NotFound => Code::UploadNotFound,
            UploadError::Expired => Code::UploadExpired,
            UploadError::NotAPart(_) => Code::InvalidUpload,
            UploadError::TooLong(_) => Code::PayloadTooLarge,
            UploadError::Conflict(path) => {
                return Self::new(Code::UploadConflict).detail(OTHERWISE_STORED).path(path);
            }
        };
        Self::new(code).detail(error)
    }
}

impl From<ArchiveError> for Problem {
    fn from(error: ArchiveError) -> Self {
        match error {
            ArchiveError::Store(error) => error.into(),
            ArchiveError::FileName(name, why) => Self::file_name(&name, why),
            ArchiveError::Invalid(_) => Self::new(Code::InvalidArchive).detail(error),
            ArchiveError::TooLarge(_) => Self::new(Code::ArchiveTooLarge).detail(error),
        }
    }
}
