//! Photographs on their way into a dataset.
//!
//! A photograph is first *staged*: written under a temporary name outside the dataset, hashed while it is written, and synced.
//! Then a batch of staged files is *committed*: renamed into the dataset's folder, the folders synced, the rows committed. A
//! crash before the commit leaves at most files without rows, which nobody was told about; sending the same again mends that.

use std::collections::BTreeSet;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use sqlx::SqliteConnection;
use tempfile::{NamedTempFile, TempPath};
use uuid::Uuid;

use super::db::dataset_images::DatasetImageRow;
use super::db::tokens::{self, Owned};
use super::db::{dataset_images, datasets, jobs, now_ms};
use super::{ImagePath, Quantity, Store, StoreError, atomic, check_quota};

/// A file that is being staged. Blocking: use it off the async threads.
pub struct StagedWriter {
    file: NamedTempFile,
    hash: Sha256,
    size_bytes: u64,
}

/// A file whose bytes are durable, but which belongs to no dataset yet; deleted when dropped.
#[derive(Debug)]
pub struct StagedFile {
    /// Where it will go.
    pub path: ImagePath,
    /// Its length.
    pub size_bytes: u64,
    /// Of its bytes, in hexadecimal.
    pub sha256: String,
    file: TempPath,
}

impl StagedWriter {
    /// Starts a file in `scratch`, which lies on the file system of the datasets.
    ///
    /// # Errors
    /// What the system said.
    pub fn create(scratch: &Path) -> io::Result<Self> {
        Ok(Self { file: atomic::temporary_in(scratch)?, hash: Sha256::new(), size_bytes: 0 })
    }

    /// Appends bytes.
    ///
    /// # Errors
    /// What the system said.
    pub fn write(&mut self, bytes: &[u8]) -> io::Result<()> {
        // Not through the temporary file itself, which hides the system's error in one of its own.
        self.file.as_file_mut().write_all(bytes)?;
        self.hash.update(bytes);
        self.size_bytes += bytes.len() as u64;
        Ok(())
    }

    /// Bytes written so far.
    pub fn size_bytes(&self) -> u64 {
        self.size_bytes
    }

    /// Makes the bytes durable.
    ///
    /// # Errors
    /// What the system said.
    pub fn finish(self, path: ImagePath) -> io::Result<StagedFile> {
        self.file.as_file().sync_all()?;
        let sha256 = hex(&self.hash.finalize());
        Ok(StagedFile { path, size_bytes: self.size_bytes, sha256, file: self.file.into_temp_path() })
    }
}

/// Bytes in hexadecimal.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl StagedFile {
    /// Stages a durable file of this file system under a second name; its first name stays.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn link(
        file: &Path,
        scratch: &Path,
        path: ImagePath,
        size_bytes: u64,
        sha256: String,
    ) -> io::Result<Self> {
        let link = scratch.join(format!(".part-{}", Uuid::now_v7()));
        std::fs::hard_link(file, &link)?;
        Ok(Self { path, size_bytes, sha256, file: TempPath::try_from_path(link)? })
    }

    /// Where its bytes lie now.
    pub fn staged_at(&self) -> &Path {
        &self.file
    }
}

/// What became of a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Committed {
    /// Photographs that are new.
    pub stored: usize,
    /// Photographs that were there before with the same bytes.
    pub unchanged: usize,
}

impl Store {
    /// Puts staged files into a dataset, durably. Stops at a path that is stored with other bytes; what came before it stays.
    ///
    /// # Errors
    /// [`StoreError::FileConflict`], [`StoreError::DatasetInUse`] while a job on it is queued or running,
    /// [`StoreError::NotFound`] without such a dataset, or what the system or SQLite said.
    pub async fn commit_images(&self, dataset: Uuid, files: Vec<StagedFile>) -> Result<Committed, StoreError> {
        let mut tx = self.db.write().await?;
        let (committed, conflict) = self.place_images(&mut tx, dataset, files).await?;
        tx.commit().await?;
        match conflict {
            Some(path) => Err(StoreError::FileConflict(path.to_string())),
            None => Ok(committed),
        }
    }

    /// Renames staged files into a dataset and writes their rows, as a part of a transaction. Stops at a path that is stored with
    /// other bytes, and gives it.
    pub(super) async fn place_images(
        &self,
        tx: &mut SqliteConnection,
        dataset: Uuid,
        files: Vec<StagedFile>,
    ) -> Result<(Committed, Option<ImagePath>), StoreError> {
        self.check_writable(tx, dataset).await?;
        let mut committed = Committed::default();
        let mut conflict = None;
        let mut new = Vec::new();
        for file in files {
            match dataset_images::find(&mut *tx, dataset, file.path.as_str()).await? {
                Some(there) if there.sha256 == file.sha256 => committed.unchanged += 1,
                Some(_) => {
                    conflict = Some(file.path);
                    break;
                }
                None => {
                    let row = DatasetImageRow {
                        path: file.path.as_str().to_owned(),
                        size_bytes: i64::try_from(file.size_bytes).unwrap_or(i64::MAX),
                        sha256: file.sha256.clone(),
                    };
                    dataset_images::insert(tx, dataset, &row).await?;
                    committed.stored += 1;
                    new.push(file);
                }
            }
        }
        if committed.stored > 0 {
            datasets::touch(tx, dataset, now_ms()).await?;
            let owner = tokens::owner(&mut *tx, Owned::Dataset(dataset)).await?.flatten();
            check_quota(tx, owner.as_deref(), &[Quantity::Bytes, Quantity::Images]).await?;
        }
        let folder = self.data.images(dataset);
        let root = self.data.root().to_path_buf();
        tokio::task::spawn_blocking(move || move_into(&root, &folder, new)).await.map_err(io::Error::other)??;
        Ok((committed, conflict))
    }

    /// Fails unless photographs may be added to a dataset now.
    pub(super) async fn check_writable(&self, tx: &mut SqliteConnection, dataset: Uuid) -> Result<(), StoreError> {
        if datasets::find(&mut *tx, dataset).await?.is_none() {
            return Err(StoreError::NotFound);
        }
        if jobs::use_of_dataset(tx, dataset).await?.1 {
            return Err(StoreError::DatasetInUse);
        }
        Ok(())
    }
}

/// Renames staged files to their places below `folder` and syncs every folder touched.
fn move_into(root: &Path, folder: &Path, files: Vec<StagedFile>) -> Result<(), StoreError> {
    let mut touched = BTreeSet::<PathBuf>::new();
    for file in files {
        let target = folder.join(file.path.as_str());
        let parent = target.parent().unwrap_or(folder);
        let moved = atomic::create_dirs(root, parent).and_then(|()| file.file.persist(&target).map_err(|e| e.error));
        moved.map_err(|error| match error.kind() {
            // One name is a folder of the other: `a.jpg` and `a.jpg/b.jpg` can't both be stored.
            io::ErrorKind::NotADirectory
            | io::ErrorKind::IsADirectory
            | io::ErrorKind::AlreadyExists
            | io::ErrorKind::DirectoryNotEmpty => StoreError::FileConflict(file.path.to_string()),
            _ => StoreError::Io(error),
        })?;
        touched.insert(parent.to_path_buf());
    }
    for folder in touched {
        atomic::sync_dir(&folder)?;
    }
    Ok(())
}
