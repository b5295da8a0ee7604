//! SQLite: the only place with SQL, one file per table.
//!
//! WAL with `synchronous=FULL`: what was committed survives a power cut. All writes go through one connection and start with
//! BEGIN IMMEDIATE, because a deferred transaction that turns into a writer fails at once when another wrote meanwhile, whatever
//! the busy timeout; readers have their own connections and never wait.

pub mod dataset_images;
pub mod datasets;
pub mod job_events;
pub mod job_images;
pub mod job_outputs;
pub mod job_stages;
pub mod jobs;

use std::path::Path;
use std::time::Duration;

use sqlx::migrate::Migrator;
use sqlx::sqlite::{SqliteConnectOptions, SqliteJournalMode, SqlitePoolOptions, SqliteSynchronous};
use sqlx::{Sqlite, SqlitePool, Transaction};

static MIGRATIONS: Migrator = sqlx::migrate!("./migrations");

/// Connections that only read.
const READERS: u32 = 4;

/// The database.
#[derive(Clone, Debug)]
pub struct Db {
    reader: SqlitePool,
    writer: SqlitePool,
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
            .connect_with(options.clone())
            .await?;
        MIGRATIONS.run(&writer).await.map_err(|error| sqlx::Error::Migrate(Box::new(error)))?;
        let reader = SqlitePoolOptions::new()
            .max_connections(READERS)
            .acquire_timeout(Duration::from_secs(60))
            .connect_with(options.read_only(true).create_if_missing(false))
            .await?;
        Ok(Self { reader, writer })
    }

    /// For single reads.
    pub fn reader(&self) -> &SqlitePool {
        &self.reader
    }

    /// A transaction that may write; waits for its turn.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn write(&self) -> Result<Transaction<'static, Sqlite>, sqlx::Error> {
        self.writer.begin_with("BEGIN IMMEDIATE").await
    }

    /// Closes every connection.
    pub async fn close(&self) {
        self.reader.close().await;
        self.writer.close().await;
    }
}

/// The time, in milliseconds since 1970.
pub fn now_ms() -> i64 {
    jiff::Timestamp::now().as_millisecond()
}
