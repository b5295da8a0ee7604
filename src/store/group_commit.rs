//! Many small writes made durable together.
//!
//! A commit waits for the disk, and one that waits can take others along: requests hand their writes to one task, which syncs the
//! folders that any of them touched, writes all of them in one transaction, commits it and tells each. While it waits for the disk
//! the next ones gather, so the more requests there are the fewer syncs each costs, and a lone one waits for nobody.
//! Each write is undone alone when it fails. A transaction that fails as a whole is taken apart and tried one by one, so that
//! everybody learns of their own failure and of no other.

use std::collections::BTreeSet;
use std::io;
use std::path::PathBuf;

use futures_util::future::BoxFuture;
use sqlx::{Connection, SqliteConnection};
use tokio::sync::{mpsc, oneshot};
use tokio::task::JoinSet;

use super::db::write::{Stopwatch, Syncing, WaitsFor};
use super::{Db, StoreError, atomic};

/// Writes of one transaction.
const MAX_WRITES: usize = 256;

/// The door to the task that commits. The task ends when the last door is gone.
#[derive(Clone, Debug)]
pub(super) struct GroupCommit {
    db: Db,
    waiting: mpsc::UnboundedSender<Box<dyn Write>>,
}

/// What one request writes, and how it learns what became of it.
trait Write: Send {
    /// Folders whose entries must be durable before the row is.
    fn folders(&self) -> &[PathBuf];

    /// Writes and notes the outcome; whether it is one to keep.
    fn run<'a>(&'a mut self, tx: &'a mut SqliteConnection) -> BoxFuture<'a, bool>;

    /// Tells the outcome, or why there is none.
    fn answer(self: Box<Self>, committed: Result<(), StoreError>);
}

struct Request<T, E, F> {
    folders: Vec<PathBuf>,
    work: F,
    outcome: Option<Result<T, E>>,
    answer: oneshot::Sender<Result<T, E>>,
    _stopwatch: Stopwatch,
}

impl<T, E, F> Write for Request<T, E, F>
where
    T: Send,
    E: From<StoreError> + Send,
    F: for<'c> Fn(&'c mut SqliteConnection) -> BoxFuture<'c, Result<T, E>> + Send + Sync,
{
    fn folders(&self) -> &[PathBuf] {
        &self.folders
    }

    fn run<'a>(&'a mut self, tx: &'a mut SqliteConnection) -> BoxFuture<'a, bool> {
        Box::pin(async {
            let outcome = (self.work)(tx).await;
            self.outcome.insert(outcome).is_ok()
        })
    }

    fn answer(self: Box<Self>, committed: Result<(), StoreError>) {
        let outcome = match (committed, self.outcome) {
            (Err(error), _) => Err(error.into()),
            (Ok(()), Some(outcome)) => outcome,
            (Ok(()), None) => Err(ended().into()),
        };
        // Whoever left can't be told.
        let _ = self.answer.send(outcome);
    }
}

fn ended() -> StoreError {
    io::Error::other("the task that commits ended").into()
}

impl GroupCommit {
    /// Starts the task.
    pub(super) fn start(db: &Db) -> Self {
        let (waiting, requests) = mpsc::unbounded_channel();
        tokio::spawn(commit_all(db.clone(), requests));
        Self { db: db.clone(), waiting }
    }

    /// Makes the entries of `folders` durable, then what `work` writes, and gives what `work` gave. `work` may be asked again, when
    /// the transaction that it was part of failed.
    ///
    /// # Errors
    /// What `work` refused, or what the system or SQLite said; nothing is written then.
    pub(super) async fn commit<T, E, F>(&self, folders: Vec<PathBuf>, work: F) -> Result<T, E>
    where
        T: Send + 'static,
        E: From<StoreError> + Send + 'static,
        F: for<'c> Fn(&'c mut SqliteConnection) -> BoxFuture<'c, Result<T, E>> + Send + Sync + 'static,
    {
        let (answer, answered) = oneshot::channel();
        let stopwatch = Stopwatch::start(self.db.times(), WaitsFor::FoldersToo);
        let request = Request { folders, work, outcome: None, answer, _stopwatch: stopwatch };
        self.waiting.send(Box::new(request)).map_err(|_| ended())?;
        answered.await.map_err(|_| ended())?
    }
}

async fn commit_all(db: Db, mut requests: mpsc::UnboundedReceiver<Box<dyn Write>>) {
    let mut gathered = Vec::new();
    while requests.recv_many(&mut gathered, MAX_WRITES).await > 0 {
        let (db, writes) = (db.clone(), std::mem::take(&mut gathered));
        // In a task of its own: a panic ends these alone.
        if let Err(panic) = tokio::spawn(async move { commit_together(&db, writes).await }).await {
            tracing::error!(%panic, "writes ended in a panic");
        }
    }
}

async fn commit_together(db: &Db, mut writes: Vec<Box<dyn Write>>) {
    if writes.len() > 1 && attempt(db, &mut writes).await.is_ok() {
        writes.into_iter().for_each(|write| write.answer(Ok(())));
        return;
    }
    for write in writes {
        let mut alone = [write];
        let committed = attempt(db, &mut alone).await;
        let [write] = alone;
        write.answer(committed);
    }
}

/// Syncs the folders, runs the writes and commits those that want to be kept.
async fn attempt(db: &Db, writes: &mut [Box<dyn Write>]) -> Result<(), StoreError> {
    let folders: BTreeSet<PathBuf> = writes.iter().flat_map(|write| write.folders()).cloned().collect();
    if !folders.is_empty() {
        let _syncing = Syncing::folders(db.times());
        // Side by side: the disk syncs several as fast as one.
        let mut syncs = JoinSet::new();
        for folder in folders {
            syncs.spawn_blocking(move || atomic::sync_dir(&folder));
        }
        while let Some(synced) = syncs.join_next().await {
            match synced.map_err(io::Error::other)? {
                // Deleted meanwhile, with what the writes speak of: they will see.
                Err(error) if error.kind() == io::ErrorKind::NotFound => {}
                other => other?,
            }
        }
    }
    let mut tx = db.write_untimed().await?;
    let mut kept = false;
    if let [alone] = writes {
        kept = alone.run(&mut tx).await;
    } else {
        for write in writes {
            let mut part = tx.begin().await?;
            if write.run(&mut part).await {
                part.commit().await?;
                kept = true;
            } else {
                part.rollback().await?;
            }
        }
    }
    if kept { tx.commit().await? } else { tx.rollback().await? };
    Ok(())
}
