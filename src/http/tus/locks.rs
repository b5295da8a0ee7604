//! One request at a time per upload. A request that only wants to know or to end an upload takes it from the one that brings
//! bytes: after a connection died, the sender often knows earlier than we do.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use tokio_util::sync::CancellationToken;
use uuid::Uuid;

#[derive(Clone, Debug, Default)]
struct Held {
    /// Whether it may last: the holder brings bytes.
    lasting: bool,
    interrupt: CancellationToken,
    released: CancellationToken,
}

/// The uploads that requests work on.
#[derive(Clone, Debug, Default)]
pub struct UploadLocks(Arc<Mutex<HashMap<Uuid, Held>>>);

/// An upload that one request works on.
#[derive(Debug)]
pub struct UploadGuard {
    locks: UploadLocks,
    id: Uuid,
    held: Held,
}

impl UploadLocks {
    fn map(&self) -> std::sync::MutexGuard<'_, HashMap<Uuid, Held>> {
        // A panic elsewhere can't leave the map half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Takes an upload to bring bytes; none when another request does so.
    pub async fn append(&self, id: Uuid) -> Option<UploadGuard> {
        loop {
            match self.lock_or_holder(id, true) {
                Ok(guard) => return Some(guard),
                Err(held) if held.lasting => return None,
                Err(held) => held.released.cancelled().await,
            }
        }
    }

    fn lock_or_holder(&self, id: Uuid, lasting: bool) -> Result<UploadGuard, Held> {
        let mut map = self.map();
        match map.get(&id) {
            Some(held) => Err(held.clone()),
            None => {
                let held = Held { lasting, ..Held::default() };
                map.insert(id, held.clone());
                Ok(UploadGuard { locks: self.clone(), id, held })
            }
        }
    }

    /// Takes an upload for a moment, from another request if need be; none when that does not let go in time.
    pub async fn take(&self, id: Uuid, wait: Duration) -> Option<UploadGuard> {
        let taken = async {
            loop {
                match self.lock_or_holder(id, false) {
                    Ok(guard) => return guard,
                    Err(held) => {
                        held.interrupt.cancel();
                        held.released.cancelled().await;
                    }
                }
            }
        };
        tokio::time::timeout(wait, taken).await.ok()
    }
}

impl UploadGuard {
    /// Returns once another request wants the upload.
    pub async fn interrupted(&self) {
        self.held.interrupt.cancelled().await;
    }
}

impl Drop for UploadGuard {
    fn drop(&mut self) {
        self.locks.map().remove(&self.id);
        self.held.released.cancel();
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[tokio::test]
    async fn one_holds_it_and_lets_go_when_asked() {
        let locks = UploadLocks::default();
        let id = Uuid::now_v7();
        let guard = locks.append(id).await.unwrap();
        assert!(locks.append(id).await.is_none());
        assert!(locks.take(id, Duration::from_millis(20)).await.is_none(), "whoever does not let go keeps it");
        let holder = tokio::spawn(async move { guard.interrupted().await });
        assert!(locks.take(id, Duration::from_secs(5)).await.is_some());
        holder.await.unwrap();
        assert!(locks.append(id).await.is_some());
    }
}
