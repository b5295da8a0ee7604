//! Who puts what under which path: one request at a time per path of a dataset.
//!
//! A file enters its dataset before its row is written, so for a while the database does not know of it. Who holds the
//! claim on a path may therefore rename a file to it when the database has no row: whatever lies there is a remainder
//! of a crash.

use std::collections::{BTreeSet, HashSet};
use std::sync::{Mutex, MutexGuard, PoisonError};

use tokio::sync::Notify;
use uuid::Uuid;

/// The paths that requests are about to fill.
#[derive(Debug, Default)]
pub(super) struct Claims {
    taken: Mutex<HashSet<(Uuid, String)>>,
    freed: Notify,
}

/// Paths of a dataset that nobody else fills until this is dropped.
#[derive(Debug)]
pub(super) struct Claim<'a> {
    claims: &'a Claims,
    paths: Vec<(Uuid, String)>,
}

impl Claims {
    fn taken(&self) -> MutexGuard<'_, HashSet<(Uuid, String)>> {
        // A panic elsewhere can't leave the set half changed.
        self.taken.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until all paths are free and takes them at once, so that two who want several never wait for each other.
    pub(super) async fn take(&self, dataset: Uuid, paths: BTreeSet<String>) -> Claim<'_> {
        let paths: Vec<_> = paths.into_iter().map(|path| (dataset, path)).collect();
        loop {
            // Before the look, so that what is freed after it is noticed.
            let freed = self.freed.notified();
            {
                let mut taken = self.taken();
                if !paths.iter().any(|path| taken.contains(path)) {
                    taken.extend(paths.iter().cloned());
                    return Claim { claims: self, paths };
                }
            }
            freed.await;
        }
    }
}

impl Drop for Claim<'_> {
    fn drop(&mut self) {
        let mut taken = self.claims.taken();
        for path in &self.paths {
            taken.remove(path);
        }
        drop(taken);
        self.claims.freed.notify_waiters();
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    #[tokio::test]
    async fn paths_are_taken_all_or_none() {
        let claims = Claims::default();
        let paths = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect::<BTreeSet<_>>();
        let dataset = Uuid::now_v7();
        let first = claims.take(dataset, paths(&["a", "b"])).await;
        let second = claims.take(dataset, paths(&["c", "b"]));
        tokio::pin!(second);
        assert!(tokio::time::timeout(Duration::from_millis(20), &mut second).await.is_err());
        // The other one waits and holds nothing meanwhile; another dataset's are its own.
        drop(claims.take(dataset, paths(&["c"])).await);
        drop(claims.take(Uuid::now_v7(), paths(&["a", "b"])).await);
        drop(first);
        drop(second.await);
    }
}
