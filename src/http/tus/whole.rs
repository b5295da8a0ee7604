//! Photographs that come whole with the request that makes their upload wait in memory until they are written in one go.

use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;

use axum::body::Body;
use futures_util::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::Checksum;
use crate::config::UploadLimits;
use crate::http::problem::{Code, Problem};

/// Photographs lie in pieces of so many bytes. Used ones are kept for the next: to get fresh memory from the system,
/// page by page, costs more than to fill it.
const PIECE_BYTES: usize = 128 << 10;

/// The memory that all of them may take.
#[derive(Clone, Debug)]
pub(in crate::http) struct WaitingRoom {
    pieces: Arc<Pieces>,
    /// Of one photograph.
    most_bytes: u64,
}

#[derive(Debug)]
struct Pieces {
    count: usize,
    /// One permit for each that nobody has.
    free: Arc<Semaphore>,
    /// Used ones among them.
    used: Mutex<Vec<Vec<u8>>>,
}

impl Pieces {
    fn used(&self) -> MutexGuard<'_, Vec<Vec<u8>>> {
        // A panic elsewhere can't leave the list half changed.
        self.used.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Memory for one photograph.
#[derive(Debug)]
pub(in crate::http) struct Room {
    bytes: usize,
    pieces: Arc<Pieces>,
    permits: OwnedSemaphorePermit,
}

/// Some bytes of a photograph; their memory is free again when this is dropped.
#[derive(Debug)]
pub(in crate::http) struct Piece {
    bytes: Vec<u8>,
    pieces: Arc<Pieces>,
    _permit: OwnedSemaphorePermit,
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Piece {
    fn drop(&mut self) {
        let mut bytes = std::mem::take(&mut self.bytes);
        bytes.clear();
        self.pieces.used().push(bytes);
    }
}

impl WaitingRoom {
    pub(in crate::http) fn new(limits: &UploadLimits) -> Self {
        let count = usize::try_from(limits.memory_bytes).unwrap_or(usize::MAX) / PIECE_BYTES;
        let count = count.min(Semaphore::MAX_PERMITS);
        let pieces = Pieces { count, free: Arc::new(Semaphore::new(count)), used: Mutex::default() };
        Self { pieces: Arc::new(pieces), most_bytes: limits.memory_file_bytes }
    }

    /// Room for a photograph of so many bytes; none for nothing, for a large one, and when too many wait.
    pub(in crate::http) fn enter(&self, bytes: u64) -> Option<Room> {
        if bytes == 0 || bytes > self.most_bytes {
            return None;
        }
        let bytes = usize::try_from(bytes).ok()?;
        let count = u32::try_from(bytes.div_ceil(PIECE_BYTES)).ok()?;
        let permits = Arc::clone(&self.pieces.free).try_acquire_many_owned(count).ok()?;
        Some(Room { bytes, pieces: Arc::clone(&self.pieces), permits })
    }

    /// Bytes that may be on the disk before long.
    pub(in crate::http) fn taken_bytes(&self) -> u64 {
        ((self.pieces.count - self.pieces.free.available_permits()) * PIECE_BYTES) as u64
    }
}

impl Room {
    /// Takes in a body that announced to be the whole photograph. A sender that brings nothing for `idle` is given up.
    pub(in crate::http) async fn fill(
        mut self,
        body: Body,
        mut checksum: Option<Checksum>,
        idle: Duration,
    ) -> Result<Vec<Piece>, Problem> {
        let mut filled: Vec<Piece> = Vec::new();
        let mut missing = self.bytes;
        let mut body = body.into_data_stream();
        loop {
            let chunk = match tokio::time::timeout(idle, body.next()).await {
                Ok(Some(Ok(chunk))) if chunk.len() <= missing => chunk,
                Ok(None) if missing == 0 => break,
                Ok(_) => return Err(Problem::new(Code::BadRequest).detail("the body broke off")),
                Err(_) => return Err(Problem::new(Code::RequestTimeout).detail("no byte came for too long")),
            };
            if let Some(checksum) = &mut checksum {
                checksum.update(&chunk);
            }
            missing -= chunk.len();
            let mut rest = &chunk[..];
            while !rest.is_empty() {
                if filled.last().is_none_or(|last| last.bytes.len() == PIECE_BYTES) {
                    filled.extend(self.piece());
                }
                let Some(last) = filled.last_mut() else { return Err(Problem::new(Code::InternalError)) };
                let (now, later) = rest.split_at(rest.len().min(PIECE_BYTES - last.bytes.len()));
                last.bytes.extend_from_slice(now);
                rest = later;
            }
        }
        if checksum.is_some_and(|checksum| !checksum.holds()) {
            return Err(Problem::new(Code::ChecksumMismatch).detail("the bytes are not those of the checksum"));
        }
        Ok(filled)
    }

    /// One more piece, as long as there is any.
    fn piece(&mut self) -> Option<Piece> {
        let permit = self.permits.split(1)?;
        let bytes = self.pieces.used().pop().unwrap_or_else(|| Vec::with_capacity(PIECE_BYTES));
        Some(Piece { bytes, pieces: Arc::clone(&self.pieces), _permit: permit })
    }
}
