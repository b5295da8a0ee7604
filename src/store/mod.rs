//! Durable storage: SQLite tables, photographs and outputs as files, and the artifact store.

mod appender;
mod archive;
mod artifacts;
pub(crate) mod atomic;
mod backup;
mod claims;
pub mod db;
mod doctor;
mod file_name;
mod folders;
mod group_commit;
mod incoming;
mod layout;
mod outputs;
mod placing;
mod quota;
mod resumable;
mod space;
mod token;
mod whole;
mod writable;

use std::io;
use std::path::Path;
use std::sync::Arc;

use tokio::sync::Mutex;

pub use appender::{Appended, Appender};
pub use archive::{ArchiveError, ArchiveLimits, unpack};
pub use artifacts::ArtifactStore;
pub use backup::{BackedUp, back_up};
use claims::Claims;
pub use db::Db;
pub use doctor::{Finding, examine};
pub use file_name::{ImagePath, InvalidFileName};
use folders::DurableFolders;
use group_commit::GroupCommit;
pub use incoming::{StagedFile, StagedWriter};
pub use layout::{DataDir, ScratchDir};
pub use outputs::Checksums;
pub use placing::Committed;
pub(crate) use quota::check as check_quota;
pub use quota::{Quantity, Quota};
pub use resumable::{NewUpload, UploadError, UploadKind};
use space::{Promised, Reservations};
pub use token::{Scope, create_token, find_token};
use writable::Writable;

/// The database and the files that belong to it.
#[derive(Debug)]
pub struct Store {
    /// Tables.
    pub db: Db,
    /// Files.
    pub data: DataDir,
    reservations: Reservations,
    promised: Promised,
    group: GroupCommit,
    claims: Claims,
    writable: Writable,
    folders: Arc<DurableFolders>,
    /// Held by whoever removes deleted folders.
    discarding: Mutex<()>,
}

/// Why the store refused or failed.
#[derive(Debug, thiserror::Error)]
pub enum StoreError {
    /// The path is stored with other bytes, or is a folder of another, or one of its folders is a photograph.
    #[error("something else is stored already at {0:?} or at one of its folders")]
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
            Self::Db(sqlx::Error::Io(error)) => matches!(error.kind(), io::ErrorKind::StorageFull),
            Self::Db(error) => sqlite_code(error) == Some(SQLITE_FULL),
            _ => false,
        }
    }

    /// Whether the reason is that the disk does not do what it should.
    pub fn is_disk_error(&self) -> bool {
        match self {
            Self::Io(error) => error.raw_os_error() == Some(rustix::io::Errno::IO.raw_os_error()),
            Self::Db(error) => sqlite_code(error) == Some(SQLITE_IOERR),
            _ => false,
        }
    }
}

/// Result codes of SQLite, without what its extended codes add.
const SQLITE_IOERR: u32 = 10;
const SQLITE_FULL: u32 = 13;

fn sqlite_code(error: &sqlx::Error) -> Option<u32> {
    let sqlx::Error::Database(error) = error else { return None };
    error.code()?.parse::<u32>().ok().map(|code| code & 0xff)
}

impl Store {
    /// Opens a data directory, alone.
    ///
    /// # Errors
    /// What the system or SQLite said; [`io::ErrorKind::WouldBlock`] when another process uses it.
    pub async fn open(root: &Path) -> Result<Self, StoreError> {
        let data = DataDir::open(root)?;
        let db = Db::open(&data.database()).await?;
        let group = GroupCommit::start(&db);
        Ok(Self {
            db,
            data,
            reservations: Reservations::default(),
            promised: Promised::default(),
            group,
            claims: Claims::default(),
            writable: Writable::default(),
            folders: Arc::default(),
            discarding: Mutex::default(),
        })
    }

    /// Removes the folders of deleted jobs and datasets. What can't be removed stays on the list for the next time and
    /// is told to the log: it costs space, no more. One after the other: at once, each would remove what is on the
    /// others' lists, and a folder could leave the list before whoever moved it away has made that durable.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn discard_deleted(&self) -> Result<(), StoreError> {
        let _alone = self.discarding.lock().await;
        if db::discards::is_held(self.db.reader(), db::now_ms()).await? {
            return Ok(());
        }
        let (data, mut deleted) = (self.data.clone(), db::discards::list(self.db.reader()).await?);
        let folders = Arc::clone(&self.folders);
        let removing = tokio::task::spawn_blocking(move || {
            deleted.retain(|folder| {
                let removed = folders.discard(&data, &data.root().join(folder));
                if let Err(error) = &removed {
                    tracing::warn!(folder, %error, "a deleted folder could not be removed");
                }
                removed.is_ok()
            });
            deleted
        });
        let removed = removing.await.map_err(io::Error::other)?;
        if removed.is_empty() {
            return Ok(());
        }
        let mut tx = self.db.write().await?;
        for folder in &removed {
            db::discards::remove(&mut tx, folder).await?;
        }
        Ok(tx.commit().await?)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[tokio::test]
    async fn deletions_at_once_do_not_repeat_each_other() {
        let root = tempfile::tempdir().unwrap();
        let store = Store::open(root.path()).await.unwrap();
        let mut tx = store.db.write().await.unwrap();
        for number in 0..6 {
            let folder = format!("datasets/{number}");
            std::fs::create_dir_all(root.path().join(&folder).join("images")).unwrap();
            sqlx::query("INSERT INTO discards (folder) VALUES (?)").bind(folder).execute(&mut *tx).await.unwrap();
        }
        tx.commit().await.unwrap();
        let writes = || store.db.write_figures().counts.iter().sum::<u64>();
        let before = writes();
        let (a, b, c) = tokio::join!(store.discard_deleted(), store.discard_deleted(), store.discard_deleted());
        assert!(a.is_ok() && b.is_ok() && c.is_ok());
        assert_eq!(std::fs::read_dir(root.path().join("datasets")).unwrap().count(), 0);
        assert_eq!(writes() - before, 1, "all leave the list together, once");
    }
}
