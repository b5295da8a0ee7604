//! Resumable uploads by the tus protocol, 1.0.0: photographs of a dataset whose bytes may come in any number of requests.

use std::sync::Arc;

use axum::Router;
use axum::body::Body;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, Method, StatusCode, header};
use axum::middleware::from_fn;
use axum::response::{IntoResponse, Response};
use axum::routing::{head, post};
use jiff::Timestamp;
use jiff::fmt::rfc2822::DateTimePrinter;
use uuid::Uuid;

use crate::http::AppState;
use crate::http::access::Principal;
use crate::http::extract::{UploadId, media_type};
use crate::http::problem::{Code, Problem};
use crate::http::tus::{self, Append, Checksum, Concat, Length, Room, Target, UploadGuard};
use crate::store::db::now_ms;
use crate::store::db::tokens::Owned;
use crate::store::db::uploads::UploadRow;
use crate::store::{NewUpload, UploadKind};

/// Requests that may take long.
pub(in crate::http) fn router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/uploads", post(create).options(describe))
        .route(
            "/api/v1/uploads/{upload_id}",
            head(show).patch(change).delete(remove).post(overridden).options(describe_one),
        )
        .layer(from_fn(tus::negotiate))
}

fn link(id: &str) -> String {
    format!("/api/v1/uploads/{id}")
}

fn text(value: &str) -> HeaderValue {
    HeaderValue::from_str(value).unwrap_or(HeaderValue::from_static(""))
}

/// When an upload that is not complete will be gone, as HTTP writes dates.
fn expires(row: &UploadRow) -> Option<HeaderValue> {
    if row.length == Some(row.offset) {
        return None;
    }
    let time = Timestamp::from_millisecond(row.expires_ms).ok()?;
    Some(text(&DateTimePrinter::new().timestamp_to_rfc9110_string(&time).ok()?))
}

fn expires_ms(state: &AppState) -> i64 {
    now_ms() + i64::try_from(state.config.upload_expiry.as_millis()).unwrap_or(i64::MAX / 2)
}

/// What this server speaks.
async fn describe(State(state): State<AppState>) -> Response {
    let headers = [
        (tus::TUS_VERSION, HeaderValue::from_static(tus::VERSION)),
        (axum::http::HeaderName::from_static("tus-extension"), HeaderValue::from_static(tus::EXTENSIONS)),
        (
            axum::http::HeaderName::from_static("tus-checksum-algorithm"),
            HeaderValue::from_static(tus::CHECKSUM_ALGORITHMS),
        ),
        (axum::http::HeaderName::from_static("tus-max-size"), HeaderValue::from(state.config.uploads.max_file_bytes)),
    ];
    (StatusCode::NO_CONTENT, headers).into_response()
}

async fn describe_one(state: State<AppState>, UploadId(_): UploadId) -> Response {
    describe(state).await
}

async fn create(State(state): State<AppState>, principal: Principal, request: Request) -> Result<Response, Problem> {
    match tus::method(&request)? {
        Method::POST => {}
        Method::OPTIONS => return Ok(describe(State(state)).await),
        _ => return Err(Problem::new(Code::MethodNotAllowed)),
    }
    let (parts, body) = request.into_parts();
    let headers = parts.headers;
    let concat = Concat::of(&headers)?;
    tus::metadata(&headers)?;
    let metadata = headers.get(tus::UPLOAD_METADATA).and_then(|value| value.to_str().ok()).unwrap_or("").to_owned();
    let target = match concat {
        Some(Concat::Partial) => None,
        _ => Some(Target::of(&headers)?),
    };
    if let Some(target) = &target {
        principal.check_sees(&state, Owned::Dataset(target.dataset)).await?;
    }
    let mut new = NewUpload {
        kind: UploadKind::Whole,
        length: None,
        metadata,
        concat: headers.get(tus::UPLOAD_CONCAT).and_then(|value| value.to_str().ok()).map(str::to_owned),
        target: target.map(|target| (target.dataset, target.path)),
        expires_ms: expires_ms(&state),
        owner_token: principal.owner(),
    };
    if let Some(Concat::Final(parts)) = concat {
        new.kind = UploadKind::Final;
        for part in &parts {
            principal.check_sees(&state, Owned::Upload(*part)).await?;
        }
        let store = Arc::clone(&state.jobs.store);
        let max_bytes = state.config.uploads.max_file_bytes;
        // In a task of its own, so that a sender who leaves can't leave it half done.
        let joined = tokio::spawn(async move {
            let mut row = store.concatenate_uploads(new, parts, max_bytes).await?;
            store.store_upload(&mut row, None).await?;
            Ok::<_, Problem>(row)
        });
        return Ok(created(&joined.await.map_err(|panic| Problem::internal(&panic))??, false));
    }
    if concat == Some(Concat::Partial) {
        new.kind = UploadKind::Partial;
    }
    let length = match Length::of_new(&headers)? {
        Length::Known(length) => Some(length),
        Length::Deferred => None,
    };
    check_length(&state, length)?;
    let waiting_bytes = state.waiting.taken_bytes();
    state.jobs.store.check_space(length.unwrap_or(0).saturating_add(waiting_bytes)).await?;
    new.length = length;
    let with_bytes = headers.get(header::CONTENT_TYPE).is_some() && media_type(&headers) == tus::MEDIA_TYPE;
    let checksum = if with_bytes { Checksum::of(&headers)? } else { None };
    if with_bytes
        && new.kind == UploadKind::Whole
        && let Some(length) = length.filter(|length| announced_bytes(&headers) == i64::try_from(*length).ok())
        && let Some(room) = state.waiting.enter(length)
    {
        return create_whole(&state, new, room, checksum, body).await;
    }
    let mut row = state.jobs.store.create_upload(new).await?;
    if with_bytes {
        let id = parse_id(&row)?;
        let guard = state.uploads.append(id).await.ok_or_else(|| Problem::new(Code::UploadLocked))?;
        let checked = checksum.is_some();
        match receive(&state, id, row, guard, checksum, body).await {
            Ok(received) => row = received.0,
            Err(problem) => {
                // The sender never learns its address, so under a checksum nothing of it can be of use.
                if checked {
                    state.jobs.store.remove_upload(id).await?;
                }
                return Err(problem);
            }
        }
    } else {
        // One of no bytes is complete at once.
        state.jobs.store.store_upload(&mut row, None).await?;
    }
    Ok(created(&row, with_bytes))
}

/// An upload whose bytes all come with it: it waits in memory and is made when they are there. Of one that breaks off
/// nothing is kept, since its sender never learns an address.
async fn create_whole(
    state: &AppState,
    new: NewUpload,
    room: Room,
    checksum: Option<Checksum>,
    body: Body,
) -> Result<Response, Problem> {
    let pieces = room.fill(body, checksum, state.config.upload_idle_timeout).await?;
    let row = state.jobs.store.store_whole(new, pieces).await?;
    state.metrics.uploaded(u64::try_from(row.offset).unwrap_or(0), 1);
    Ok(created(&row, true))
}

/// What the request says its body has.
fn announced_bytes(headers: &HeaderMap) -> Option<i64> {
    headers.get(header::CONTENT_LENGTH).and_then(|value| value.to_str().ok()?.parse().ok())
}

fn created(row: &UploadRow, with_bytes: bool) -> Response {
    let mut response = StatusCode::CREATED.into_response();
    let headers = response.headers_mut();
    headers.insert(header::LOCATION, text(&link(&row.id)));
    if with_bytes {
        headers.insert(tus::UPLOAD_OFFSET, HeaderValue::from(row.offset));
    }
    if let Some(date) = expires(row) {
        headers.insert(tus::UPLOAD_EXPIRES, date);
    }
    response
}

fn check_length(state: &AppState, length: Option<u64>) -> Result<(), Problem> {
    let most = state.config.uploads.max_file_bytes;
    if length.is_some_and(|length| length > most) {
        return Err(Problem::new(Code::PayloadTooLarge).detail(format!("a file has at most {most} bytes")));
    }
    Ok(())
}

fn parse_id(row: &UploadRow) -> Result<Uuid, Problem> {
    row.id.parse().map_err(|error| Problem::internal(&error))
}

/// Where an upload stands. Who asks has noticed that its request is dead: if one still runs here, it is ended.
async fn show(State(state): State<AppState>, UploadId(id): UploadId) -> Result<Response, Problem> {
    let _guard = take(&state, id).await?;
    let mut row = state.jobs.store.find_upload(id).await?;
    // Complete, but kept out of its dataset until now: a sender that sees all its bytes here asks no more.
    state.jobs.store.store_upload(&mut row, None).await?;
    let mut response = StatusCode::OK.into_response();
    let headers = response.headers_mut();
    headers.insert(tus::UPLOAD_OFFSET, HeaderValue::from(row.offset));
    match row.length {
        Some(length) => headers.insert(tus::UPLOAD_LENGTH, HeaderValue::from(length)),
        None => headers.insert(tus::UPLOAD_DEFER_LENGTH, HeaderValue::from(1)),
    };
    if !row.metadata.is_empty() {
        headers.insert(tus::UPLOAD_METADATA, text(&row.metadata));
    }
    if let Some(concat) = &row.concat {
        headers.insert(tus::UPLOAD_CONCAT, text(concat));
    }
    if let Some(date) = expires(&row) {
        headers.insert(tus::UPLOAD_EXPIRES, date);
    }
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-store"));
    Ok(response)
}

async fn take(state: &AppState, id: Uuid) -> Result<UploadGuard, Problem> {
    let guard = state.uploads.take(id, state.config.upload_lock_wait).await;
    guard.ok_or_else(|| Problem::new(Code::UploadLocked).detail("another request does not let go of the upload"))
}

async fn change(State(state): State<AppState>, UploadId(id): UploadId, request: Request) -> Result<Response, Problem> {
    if tus::method(&request)? != Method::PATCH {
        return overridden(State(state), UploadId(id), request).await;
    }
    let (parts, body) = request.into_parts();
    bring(&state, id, &parts.headers, body).await
}

async fn bring(state: &AppState, id: Uuid, headers: &HeaderMap, body: Body) -> Result<Response, Problem> {
    if media_type(headers) != tus::MEDIA_TYPE {
        return Err(Problem::new(Code::UnsupportedMediaType).detail(format!("the body must be {}", tus::MEDIA_TYPE)));
    }
    let offset = tus::offset(headers)?;
    let checksum = Checksum::of(headers)?;
    let locked = || Problem::new(Code::UploadLocked).detail("another request brings bytes of this upload");
    let guard = state.uploads.append(id).await.ok_or_else(locked)?;
    let mut row = state.jobs.store.find_upload(id).await?;
    if row.kind == UploadKind::Final.as_str() {
        return Err(Problem::new(Code::UploadFinal).detail("an upload put together from parts takes no bytes"));
    }
    if i64::try_from(offset) != Ok(row.offset) {
        let message = format!("the upload stands at {}, not at {offset}", row.offset);
        return Err(Problem::new(Code::OffsetMismatch).detail(message));
    }
    if let Some(length) = Length::of_later(headers)? {
        check_length(state, Some(length))?;
        let length = i64::try_from(length).unwrap_or(i64::MAX);
        if length < row.offset || row.length.is_some_and(|known| known != length) {
            return Err(Problem::new(Code::InvalidUpload).detail("upload-length: another length was told before"));
        }
        row.length = Some(length);
    }
    if announced_bytes(headers).zip(row.length).is_some_and(|(bytes, length)| bytes > length - row.offset) {
        return Err(Problem::new(Code::PayloadTooLarge).detail("the body goes beyond the upload's length"));
    }
    let (row, _guard) = receive(state, id, row, guard, checksum, body).await?;
    let mut response = StatusCode::NO_CONTENT.into_response();
    response.headers_mut().insert(tus::UPLOAD_OFFSET, HeaderValue::from(row.offset));
    if let Some(date) = expires(&row) {
        response.headers_mut().insert(tus::UPLOAD_EXPIRES, date);
    }
    Ok(response)
}

/// Takes a body in, in a task of its own: what came is counted also when the sender leaves.
async fn receive(
    state: &AppState,
    id: Uuid,
    row: UploadRow,
    guard: UploadGuard,
    checksum: Option<Checksum>,
    body: Body,
) -> Result<(UploadRow, UploadGuard), Problem> {
    let before = (row.offset, row.stored);
    let append = Append {
        store: Arc::clone(&state.jobs.store),
        guard,
        id,
        row,
        checksum,
        max_bytes: state.config.uploads.max_file_bytes,
        idle: state.config.upload_idle_timeout,
        expiry: state.config.upload_expiry,
    };
    let task = tokio::spawn(tus::append(append, body));
    let (row, guard) = task.await.map_err(|panic| Problem::internal(&panic))??;
    let bytes = u64::try_from(row.offset - before.0).unwrap_or(0);
    state.metrics.uploaded(bytes, usize::from(row.stored && !before.1));
    Ok((row, guard))
}

async fn remove(State(state): State<AppState>, UploadId(id): UploadId) -> Result<StatusCode, Problem> {
    let _guard = take(&state, id).await?;
    state.jobs.store.find_upload(id).await?;
    state.jobs.store.remove_upload(id).await?;
    Ok(StatusCode::NO_CONTENT)
}

/// A request whose real method stands in a header.
async fn overridden(
    State(state): State<AppState>,
    UploadId(id): UploadId,
    request: Request,
) -> Result<Response, Problem> {
    match tus::method(&request)? {
        Method::PATCH => {
            let (parts, body) = request.into_parts();
            bring(&state, id, &parts.headers, body).await
        }
        Method::HEAD => show(State(state), UploadId(id)).await,
        Method::DELETE => Ok(remove(State(state), UploadId(id)).await?.into_response()),
        Method::OPTIONS => Ok(describe(State(state)).await),
        _ => Err(Problem::new(Code::MethodNotAllowed)),
    }
}
