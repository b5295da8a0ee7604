//! Photographs that come whole with the request that makes their upload wait in memory until they are written in one go.

use std::sync::Arc;
use std::time::Duration;

use axum::body::Body;
use futures_util::StreamExt;
use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::Checksum;
use crate::config::UploadLimits;
use crate::http::problem::{Code, Problem};

/// The memory that all of them may take.
#[derive(Clone, Debug)]
pub(in crate::http) struct WaitingRoom {
    /// Its permits are bytes.
    free: Arc<Semaphore>,
    bytes: usize,
    most_of_one: u64,
}

/// Memory for one photograph.
#[derive(Debug)]
pub(in crate::http) struct Room {
    bytes: usize,
    permit: OwnedSemaphorePermit,
}

/// A photograph, all of it.
#[derive(Debug)]
pub(in crate::http) struct WholeFile {
    bytes: Vec<u8>,
    _permit: OwnedSemaphorePermit,
}

impl AsRef<[u8]> for WholeFile {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl WaitingRoom {
    pub(in crate::http) fn new(limits: &UploadLimits) -> Self {
        let bytes = usize::try_from(limits.memory_bytes).unwrap_or(usize::MAX).min(Semaphore::MAX_PERMITS);
        Self { free: Arc::new(Semaphore::new(bytes)), bytes, most_of_one: limits.memory_file_bytes }
    }

    /// Room for a photograph of so many bytes; none for nothing, for a large one, and when too many wait.
    pub(in crate::http) fn enter(&self, bytes: u64) -> Option<Room> {
        if bytes == 0 || bytes > self.most_of_one {
            return None;
        }
        let permit = Arc::clone(&self.free).try_acquire_many_owned(u32::try_from(bytes).ok()?).ok()?;
        Some(Room { bytes: permit.num_permits(), permit })
    }

    /// Bytes that will be on the disk before long.
    pub(in crate::http) fn taken_bytes(&self) -> u64 {
        (self.bytes - self.free.available_permits()) as u64
    }
}

impl Room {
    /// Takes in a body that announced to be the whole photograph. A sender that brings nothing for `idle` is given up.
    pub(in crate::http) async fn fill(
        self,
        body: Body,
        checksum: Option<Checksum>,
        idle: Duration,
    ) -> Result<WholeFile, Problem> {
        let mut bytes = Vec::with_capacity(self.bytes);
        let mut body = body.into_data_stream();
        loop {
            match tokio::time::timeout(idle, body.next()).await {
                Ok(Some(Ok(chunk))) if chunk.len() <= self.bytes - bytes.len() => bytes.extend_from_slice(&chunk),
                Ok(None) if bytes.len() == self.bytes => break,
                Ok(_) => return Err(Problem::new(Code::BadRequest).detail("the body broke off")),
                Err(_) => return Err(Problem::new(Code::RequestTimeout).detail("no byte came for too long")),
            }
        }
        if let Some(mut checksum) = checksum {
            checksum.update(&bytes);
            if !checksum.holds() {
                return Err(Problem::new(Code::ChecksumMismatch).detail("the bytes are not those of the checksum"));
            }
        }
        Ok(WholeFile { bytes, _permit: self.permit })
    }
}
