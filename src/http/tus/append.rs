//! Bytes of a request on their way into an upload.
//!
//! They go to a blocking writer through a short queue and count once they are durable: at the end of the request, however it
//! ends, and after every [`SEGMENT_BYTES`] on the way. Only bytes under a checksum count all or not at all.

use std::sync::Arc;
use std::time::{Duration, Instant};

use axum::body::Body;
use bytes::Bytes;
use futures_util::StreamExt;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;
use tokio::task::{JoinHandle, spawn_blocking};
use uuid::Uuid;

use super::{Checksum, UploadGuard};
use crate::http::problem::{Code, Problem};
use crate::store::db::now_ms;
use crate::store::db::uploads::UploadRow;
use crate::store::{Appended, Store, UploadError};

/// Bytes after which what came so far is made durable.
const SEGMENT_BYTES: u64 = 32 << 20;
/// Once another request wants the upload, bytes that the system has received already are still taken: until none comes for so
/// long, and for [`DRAIN_MOST`] in all.
const DRAIN_IDLE: Duration = Duration::from_millis(100);
/// That other request waits no longer.
const DRAIN_MOST: Duration = Duration::from_millis(500);
/// Chunks, each what one read of the connection brought, go to the writer in lots of so many bytes: to wake it costs
/// more than to write a chunk.
const LOT_BYTES: usize = 256 << 10;
/// Lots on their way to the writer.
const QUEUED_LOTS: usize = 3;

/// One request that brings bytes.
pub(in crate::http) struct Append {
    pub(in crate::http) store: Arc<Store>,
    /// Held until the bytes are counted.
    pub(in crate::http) guard: UploadGuard,
    pub(in crate::http) id: Uuid,
    pub(in crate::http) row: UploadRow,
    pub(in crate::http) checksum: Option<Checksum>,
    /// Bytes that the whole upload may have.
    pub(in crate::http) max_bytes: u64,
    /// A sender that brings nothing for so long is given up.
    pub(in crate::http) idle: Duration,
    /// How long the upload is kept after this.
    pub(in crate::http) expiry: Duration,
}

/// Why no more bytes come.
enum End {
    Complete,
    Broken,
    Idle,
    Interrupted,
    TooLong,
}

struct Segment {
    sender: mpsc::Sender<Vec<Bytes>>,
    lot: Vec<Bytes>,
    lot_bytes: usize,
    writing: JoinHandle<std::io::Result<Appended>>,
}

impl Segment {
    /// Takes bytes; false once the writer has ended.
    async fn take(&mut self, bytes: Bytes) -> bool {
        self.lot_bytes += bytes.len();
        self.lot.push(bytes);
        self.lot_bytes < LOT_BYTES || self.send().await
    }

    async fn send(&mut self) -> bool {
        self.lot_bytes = 0;
        self.sender.send(std::mem::take(&mut self.lot)).await.is_ok()
    }
}

/// Takes the body in, counts what came, and puts a complete upload into its dataset; gives its row.
pub(in crate::http) async fn append(mut request: Append, body: Body) -> Result<(UploadRow, UploadGuard), Problem> {
    let before = request.row.clone();
    let taken = take_in(&mut request, body).await;
    let Append { store, row, .. } = &mut request;
    match taken {
        // Which counts the last bytes too, so that they wait for the disk once.
        Ok(sha256) if row.length == Some(row.offset) && row.dataset_id.is_some() => {
            if let Err(error) = store.store_upload(row, sha256).await {
                if !matches!(error, UploadError::Conflict(_)) {
                    store.save_upload(row, before.offset == 0).await?;
                }
                return Err(error.into());
            }
        }
        _ if *row != before => store.save_upload(row, before.offset == 0).await?,
        _ => {}
    }
    taken.map(|_| (request.row, request.guard))
}

/// Takes the body in and notes in the row what is durable; gives the hash of the upload's bytes where all of them came
/// just now.
async fn take_in(request: &mut Append, body: Body) -> Result<Option<[u8; 32]>, Problem> {
    let start = u64::try_from(request.row.offset).unwrap_or(0);
    let end_bytes = request.row.length.and_then(|length| u64::try_from(length).ok()).unwrap_or(request.max_bytes);
    let mut body = body.into_data_stream();
    let mut arrived = start;
    let mut interrupted: Option<Instant> = None;
    let mut hash = (start == 0).then(Sha256::new);
    let end = loop {
        let mut segment = None;
        let segment_start = arrived;
        let end = loop {
            let chunk = tokio::select! {
                biased;
                () = request.guard.interrupted(), if interrupted.is_none() => {
                    interrupted = Some(Instant::now());
                    continue;
                }
                chunk = tokio::time::timeout(interrupted.map_or(request.idle, |_| DRAIN_IDLE), body.next()) => chunk,
            };
            if interrupted.is_some_and(|since| since.elapsed() > DRAIN_MOST) {
                break Some(End::Interrupted);
            }
            let bytes = match chunk {
                Err(_) if interrupted.is_some() => break Some(End::Interrupted),
                Err(_) => break Some(End::Idle),
                Ok(None) => break Some(End::Complete),
                Ok(Some(Err(_))) => break Some(End::Broken),
                Ok(Some(Ok(bytes))) => bytes,
            };
            if bytes.is_empty() {
                continue;
            }
            arrived += bytes.len() as u64;
            if arrived > end_bytes {
                break Some(End::TooLong);
            }
            if let Some(checksum) = &mut request.checksum {
                checksum.update(&bytes);
            }
            let writer: &mut Segment = segment.get_or_insert_with(|| open(request, segment_start, hash.take()));
            if !writer.take(bytes).await {
                // The writer ended early: with an error, which the close below brings.
                break None;
            }
            if arrived - segment_start >= SEGMENT_BYTES {
                break None;
            }
        };
        if let Some(segment) = segment {
            let Appended { size_bytes: durable, hash: so_far, failure } = close(segment).await?;
            hash = so_far;
            // Bytes of a body that is too long, or under a checksum that has not spoken yet, do not count.
            if request.checksum.is_none() && !matches!(end, Some(End::TooLong)) {
                count(request, durable);
                // What ends the request is written with its end.
                if end.is_none() && failure.is_none() {
                    request.store.save_upload(&request.row, start == 0).await?;
                }
            }
            if let Some(error) = failure {
                return Err(error.into());
            }
        }
        if let Some(end) = end {
            break end;
        }
    };
    match (request.checksum.take(), &end) {
        (Some(checksum), End::Complete) => {
            if !checksum.holds() {
                return Err(Problem::new(Code::ChecksumMismatch).detail("the bytes are not those of the checksum"));
            }
            count(request, arrived);
        }
        // Bytes that can't be checked any more.
        (Some(_), _) => {}
        // The first bytes, or none, may complete a length that was told just now.
        (None, _) if arrived == start => count(request, start),
        (None, _) => {}
    }
    match end {
        // One of no bytes has no file yet, which whoever reads it makes.
        End::Complete => Ok(hash.filter(|_| arrived > 0).map(|hash| hash.finalize().into())),
        End::Broken => Err(Problem::new(Code::BadRequest).detail("the body broke off; the bytes that came are kept")),
        End::Idle => {
            Err(Problem::new(Code::RequestTimeout).detail("no byte came for too long; those that came are kept"))
        }
        End::Interrupted => Err(Problem::new(Code::UploadLocked).detail("another request asked for this upload")),
        End::TooLong => Err(Problem::new(Code::PayloadTooLarge)
            .detail(format!("the upload has {end_bytes} bytes; the body goes beyond them and was not taken"))),
    }
}

fn open(request: &Append, offset: u64, hash: Option<Sha256>) -> Segment {
    let (sender, mut lots) = mpsc::channel::<Vec<Bytes>>(QUEUED_LOTS);
    let (store, id) = (Arc::clone(&request.store), request.id);
    let writing = spawn_blocking(move || {
        let mut file = store.append_upload(id, offset, hash)?;
        while let Some(lot) = lots.blocking_recv() {
            if !lot.iter().all(|chunk| file.write(chunk)) {
                break;
            }
        }
        file.finish()
    });
    Segment { sender, lot: Vec::new(), lot_bytes: 0, writing }
}

/// Waits until a segment is durable.
async fn close(mut segment: Segment) -> Result<Appended, Problem> {
    // A writer that ended early says why below.
    let _ = segment.send().await;
    drop(segment.sender);
    Ok(segment.writing.await.map_err(|panic| Problem::internal(&panic))??)
}

/// Notes in the row what is durable.
fn count(request: &mut Append, offset: u64) {
    request.row.offset = i64::try_from(offset).unwrap_or(i64::MAX);
    request.row.expires_ms = now_ms() + i64::try_from(request.expiry.as_millis()).unwrap_or(i64::MAX / 2);
}
