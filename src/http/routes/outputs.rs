//! What a job made: the list, single files, and everything as one archive.

use std::io::{self, BufWriter, Write};
use std::path::Path;

use axum::Router;
use axum::body::Body;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, header};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use bytes::Bytes;
use tokio::sync::mpsc;
use tokio_stream::wrappers::ReceiverStream;
use zip::write::{SimpleFileOptions, ZipWriter};

use crate::http::download::{self, Entity};
use crate::http::extract::{JobId, RestOfPath};
use crate::http::problem::{Code, Problem};
use crate::http::{AppState, wire};
use crate::store::db::job_outputs::{self, JobOutputRow};

/// Bytes handed to the connection at a time, and how many such pieces may wait.
const PIECE_BYTES: usize = 128 << 10;
const WAITING_PIECES: usize = 8;
/// From here on a file needs the 64-bit fields of a zip.
const ZIP64_FROM_BYTES: i64 = 0xffff_0000;

/// Outputs may be pages with scripts made out of what senders named and wrote: they run in an origin of their own and load nothing.
const CONTENT_SECURITY_POLICY: &str = "default-src 'none'; img-src 'self' data:; style-src 'unsafe-inline'; \
     script-src 'unsafe-inline'; sandbox allow-scripts allow-popups";

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new().route("/api/v1/jobs/{job_id}/outputs", get(list))
}

/// Answers that may take long.
pub(in crate::http) fn download_router() -> Router<AppState> {
    Router::new()
        .route("/api/v1/jobs/{job_id}/outputs/{*path}", get(file))
        .route("/api/v1/jobs/{job_id}/outputs.zip", get(archive))
}

async fn list(State(state): State<AppState>, JobId(job): JobId) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    let rows = job_outputs::list(state.jobs.store.db.reader(), job).await?;
    Ok(axum::Json(wire::OutputList::new(job, rows)).into_response())
}

async fn file(
    State(state): State<AppState>,
    JobId(job): JobId,
    RestOfPath(path): RestOfPath,
    headers: HeaderMap,
) -> Result<Response, Problem> {
    let missing = || Problem::new(Code::OutputNotFound).path(&path);
    state.jobs.find(job).await?;
    // Only what is in the list is served, so the path can't lead anywhere else.
    let row = job_outputs::find(state.jobs.store.db.reader(), job, &path).await?.ok_or_else(missing)?;
    let file = state.jobs.store.data.out(job).join(&row.path);
    let entity = Entity {
        file: &file,
        size_bytes: u64::try_from(row.size_bytes).unwrap_or(0),
        etag: download::etag(&row.blake3),
        media_type: download::media_type_of(&row.path),
    };
    let mut response = download::serve(&headers, entity).await?;
    let policy = HeaderValue::from_static(CONTENT_SECURITY_POLICY);
    response.headers_mut().insert(header::CONTENT_SECURITY_POLICY, policy);
    Ok(response)
}

async fn archive(State(state): State<AppState>, JobId(job): JobId) -> Result<Response, Problem> {
    state.jobs.find(job).await?;
    let rows = job_outputs::list(state.jobs.store.db.reader(), job).await?;
    if rows.is_empty() {
        return Err(Problem::new(Code::OutputNotFound).detail("the job has made nothing yet"));
    }
    let folder = state.jobs.store.data.out(job);
    let (pieces, stream) = mpsc::channel(WAITING_PIECES);
    tokio::task::spawn_blocking(move || {
        let mut pipe = BufWriter::with_capacity(PIECE_BYTES, Pipe(pieces.clone()));
        let written = write_archive(&folder, &rows, &mut pipe).and_then(|()| pipe.flush());
        if let Err(error) = written {
            // Breaks the answer off, so that nobody takes the half for the whole; it fails when the client left.
            let _ = pieces.blocking_send(Err(error));
        }
    });
    let mut response = Body::from_stream(ReceiverStream::new(stream)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static("application/zip"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if let Ok(name) = HeaderValue::from_str(&format!("attachment; filename=\"multistage-{job}.zip\"")) {
        headers.insert(header::CONTENT_DISPOSITION, name);
    }
    Ok(response)
}

/// Stored, not deflated: point clouds and cameras hardly shrink, and storing keeps up with any line.
fn write_archive(folder: &Path, rows: &[JobOutputRow], pipe: &mut impl Write) -> io::Result<()> {
    let mut zip = ZipWriter::new_stream(pipe);
    for row in rows {
        let options = SimpleFileOptions::default()
            .compression_method(zip::CompressionMethod::Stored)
            .unix_permissions(0o644)
            .large_file(row.size_bytes >= ZIP64_FROM_BYTES);
        zip.start_file(row.path.as_str(), options)?;
        io::copy(&mut std::fs::File::open(folder.join(&row.path))?, &mut zip)?;
    }
    zip.finish()?;
    Ok(())
}

/// Hands bytes from a blocking thread to the connection, and waits while that is slower.
struct Pipe(mpsc::Sender<io::Result<Bytes>>);

impl Write for Pipe {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        let piece = Bytes::copy_from_slice(bytes);
        self.0.blocking_send(Ok(piece)).map_err(|_| io::Error::from(io::ErrorKind::BrokenPipe))?;
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}
