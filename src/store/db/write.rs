//! Transactions that write: one at a time, each timed.
//!
//! How long a write takes has two causes that want different cures: the disk, which syncs as fast as it does, and
//! everything else, which is ours. So the time of a write is counted without the time in which the writer waited for
//! the disk.

use std::ops::{Deref, DerefMut};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use sqlx::{Sqlite, SqliteConnection, Transaction};

/// Upper ends of the classes that writes are counted in, in milliseconds; one more class has no end.
pub const CLASSES_MS: [u64; 10] = [1, 2, 5, 10, 20, 50, 100, 200, 500, 1000];

/// What writes took.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct WriteFigures {
    /// Writes by class, each up to the end of [`CLASSES_MS`] with its number, and the rest.
    pub counts: [u64; CLASSES_MS.len() + 1],
    /// Time of all writes from the request to the answer, syncs left out.
    pub time: Duration,
    /// Time in which a commit waited for the disk.
    pub syncs: Duration,
}

impl WriteFigures {
    /// The end of the class, in milliseconds, within which a share of all writes lies; none beyond the last or without any.
    pub fn within_ms(&self, share: f64) -> Option<u64> {
        let wanted = (self.counts.iter().sum::<u64>() as f64 * share).ceil();
        let mut count = 0;
        CLASSES_MS.iter().zip(&self.counts).find_map(|(end_ms, more)| {
            count += more;
            (count > 0 && count as f64 >= wanted).then_some(*end_ms)
        })
    }
}

/// Runs while at least one sync is under way.
#[derive(Debug, Default)]
struct SyncClock(Mutex<Syncs>);

#[derive(Debug, Default)]
struct Syncs {
    over: Duration,
    open: usize,
    since: Option<Instant>,
}

impl SyncClock {
    fn syncs(&self) -> MutexGuard<'_, Syncs> {
        // A panic elsewhere can't leave the clock half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read(&self) -> Duration {
        let syncs = self.syncs();
        syncs.over + syncs.since.map_or(Duration::ZERO, |since| since.elapsed())
    }

    fn start(&self) {
        let mut syncs = self.syncs();
        syncs.open += 1;
        syncs.since.get_or_insert_with(Instant::now);
    }

    fn stop(&self) {
        let mut syncs = self.syncs();
        syncs.open -= 1;
        if syncs.open == 0
            && let Some(since) = syncs.since.take()
        {
            syncs.over += since.elapsed();
        }
    }
}

/// What is known of the times of writes.
#[derive(Debug, Default)]
pub(in crate::store) struct WriteTimes {
    figures: Mutex<WriteFigures>,
    /// Of commits, which every writer waits for.
    commits: SyncClock,
}

impl WriteTimes {
    /// What writes took so far.
    pub(in crate::store) fn figures(&self) -> WriteFigures {
        let figures = *self.figures.lock().unwrap_or_else(PoisonError::into_inner);
        WriteFigures { syncs: self.commits.read(), ..figures }
    }
}

/// Times one write until it is dropped.
#[derive(Debug)]
pub(in crate::store) struct Stopwatch {
    times: Arc<WriteTimes>,
    start: Instant,
    syncs: Duration,
}

impl Stopwatch {
    pub(in crate::store) fn start(times: &Arc<WriteTimes>) -> Self {
        Self { times: Arc::clone(times), start: Instant::now(), syncs: times.commits.read() }
    }
}

impl Drop for Stopwatch {
    fn drop(&mut self) {
        let syncs = self.times.commits.read().saturating_sub(self.syncs);
        let time = self.start.elapsed().saturating_sub(syncs);
        let class = CLASSES_MS.iter().position(|end_ms| time <= Duration::from_millis(*end_ms));
        let mut figures = self.times.figures.lock().unwrap_or_else(PoisonError::into_inner);
        figures.counts[class.unwrap_or(CLASSES_MS.len())] += 1;
        figures.time += time;
    }
}

/// A commit that waits for the disk, until it is dropped.
struct Syncing(Arc<WriteTimes>);

impl Syncing {
    fn start(times: &Arc<WriteTimes>) -> Self {
        times.commits.start();
        Self(Arc::clone(times))
    }
}

impl Drop for Syncing {
    fn drop(&mut self) {
        self.0.commits.stop();
    }
}

/// A transaction that may write; undone when dropped.
pub struct WriteTransaction {
    pub(super) inner: Transaction<'static, Sqlite>,
    pub(super) times: Arc<WriteTimes>,
    /// None where whoever asked is timed.
    pub(super) stopwatch: Option<Stopwatch>,
    /// None for what does not count as a change.
    pub(super) change: Option<Change>,
}

/// Counts when it is dropped, so also when nobody waited for the end of a commit.
pub(super) struct Change(pub(super) Arc<AtomicU64>);

impl Drop for Change {
    fn drop(&mut self) {
        self.0.fetch_add(1, Ordering::SeqCst);
    }
}

impl WriteTransaction {
    /// Makes it durable.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn commit(self) -> sqlx::Result<()> {
        let Self { inner, times, stopwatch, change: _change } = self;
        let syncing = Syncing::start(&times);
        let committed = inner.commit().await;
        drop(syncing);
        drop(stopwatch);
        committed
    }

    /// Undoes it.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn rollback(self) -> sqlx::Result<()> {
        self.inner.rollback().await
    }
}

impl Deref for WriteTransaction {
    type Target = SqliteConnection;

    fn deref(&self) -> &SqliteConnection {
        &self.inner
    }
}

impl DerefMut for WriteTransaction {
    fn deref_mut(&mut self) -> &mut SqliteConnection {
        &mut self.inner
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_write_is_counted_without_the_syncs_that_it_waited_for() {
        let times = Arc::new(WriteTimes::default());
        let nap = |ms| std::thread::sleep(Duration::from_millis(ms));
        let stopwatch = Stopwatch::start(&times);
        let syncing = Syncing::start(&times);
        nap(300);
        drop(syncing);
        drop(stopwatch);
        let after = times.figures();
        assert!(after.syncs >= Duration::from_millis(300) && after.time < Duration::from_millis(300), "{after:?}");
        // Whatever else it does is counted.
        let stopwatch = Stopwatch::start(&times);
        nap(300);
        drop(stopwatch);
        assert!(times.figures().time - after.time >= Duration::from_millis(300));
    }

    #[test]
    fn shares_lie_within_classes() {
        let mut figures = WriteFigures::default();
        assert_eq!(figures.within_ms(0.99), None);
        figures.counts[1] = 98;
        figures.counts[5] = 1;
        figures.counts[CLASSES_MS.len()] = 1;
        assert_eq!(
            (figures.within_ms(0.98), figures.within_ms(0.99), figures.within_ms(1.0)),
            (Some(2), Some(50), None)
        );
    }
}
