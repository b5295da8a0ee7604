//! Many small writes made durable together.
//!
//! A commit waits for the disk, and one that waits can take others along: requests hand their writes to one task, which
//! makes all of them in one transaction, commits it and tells each. While it waits for the disk the next ones gather,
//! so the more requests there are the fewer syncs each costs, and a lone one waits for nobody. Files and folders that a
//! write speaks of are durable before it is handed over: each request syncs its own, side by side with the others. A
//! transaction that fails, or in which one write refuses, is undone and taken apart: whoever refused is asked alone and
//! the others together once more, and when that fails too, one by one. So everybody learns of their own failure and of
//! no other, and what is rare costs those who meet it; savepoints would cost everybody.

use std::io;
use std::panic::AssertUnwindSafe;

use futures_util::FutureExt;
use futures_util::future::BoxFuture;
use sqlx::SqliteConnection;
use tokio::sync::{mpsc, oneshot};

use super::db::write::Stopwatch;
use super::{Db, StoreError};

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
    /// Writes and notes the outcome; whether it is one to keep.
    fn run<'a>(&'a mut self, tx: &'a mut SqliteConnection) -> BoxFuture<'a, bool>;

    /// Tells the outcome, or why there is none.
    fn answer(self: Box<Self>, committed: Result<(), StoreError>);
}

struct Request<T, E, F> {
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

    /// Makes durable what `work` writes, and gives what `work` gave. `work` may be asked again, when
    /// the transaction that it was part of failed.
    ///
    /// # Errors
    /// What `work` refused, or what the system or SQLite said; nothing is written then.
    pub(super) async fn commit<T, E, F>(&self, work: F) -> Result<T, E>
    where
        T: Send + 'static,
        E: From<StoreError> + Send + 'static,
        F: for<'c> Fn(&'c mut SqliteConnection) -> BoxFuture<'c, Result<T, E>> + Send + Sync + 'static,
    {
        let (answer, answered) = oneshot::channel();
        let stopwatch = Stopwatch::start(self.db.times());
        let request = Request { work, outcome: None, answer, _stopwatch: stopwatch };
        self.waiting.send(Box::new(request)).map_err(|_| ended())?;
        answered.await.map_err(|_| ended())?
    }
}

async fn commit_all(db: Db, mut requests: mpsc::UnboundedReceiver<Box<dyn Write>>) {
    let mut gathered = Vec::new();
    while requests.recv_many(&mut gathered, MAX_WRITES).await > 0 {
        let writes = std::mem::take(&mut gathered);
        // A panic ends these alone; they are dropped with it, which tells whoever waits.
        if AssertUnwindSafe(commit_together(&db, writes)).catch_unwind().await.is_err() {
            tracing::error!("writes ended in a panic");
        }
    }
}

async fn commit_together(db: &Db, mut writes: Vec<Box<dyn Write>>) {
    // Who refused, with their places among the others.
    let mut refused: Vec<(usize, Box<dyn Write>)> = Vec::new();
    // At most twice together: without those who refused the first time.
    for _ in 0..2 {
        if writes.len() < 2 {
            break;
        }
        match attempt(db, &mut writes).await {
            Ok(None) => {
                writes.into_iter().for_each(|write| write.answer(Ok(())));
                writes = Vec::new();
            }
            Ok(Some(at)) => refused.push((at, writes.remove(at))),
            Err(_) => break,
        }
    }
    if !writes.is_empty() {
        // Whoever refuses because of an earlier write must still come after it: the last taken out is put back first.
        while let Some((at, write)) = refused.pop() {
            writes.insert(at, write);
        }
    }
    for write in refused.into_iter().map(|(_, write)| write).chain(writes) {
        let mut alone = [write];
        let committed = attempt(db, &mut alone).await.map(|_| ());
        let [write] = alone;
        write.answer(committed);
    }
}

/// Runs the writes and commits them; gives the first that refused, because of which nothing is written.
async fn attempt(db: &Db, writes: &mut [Box<dyn Write>]) -> Result<Option<usize>, StoreError> {
    let mut tx = db.write_untimed().await?;
    for (at, write) in writes.iter_mut().enumerate() {
        if !write.run(&mut tx).await {
            tx.rollback().await?;
            return Ok(Some(at));
        }
    }
    tx.commit().await?;
    Ok(None)
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    async fn write(group: &GroupCommit, name: &'static str, refuses: bool) -> Result<usize, StoreError> {
        let written = group.commit(move |tx| {
            Box::pin(async move {
                sqlx::query("INSERT INTO discards (folder) VALUES (?)").bind(name).execute(&mut *tx).await?;
                if refuses { Err(StoreError::NotFound) } else { Ok(name.len()) }
            })
        });
        written.await
    }

    #[tokio::test]
    async fn writes_share_a_transaction_and_a_failure_is_of_its_own_alone() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("x.db")).await.unwrap();
        let group = GroupCommit::start(&db);
        // While somebody else writes, all of these gather.
        let other = db.write().await.unwrap();
        let all = async {
            tokio::join!(
                write(&group, "one", false),
                write(&group, "refused", true),
                write(&group, "two", false),
                // SQLite itself refuses it.
                write(&group, "two", false),
                write(&group, "three", false),
            )
        };
        let release = async {
            tokio::time::sleep(std::time::Duration::from_millis(50)).await;
            other.rollback().await.unwrap();
        };
        let (all, ()) = tokio::join!(all, release);
        assert_eq!((all.0.unwrap(), all.2.unwrap(), all.4.unwrap()), (3, 3, 5));
        assert!(matches!((all.1, all.3), (Err(StoreError::NotFound), Err(StoreError::Db(_)))));
        let kept = super::super::db::discards::list(db.reader()).await.unwrap();
        assert_eq!(kept, ["one", "three", "two"]);
    }
}
