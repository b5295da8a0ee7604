//! Durable storage: SQLite tables, photographs and outputs as files, and the artifact store.

mod archive;
mod artifacts;
pub(crate) mod atomic;
pub mod db;
mod file_name;
mod incoming;
mod layout;
mod quota;
mod resumable;
mod token;

use std::io;
use std::path::Path;

pub use archive::{ArchiveError, ArchiveLimits, unpack};
pub use artifacts::ArtifactStore;
pub use db::Db;
pub use file_name::{ImagePath, InvalidFileName};
pub use incoming::{Committed, StagedFile, StagedWriter};
pub use layout::DataDir;
pub(crate) use quota::check as check_quota;
pub use quota::{Quantity, Quota};
pub use resumable::{Appender, NewUpload, UploadError, UploadKind};
pub use token::{Scope, create_token, find_token};

/// Space that no work may fill, so that deleting and the database always work.
const RESERVE_BYTES: u64 = 32 << 20;

/// The database and the files that belong to it.
#[derive(Debug)]
pub struct Store {
    /// Tables.
    pub db: Db,
    /// Files.
    pub data: DataDir,
}

/// Why the store refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The path is stored with other bytes, or is a folder of another.
    #[error("{0:?} is stored already with other bytes")]
    FileConflict(String),
    /// A job on the dataset is queued or running.
    #[error("a job uses the dataset")]
    DatasetInUse,
    /// The token that it belongs to may not keep so much.
    #[error("the token may keep {limit} {what}; this would make {wanted}", what = .quantity.as_str())]
    QuotaExceeded {
        /// Of what.
        quantity: Quantity,
        /// How much it may keep.
        limit: u64,
        /// How much it would be.
        wanted: u64,
    },
    /// There is no such thing.
    #[error("not found")]
    NotFound,
    /// What the system said.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// What SQLite said.
    #[error("database: {0}")]
    Db(#[from] sqlx::Error),
}

impl StoreError {
    /// Whether the reason is that the disk is full.
    pub fn is_disk_full(&self) -> bool {
        match self {
            Self::Io(error) => matches!(error.kind(), io::ErrorKind::StorageFull | io::ErrorKind::QuotaExceeded),
            // SQLITE_FULL
            Self::Db(sqlx::Error::Database(error)) => error.code().as_deref() == Some("13"),
            _ => false,
        }
    }
}

impl Store {
    /// Opens a data directory, alone.
    ///
    /// # Errors
    /// What the system or SQLite said; [`io::ErrorKind::WouldBlock`] when another process uses it.
    pub async fn open(root: &Path) -> Result<Self, StoreError> {
        let data = DataDir::open(root)?;
        let db = Db::open(&data.database()).await?;
        Ok(Self { db, data })
    }

    /// Removes the folders of deleted jobs and datasets. What can't be removed stays on the list for the next time and is told to
    /// the log: it costs space, no more.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn discard_deleted(&self) -> Result<(), StoreError> {
        for folder in db::discards::list(self.db.reader()).await? {
            let data = self.data.clone();
            let place = data.root().join(&folder);
            let removal = tokio::task::spawn_blocking(move || data.discard(&place)).await;
            match removal.map_err(io::Error::other).and_then(|removed| removed) {
                Ok(()) => {
                    let mut tx = self.db.write().await?;
                    db::discards::remove(&mut tx, &folder).await?;
                    tx.commit().await?;
                }
                Err(error) => tracing::warn!(folder, %error, "a deleted folder could not be removed"),
            }
        }
        Ok(())
    }

    /// Bytes that work may still fill: a reserve for deleting and for the database is kept back, and what open uploads have
    /// announced counts as taken.
    ///
    /// # Errors
    /// What the system or SQLite said.
    pub async fn free_bytes(&self) -> Result<u64, StoreError> {
        let space = rustix::fs::statvfs(self.data.root()).map_err(io::Error::from)?;
        let free = space.f_bavail.saturating_mul(space.f_frsize);
        let promised = db::uploads::outstanding_bytes(self.db.reader()).await?;
        Ok(free.saturating_sub(RESERVE_BYTES).saturating_sub(u64::try_from(promised).unwrap_or(0)))
    }

    /// Fails unless there is room for so many bytes more.
    ///
    /// # Errors
    /// [`io::ErrorKind::StorageFull`], or what the system or SQLite said.
    pub async fn check_space(&self, bytes: u64) -> Result<(), StoreError> {
        if self.free_bytes().await? < bytes {
            return Err(io::Error::from(io::ErrorKind::StorageFull).into());
        }
        Ok(())
    }
}
