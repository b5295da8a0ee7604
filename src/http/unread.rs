//! What a sender still sends when its upload has been refused.
//!
//! A connection that is closed while bytes come in is reset, and the sender's system may then throw away the answer that waits
//! there (RFC 9112, section 9.6): a page would say "connection lost" instead of what is wrong. So the rest is read and dropped
//! before the answer goes out, within limits that a hostile sender can't stretch.

use std::sync::{Arc, Mutex, PoisonError};
use std::time::Duration;

use axum::body::{Body, BodyDataStream};
use futures_util::stream::{StreamExt, poll_fn};

/// Bytes read and dropped at most.
const MAX_BYTES: u64 = 32 << 20;
/// For so long at most.
const MAX_TIME: Duration = Duration::from_secs(3);

/// The part of a request's body that nobody has read yet.
#[derive(Clone)]
pub(super) struct Unread(Arc<Mutex<BodyDataStream>>);

impl Unread {
    /// A body that reads what `body` brings, and what it leaves.
    pub(super) fn split(body: Body) -> (Body, Self) {
        let unread = Self(Arc::new(Mutex::new(body.into_data_stream())));
        let reader = unread.clone();
        (Body::from_stream(poll_fn(move |context| reader.stream().poll_next_unpin(context))), unread)
    }

    /// Reads the rest and drops it.
    pub(super) async fn drop_rest(&self) {
        let read = async {
            let mut dropped = 0;
            while let Some(Ok(chunk)) = poll_fn(|context| self.stream().poll_next_unpin(context)).next().await {
                dropped += chunk.len() as u64;
                if dropped > MAX_BYTES {
                    break;
                }
            }
        };
        // Whatever is left after that is the sender's loss.
        let _ = tokio::time::timeout(MAX_TIME, read).await;
    }

    fn stream(&self) -> std::sync::MutexGuard<'_, BodyDataStream> {
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }
}
