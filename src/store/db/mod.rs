//! SQLite: the only place with SQL, one file per table.
//!
//! WAL with `synchronous=FULL`: what was committed survives a power cut. All writes go through one connection and start
//! with BEGIN IMMEDIATE, because a deferred transaction that turns into a writer fails at once when another wrote
//! meanwhile, whatever the busy timeout; readers have their own connections and never wait.

pub mod dataset_images;
pub mod datasets;
pub mod discards;
pub mod inventory;
pub mod job_events;
pub mod job_images;
pub mod job_outputs;
pub mod job_stages;
pub mod jobs;
pub mod nodeodm_tasks;
pub mod tokens;
pub mod uploads;
pub mod webhooks;
pub mod write;

use std::path::Path;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, OnceLock};
use std::time::Duration;

use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Connection, SqlitePool};

use write::{Change, Stopwatch, WriteFigures, WriteTimes, WriteTransaction};

static MIGRATIONS: Migrator = sqlx::migrate!("./migrations");

/// Connections that only read.
const READERS: u32 = 4;

/// The database.
#[derive(Clone, Debug)]
pub struct Db {
    reader: SqlitePool,
    writer: SqlitePool,
    times: Arc<WriteTimes>,
    changes: Arc<AtomicU64>,
}

impl Db {
    /// Opens the database, makes it when it is not there, and brings it to the current schema.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn open(path: &Path) -> Result<Self, sqlx::Error> {
        let options = SqliteConnectOptions::new()
            .filename(path)
            .create_if_missing(true)
            .journal_mode(SqliteJournalMode::Wal)
            .synchronous(SqliteSynchronous::Full)
            .foreign_keys(true)
            .busy_timeout(Duration::from_secs(10));
        let writer = SqlitePoolOptions::new()
            .max_connections(1)
            .idle_timeout(None)
            .max_lifetime(None)
            .acquire_timeout(Duration::from_secs(60))
            // There is no network in between that could have closed it.
            .test_before_acquire(false)
            // A commit that fails, as on a full disk, may leave a connection that believes to be in a transaction which
            // SQLite has rolled back; it would refuse every further one.
            .after_release(|connection, _| {
                Box::pin(async move {
                    connection.ping().await?;
                    Ok(!connection.is_in_transaction())
                })
            })
            .connect_with(options.clone())
            .await?;
        MIGRATIONS.run(&writer).await.map_err(|error| sqlx::Error::Migrate(Box::new(error)))?;
        let reader = SqlitePoolOptions::new()
            .max_connections(READERS)
            .acquire_timeout(Duration::from_secs(60))
            .test_before_acquire(false)
            .connect_with(options.read_only(true).create_if_missing(false))
            .await?;
        Ok(Self { reader, writer, times: Arc::default(), changes: Arc::default() })
    }

    /// For single reads.
    pub fn reader(&self) -> &SqlitePool {
        &self.reader
    }

    /// A transaction that may write; waits for its turn.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn write(&self) -> Result<WriteTransaction, sqlx::Error> {
        let stopwatch = Stopwatch::start(&self.times);
        let change = Some(Change(Arc::clone(&self.changes)));
        Ok(WriteTransaction { stopwatch: Some(stopwatch), change, ..self.write_untimed().await? })
    }

    /// The same for whoever times what it does itself, and changes neither datasets nor jobs but for what is in them.
    ///
    /// # Errors
    /// What SQLite said.
    pub(in crate::store) async fn write_untimed(&self) -> Result<WriteTransaction, sqlx::Error> {
        let inner = self.writer.begin_with("BEGIN IMMEDIATE").await?;
        Ok(WriteTransaction { inner, times: Arc::clone(&self.times), stopwatch: None, change: None })
    }

    /// Counts what this process commits besides photographs and uploads.
    pub(in crate::store) fn changes(&self) -> u64 {
        self.changes.load(Ordering::SeqCst)
    }

    /// What writes took since the start.
    pub fn write_figures(&self) -> WriteFigures {
        self.times.figures()
    }

    pub(in crate::store) fn times(&self) -> &Arc<WriteTimes> {
        &self.times
    }

    /// Closes every connection.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }
}

/// The time, in milliseconds since 1970. Within one process it runs evenly, also through sleep: when somebody sets the system's
/// clock meanwhile, nothing expires early and no duration turns negative.
pub fn now_ms() -> i64 {
    static START: OnceLock<(i64, i64)> = OnceLock::new();
    let (wall_ms, boot_ms) = *START.get_or_init(|| (jiff::Timestamp::now().as_millisecond(), since_boot_ms()));
    wall_ms + since_boot_ms() - boot_ms
}

fn since_boot_ms() -> i64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::Boottime);
    time.tv_sec * 1000 + time.tv_nsec / 1_000_000
}
