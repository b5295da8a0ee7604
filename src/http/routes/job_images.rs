//! The verdicts on a job's photographs, and small pictures of them.

use std::sync::Arc;

use axum::Router;
use axum::extract::State;
use axum::http::HeaderMap;
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use serde::Deserialize;

use crate::http::download::{self, Entity};
use crate::http::extract::{ImageNumber, JobId, Page, Query, cut};
use crate::http::problem::{Code, Problem};
use crate::http::thumbnail::{ThumbnailError, find_or_make};
use crate::http::{AppState, wire};
use crate::store::StoreError;
use crate::store::db::job_images;

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/jobs/{job_id}/images", get(list))
        .route("/api/v1/jobs/{job_id}/images/{n}/thumbnail", get(thumbnail))
}

/// Which verdicts.
#[derive(Deserialize)]
struct Filter {
    state: Option<Verdict>,
}

#[derive(Clone, Copy, Deserialize)]
#[serde(rename_all = "snake_case")]
enum Verdict {
    Pending,
    Registered,
    Unregistered,
    Rejected,
}

async fn list(
    State(state): State<AppState>,
    JobId(job): JobId,
    Query(page): Query<Page>,
    Query(filter): Query<Filter>,
) -> Result<Response, Problem> {
    let limit = page.limit()?;
    state.jobs.find(job).await?;
    let reader = state.jobs.store.db.reader();
    let counts = job_images::counts(reader, job).await?;
    let (verdict, total) = match filter.state {
        None => (None, counts.uploaded),
        Some(Verdict::Pending) => (Some("pending"), counts.pending),
        Some(Verdict::Registered) => (Some("registered"), counts.registered),
        Some(Verdict::Unregistered) => (Some("unregistered"), counts.unregistered),
        Some(Verdict::Rejected) => (Some("rejected"), counts.rejected),
    };
    let mut rows = job_images::list(reader, job, verdict, page.number_or(-1)?, limit + 1).await?;
    let next_cursor = cut(&mut rows, limit, |row| row.n.to_string());
    let images = rows.into_iter().map(|row| wire::JobImage::new(job, row)).collect();
    Ok(axum::Json(wire::JobImagePage { images, total, next_cursor }).into_response())
}

async fn thumbnail(
    State(state): State<AppState>,
    JobId(id): JobId,
    ImageNumber(n): ImageNumber,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let job = state.jobs.find(id).await?;
    let row = job_images::find(state.jobs.store.db.reader(), id, n).await?;
    let row = row.ok_or_else(|| Problem::new(Code::ImageNotFound))?;
    let etag = download::etag(&row.sha256[..row.sha256.len().min(32)]);
    if download::not_modified(&headers, &etag) {
        return Ok(download::unchanged(&etag));
    }
    let dataset = job.dataset_id.parse().map_err(|error| Problem::internal(&error))?;
    let data = &state.jobs.store.data;
    let (folder, scratch) = (data.thumbnails(id), data.incoming());
    let photograph = data.images(dataset).join(&row.path);
    // A large photograph takes a gigabyte to decode: few at a time.
    let permit = Arc::clone(&state.decoders).acquire_owned().await.map_err(|error| Problem::internal(&error))?;
    let made = tokio::task::spawn_blocking(move || {
        let _permit = permit;
        find_or_make(&folder, &scratch, &photograph, &row.sha256)
    })
    .await;
    let unavailable = |why: &dyn std::fmt::Display| Problem::new(Code::ThumbnailUnavailable).detail(why);
    let file = match made {
        Ok(Ok(file)) => file,
        Ok(Err(ThumbnailError::Photograph(error))) => return Err(unavailable(&error)),
        Ok(Err(ThumbnailError::Store(StoreError::Io(error)))) if error.kind() == std::io::ErrorKind::NotFound => {
            return Err(Problem::new(Code::ImageNotFound));
        }
        Ok(Err(ThumbnailError::Store(error))) => return Err(error.into()),
        Err(_) => return Err(unavailable(&"the photograph can't be decoded")),
    };
    let size_bytes = tokio::fs::metadata(&file).await?.len();
    download::serve(&headers, Entity { file: &file, size_bytes, etag, media_type: "image/jpeg" }).await
}
