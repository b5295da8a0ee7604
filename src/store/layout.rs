//! Where things lie in the data directory, and the lock that keeps it to one process.
//!
//! ```text
//! lock                       held by the process that uses the directory
//! multistage.db              SQLite (with -wal and -shm beside it)
//! datasets/<id>/             one dataset:
//!     images/...             photographs under the names they came with
//!     work/...               artifacts of runs, to go on from, also with other options
//! jobs/<id>/partial/...      outputs while a run writes them
//! jobs/<id>/out/...          published outputs
//! jobs/<id>/thumbnails/...   made on demand
//! uploads/<id>               bytes of a resumable upload
//! incoming/...               other uploads on their way; emptied at start
//! quarantine/...             what belonged to nobody; goes after a week
//! ballast                    given up when the disk is full, so that deleting can be written down
//! trash/...                  folders being deleted; emptied at start
//! ```

use std::fs::{File, TryLockError};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use uuid::Uuid;

use super::atomic;

/// A data directory, locked for this process until the last copy is dropped.
#[derive(Clone, Debug)]
pub struct DataDir {
    root: PathBuf,
    /// Held for its lock alone.
    _lock: Arc<File>,
}

/// A folder for what is on its way in; goes with all it holds when dropped.
#[derive(Debug)]
pub struct ScratchDir(PathBuf);

impl ScratchDir {
    /// Where it is.
    pub fn path(&self) -> &Path {
        &self.0
    }
}

impl Drop for ScratchDir {
    fn drop(&mut self) {
        if let Err(error) = std::fs::remove_dir_all(&self.0) {
            tracing::warn!(folder = %self.0.display(), %error, "an upload's folder stays until the next start");
        }
    }
}

impl DataDir {
    /// Makes the directory where needed and locks it.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] when another process uses it, else what the system said.
    pub fn open(root: &Path) -> io::Result<Self> {
        std::fs::create_dir_all(root)?;
        let root = root.canonicalize()?;
        let lock = File::options().create(true).truncate(false).write(true).open(root.join("lock"))?;
        match lock.try_lock() {
            Ok(()) => {}
            Err(TryLockError::WouldBlock) => {
                let message = format!("{} is in use by another process", root.display());
                return Err(io::Error::new(io::ErrorKind::WouldBlock, message));
            }
            Err(TryLockError::Error(error)) => return Err(error),
        }
        for folder in ["datasets", "jobs", "uploads"] {
            std::fs::create_dir_all(root.join(folder))?;
        }
        for folder in ["incoming", "trash"] {
            atomic::empty_dir(&root.join(folder))?;
        }
        atomic::sync_dir(&root)?;
        Ok(Self { root, _lock: Arc::new(lock) })
    }

    /// The directory itself.
    pub fn root(&self) -> &Path {
        &self.root
    }

    pub(crate) fn database(&self) -> PathBuf {
        Self::database_in(&self.root)
    }

    /// The database of a data directory that may be another process's.
    pub fn database_in(root: &Path) -> PathBuf {
        root.join("multistage.db")
    }

    pub(crate) fn dataset(&self, dataset: Uuid) -> PathBuf {
        self.root.join("datasets").join(dataset.to_string())
    }

    /// The photographs of a dataset.
    pub fn images(&self, dataset: Uuid) -> PathBuf {
        self.dataset(dataset).join("images")
    }

    pub(crate) fn job(&self, job: Uuid) -> PathBuf {
        self.root.join("jobs").join(job.to_string())
    }

    /// The artifacts of all runs on a dataset.
    pub fn work(&self, dataset: Uuid) -> PathBuf {
        self.dataset(dataset).join("work")
    }

    /// The outputs of a job while the run writes them.
    pub fn partial(&self, job: Uuid) -> PathBuf {
        self.job(job).join("partial")
    }

    /// The published outputs of a job.
    pub fn out(&self, job: Uuid) -> PathBuf {
        self.job(job).join("out")
    }

    /// The thumbnails of a job's photographs.
    pub fn thumbnails(&self, job: Uuid) -> PathBuf {
        self.job(job).join("thumbnails")
    }

    pub(crate) fn uploads(&self) -> PathBuf {
        self.root.join("uploads")
    }

    /// The bytes of a resumable upload.
    pub(crate) fn upload(&self, upload: Uuid) -> PathBuf {
        self.uploads().join(upload.to_string())
    }

    pub(crate) fn incoming(&self) -> PathBuf {
        self.root.join("incoming")
    }

    /// A new folder for what is on its way in.
    ///
    /// # Errors
    /// What the system said.
    pub fn scratch(&self) -> io::Result<ScratchDir> {
        let folder = self.incoming().join(Uuid::now_v7().to_string());
        std::fs::create_dir(&folder)?;
        Ok(ScratchDir(folder))
    }

    /// What the files below a folder take; a missing one takes nothing.
    ///
    /// # Errors
    /// What the system said.
    pub fn folder_bytes(folder: &Path) -> io::Result<u64> {
        let sizes = atomic::list_files(folder)?.into_iter().map(|path| Ok(folder.join(path).metadata()?.len()));
        sizes.sum()
    }

    /// Deletes a folder so that it is gone at once, whatever happens while its content is removed; a missing one is no error.
    pub(crate) fn discard(&self, folder: &Path) -> io::Result<()> {
        let grave = self.root.join("trash").join(Uuid::now_v7().to_string());
        match std::fs::rename(folder, &grave) {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(()),
            Err(error) => return Err(error),
        }
        match atomic::sync_parent(folder) {
            // Somebody deletes the parent as well.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            other => other?,
        }
        std::fs::remove_dir_all(&grave)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_directory_serves_one_process_and_forgets_half_uploads() {
        let folder = tempfile::tempdir().unwrap();
        let data = DataDir::open(folder.path()).unwrap();
        assert_eq!(DataDir::open(folder.path()).unwrap_err().kind(), io::ErrorKind::WouldBlock);
        std::fs::write(data.incoming().join("half"), b"x").unwrap();
        let job = data.job(Uuid::nil());
        std::fs::create_dir_all(job.join("work")).unwrap();
        data.discard(&job).unwrap();
        data.discard(&job).unwrap();
        assert!(!job.exists());
        drop(data);
        let data = DataDir::open(folder.path()).unwrap();
        assert!(!data.incoming().join("half").exists());
    }
}
