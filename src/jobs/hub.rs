//! What the parts of one process tell each other about jobs. Nothing here is the truth: it only wakes those who then read it.

use std::collections::HashMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Mutex, PoisonError};

use tokio::sync::{Notify, watch};
use uuid::Uuid;

use crate::pipeline::CancelFlag;

/// Wakes the executor and the event streams, and reaches running jobs.
#[derive(Debug)]
pub struct Hub {
    work: Notify,
    changes: watch::Sender<u64>,
    running: Mutex<HashMap<Uuid, CancelFlag>>,
    stopping: AtomicBool,
}

impl Default for Hub {
    fn default() -> Self {
        Self {
            work: Notify::new(),
            changes: watch::Sender::new(0),
            running: Mutex::default(),
            stopping: AtomicBool::new(false),
        }
    }
}

impl Hub {
    /// Something about a job was committed.
    pub fn announce(&self) {
        self.changes.send_modify(|count| *count += 1);
    }

    /// Changes whenever something about a job was committed.
    pub fn changes(&self) -> watch::Receiver<u64> {
        self.changes.subscribe()
    }

    /// A job was queued.
    pub(super) fn wake_executor(&self) {
        self.work.notify_one();
    }

    /// Returns after [`Self::wake_executor`].
    pub(super) async fn woken(&self) {
        self.work.notified().await;
    }

    fn running(&self) -> std::sync::MutexGuard<'_, HashMap<Uuid, CancelFlag>> {
        // A panic elsewhere can't leave the map half changed.
        self.running.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Remembers the flag of a job that starts.
    pub(super) fn started(&self, job: Uuid) -> CancelFlag {
        let flag = CancelFlag::default();
        self.running().insert(job, flag.clone());
        if self.is_stopping() {
            flag.cancel();
        }
        flag
    }

    /// Forgets a job that ended.
    pub(super) fn ended(&self, job: Uuid) {
        self.running().remove(&job);
    }

    /// Asks a running job to stop.
    pub(super) fn cancel(&self, job: Uuid) {
        if let Some(flag) = self.running().get(&job) {
            flag.cancel();
        }
    }

    /// Asks every running job to stop and go back to the queue, because the process ends.
    pub fn stop(&self) {
        self.stopping.store(true, Ordering::SeqCst);
        for flag in self.running().values() {
            flag.cancel();
        }
    }

    /// Whether the process ends.
    pub fn is_stopping(&self) -> bool {
        self.stopping.load(Ordering::SeqCst)
    }
}
