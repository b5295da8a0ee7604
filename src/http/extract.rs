//! What handlers take out of requests, every refusal a problem with a stable code.

use axum::extract::rejection::QueryRejection;
use axum::extract::{FromRequest, FromRequestParts, RawPathParams, Request};
use axum::http::request::Parts;
use axum::http::{HeaderMap, header};
use serde::de::{DeserializeOwned, Error};
use serde::{Deserialize, Deserializer};
use uuid::Uuid;

use super::problem::{Code, Problem};

/// Bytes of a JSON body.
const MAX_JSON_BYTES: usize = 1 << 20;

/// The media type of a body, in lower case and without parameters.
pub(super) fn media_type(headers: &HeaderMap) -> String {
    let value = headers.get(header::CONTENT_TYPE).and_then(|value| value.to_str().ok()).unwrap_or("");
    value.split(';').next().unwrap_or("").trim().to_ascii_lowercase()
}

/// A JSON body.
pub(super) struct Json<T>(pub(super) T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequest<S> for Json<T> {
    type Rejection = Problem;

    async fn from_request(request: Request, _: &S) -> Result<Self, Problem> {
        if media_type(request.headers()) != "application/json" {
            return Err(Problem::new(Code::UnsupportedMediaType).detail("the body must be application/json"));
        }
        let body = axum::body::to_bytes(request.into_body(), MAX_JSON_BYTES)
            .await
            .map_err(|_| Problem::new(Code::PayloadTooLarge).detail("the body is too long or broke off"))?;
        serde_json::from_slice(&body).map(Json).map_err(|error| Problem::new(Code::InvalidJson).detail(error))
    }
}

/// A whole number out of JSON, which may write it as `2.0`.
pub(super) fn whole_number<'de, D: Deserializer<'de>>(deserializer: D) -> Result<i64, D::Error> {
    let number = serde_json::Number::deserialize(deserializer)?;
    let not_whole = || D::Error::custom(format!("{number} is no whole number"));
    if let Some(whole) = number.as_i64() {
        return Ok(whole);
    }
    // Every whole number that means something here is far smaller than where f64 has gaps.
    let float = number.as_f64().filter(|float| float.fract() == 0.0 && float.abs() < 1e15).ok_or_else(not_whole)?;
    Ok(float as i64)
}

/// Query parameters.
pub(super) struct Query<T>(pub(super) T);

impl<T: DeserializeOwned, S: Send + Sync> FromRequestParts<S> for Query<T> {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, _: &S) -> Result<Self, Problem> {
        axum::extract::Query::try_from_uri(&parts.uri)
            .map(|axum::extract::Query(value)| Self(value))
            .map_err(|error: QueryRejection| Problem::new(Code::InvalidQuery).detail(error.body_text()))
    }
}

/// `limit` and `cursor` of a list.
#[derive(Deserialize)]
pub(super) struct Page {
    limit: Option<u32>,
    cursor: Option<String>,
}

impl Page {
    /// Entries on the page.
    pub(super) fn limit(&self) -> Result<u32, Problem> {
        match self.limit.unwrap_or(100) {
            limit @ 1..=1000 => Ok(limit),
            _ => Err(Problem::new(Code::InvalidQuery).detail("limit is from 1 to 1000")),
        }
    }

    /// The cursor as a number, or where the list starts.
    pub(super) fn number_or(&self, start: i64) -> Result<i64, Problem> {
        match &self.cursor {
            None => Ok(start),
            // A sign would be read as one of a number, and one of no list.
            Some(cursor) if cursor.bytes().all(|byte| byte.is_ascii_digit()) => {
                cursor.parse().map_err(|_| Problem::new(Code::InvalidQuery).detail("cursor: there is none like that"))
            }
            Some(_) => Err(Problem::new(Code::InvalidQuery).detail("cursor: there is none like that")),
        }
    }

    /// The cursor as it is.
    pub(super) fn text(&self) -> &str {
        self.cursor.as_deref().unwrap_or("")
    }
}

/// Cuts a list, which was read with one entry too many, to its page; the cursor of its last entry where there are more.
pub(super) fn cut<T>(rows: &mut Vec<T>, limit: u32, cursor: impl FnOnce(&T) -> String) -> Option<String> {
    let more = rows.len() > limit as usize;
    rows.truncate(limit as usize);
    rows.last().filter(|_| more).map(cursor)
}

async fn path_part<S: Send + Sync>(parts: &mut Parts, state: &S, name: &str) -> Option<String> {
    let params = <RawPathParams as FromRequestParts<S>>::from_request_parts(parts, state).await.ok()?;
    params.iter().find(|(key, _)| *key == name).map(|(_, value)| value.to_owned())
}

/// The job that an address names.
pub(super) struct JobId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for JobId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let id = path_part(parts, state, "job_id").await.and_then(|id| id.parse().ok());
        id.map(Self).ok_or_else(|| Problem::new(Code::JobNotFound))
    }
}

/// The dataset that an address names.
pub(super) struct DatasetId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for DatasetId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let id = path_part(parts, state, "dataset_id").await.and_then(|id| id.parse().ok());
        id.map(Self).ok_or_else(|| Problem::new(Code::DatasetNotFound))
    }
}

/// The upload that an address names.
pub(super) struct UploadId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for UploadId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let id = path_part(parts, state, "upload_id").await.and_then(|id| id.parse().ok());
        id.map(Self).ok_or_else(|| Problem::new(Code::UploadNotFound))
    }
}

/// The webhook that an address names.
pub(super) struct WebhookId(pub(super) Uuid);

impl<S: Send + Sync> FromRequestParts<S> for WebhookId {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let id = path_part(parts, state, "webhook_id").await.and_then(|id| id.parse().ok());
        id.map(Self).ok_or_else(|| Problem::new(Code::WebhookNotFound))
    }
}

/// The number of a photograph that an address names.
pub(super) struct ImageNumber(pub(super) i64);

impl<S: Send + Sync> FromRequestParts<S> for ImageNumber {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        let n = path_part(parts, state, "n").await.and_then(|n| n.parse().ok());
        n.map(Self).ok_or_else(|| Problem::new(Code::ImageNotFound))
    }
}

/// The rest of the address, with its slashes.
pub(super) struct RestOfPath(pub(super) String);

impl<S: Send + Sync> FromRequestParts<S> for RestOfPath {
    type Rejection = Problem;

    async fn from_request_parts(parts: &mut Parts, state: &S) -> Result<Self, Problem> {
        path_part(parts, state, "path").await.map(Self).ok_or_else(|| Problem::new(Code::NotFound))
    }
}
