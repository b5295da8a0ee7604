//! Staged photographs enter their dataset.
//!
//! They are renamed into its folder, and the folder synced, by their own request, side by side with others; then the rows are
//! committed, together with those of other requests, and then the request is answered. A crash in between leaves at most files
//! without rows, which nobody was told about; sending the same again mends that.

use std::collections::{BTreeMap, BTreeSet};
use std::io;
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::db::dataset_images::DatasetImageRow;
use super::db::uploads::UploadRow;
use super::db::{dataset_images, datasets, now_ms, uploads};
use super::{ImagePath, Quantity, StagedFile, Store, StoreError, atomic, check_quota};

/// What became of a batch.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Committed {
    /// Photographs that are new.
    pub stored: usize,
    /// Photographs that were there before with the same bytes.
    pub unchanged: usize,
}

/// What is noted of the upload that a photograph came by.
#[derive(Clone, Debug)]
pub(super) enum Note {
    /// A row that is there changes.
    Update(UploadRow),
    /// A new one.
    Insert(UploadRow),
}

impl Note {
    async fn write(&self, tx: &mut SqliteConnection) -> sqlx::Result<()> {
        match self {
            Self::Update(row) => uploads::update(tx, row).await,
            Self::Insert(row) => uploads::insert(tx, row).await,
        }
    }
}

/// Staged files, compared with what is stored.
#[derive(Default)]
struct Sorted {
    new: Vec<StagedFile>,
    unchanged: usize,
    /// The first path that is stored with other bytes; what came after it is left out.
    conflict: Option<ImagePath>,
}

impl Store {
    /// Puts staged files into a dataset, durably, also when whoever asked leaves meanwhile. Stops at a path that is
    /// stored with other bytes; what came before it stays.
    ///
    /// # Errors
    /// [`StoreError::FileConflict`], [`StoreError::DatasetInUse`] while a job on it is queued or running,
    /// [`StoreError::NotFound`] without such a dataset, or what the system or SQLite said.
    pub async fn commit_images(
        self: &Arc<Self>,
        dataset: Uuid,
        files: Vec<StagedFile>,
    ) -> Result<Committed, StoreError> {
        self.place(dataset, files, None).await
    }

    /// The same for the file of a resumable upload, whose row is written with it.
    pub(super) async fn place_upload(
        self: &Arc<Self>,
        dataset: Uuid,
        file: StagedFile,
        row: UploadRow,
    ) -> Result<(), StoreError> {
        self.place(dataset, vec![file], Some(Note::Update(row))).await.map(|_| ())
    }

    async fn place(
        self: &Arc<Self>,
        dataset: Uuid,
        files: Vec<StagedFile>,
        upload: Option<Note>,
    ) -> Result<Committed, StoreError> {
        let store = Arc::clone(self);
        // In a task of its own: between the file and its row nothing may be given up.
        let placing = tokio::spawn(async move {
            let paths: BTreeSet<String> = files.iter().map(|file| file.path.as_str().to_owned()).collect();
            let _claim = store.claims.take(dataset, paths).await;
            store.place_claimed(dataset, files, upload).await
        });
        placing.await.map_err(io::Error::other)?
    }

    /// The same for whoever has the claim on the paths.
    pub(super) async fn place_claimed(
        &self,
        dataset: Uuid,
        files: Vec<StagedFile>,
        upload: Option<Note>,
    ) -> Result<Committed, StoreError> {
        let sorted = self.sort(dataset, files).await?;
        let committed = Committed { stored: sorted.new.len(), unchanged: sorted.unchanged };
        // What an upload stands for is one file: without it there is nothing to note.
        if committed.stored > 0 || (upload.is_some() && sorted.conflict.is_none()) {
            self.place_new(dataset, sorted.new, upload).await?;
        }
        match sorted.conflict {
            Some(path) => Err(StoreError::FileConflict(path.to_string())),
            None => Ok(committed),
        }
    }

    async fn sort(&self, dataset: Uuid, files: Vec<StagedFile>) -> Result<Sorted, StoreError> {
        let mut reader = self.db.reader().acquire().await?;
        let mut sorted = Sorted::default();
        let mut known = BTreeMap::<String, String>::new();
        for file in files {
            let path = file.path.as_str();
            if !known.contains_key(path)
                && let Some(there) = find_place(&mut reader, dataset, path).await?.sha256
            {
                known.insert(path.to_owned(), there);
            }
            match known.get(path) {
                Some(there) if *there == file.sha256 => sorted.unchanged += 1,
                Some(_) => {
                    sorted.conflict = Some(file.path);
                    break;
                }
                None => {
                    known.insert(path.to_owned(), file.sha256.clone());
                    sorted.new.push(file);
                }
            }
        }
        Ok(sorted)
    }

    async fn place_new(&self, dataset: Uuid, files: Vec<StagedFile>, upload: Option<Note>) -> Result<(), StoreError> {
        let rows: Vec<DatasetImageRow> = files.iter().map(image_row).collect();
        let (root, folder, folders) =
            (self.data.root().to_path_buf(), self.data.images(dataset), Arc::clone(&self.folders));
        let make = move |parent: &Path| folders.make(&root, parent);
        let moving = tokio::task::spawn_blocking(move || {
            let (moved, failure) = Moved::into(&folder, make, files);
            let failure = failure.or_else(|| moved.sync().err().map(StoreError::Io));
            (moved, failure)
        });
        let (moved, failure) = moving.await.map_err(io::Error::other)?;
        let written = match failure {
            Some(error) => Err(error),
            None => {
                let write = Arc::new((rows, upload));
                let written = self.group.commit(move |tx| {
                    let write = Arc::clone(&write);
                    Box::pin(async move { insert(tx, dataset, &write.0, write.1.as_ref()).await })
                });
                written.await
            }
        };
        if let Err(error) = written {
            return Err(self.withdraw(dataset, moved, error).await);
        }
        Ok(())
    }

    /// Removes files that got no row; gives the reason that counts.
    pub(super) async fn withdraw(&self, dataset: Uuid, moved: Moved, error: StoreError) -> StoreError {
        // A folder that went with its dataset is no failure of the disk, and must not come back with a file in it.
        let is_gone = matches!(datasets::in_use(self.db.reader(), dataset).await, Ok(None));
        let (data, folder, folders) = (self.data.clone(), self.data.dataset(dataset), Arc::clone(&self.folders));
        let removed = tokio::task::spawn_blocking(move || {
            if is_gone {
                return folders.discard(&data, &folder);
            }
            moved.files.iter().try_for_each(std::fs::remove_file)
        });
        if let Err(error) = removed.await.map_err(io::Error::other).and_then(|removed| removed) {
            tracing::warn!(%dataset, %error, "files that were not taken stay until they are sent again");
        }
        if is_gone { StoreError::NotFound } else { error }
    }
}

/// A path of a dataset; fails unless photographs may be added there now.
pub(super) async fn find_place(
    db: &mut SqliteConnection,
    dataset: Uuid,
    path: &str,
) -> Result<datasets::PlaceRow, StoreError> {
    check_place(datasets::place(db, dataset, path).await?)
}

/// The same for what the database said of the path.
pub(super) fn check_place(place: Option<datasets::PlaceRow>) -> Result<datasets::PlaceRow, StoreError> {
    match place {
        None => Err(StoreError::NotFound),
        Some(place) if place.in_use => Err(StoreError::DatasetInUse),
        Some(place) => Ok(place),
    }
}

pub(super) async fn check_writable(db: &mut SqliteConnection, dataset: Uuid) -> Result<(), StoreError> {
    match datasets::in_use(db, dataset).await? {
        None => Err(StoreError::NotFound),
        Some(true) => Err(StoreError::DatasetInUse),
        Some(false) => Ok(()),
    }
}

pub(super) fn image_row(file: &StagedFile) -> DatasetImageRow {
    DatasetImageRow {
        path: file.path.as_str().to_owned(),
        size_bytes: i64::try_from(file.size_bytes).unwrap_or(i64::MAX),
        sha256: file.sha256.clone(),
    }
}

async fn insert(
    tx: &mut SqliteConnection,
    dataset: Uuid,
    rows: &[DatasetImageRow],
    upload: Option<&Note>,
) -> Result<(), StoreError> {
    check_writable(tx, dataset).await?;
    if let Some(upload) = upload {
        // Before the quota is asked, so that nothing counts twice.
        upload.write(tx).await?;
    }
    if rows.is_empty() {
        return Ok(());
    }
    for row in rows {
        dataset_images::insert(tx, dataset, row).await?;
    }
    let owner = datasets::touch(tx, dataset, now_ms()).await?;
    check_quota(tx, owner.as_deref(), &[Quantity::Bytes, Quantity::Images]).await
}

/// Why a file could not be moved to its place.
pub(super) fn move_error(error: io::Error, path: &ImagePath) -> StoreError {
    match error.kind() {
        // One name is a folder of the other: `a.jpg` and `a.jpg/b.jpg` can't both be stored.
        io::ErrorKind::NotADirectory
        | io::ErrorKind::IsADirectory
        | io::ErrorKind::AlreadyExists
        | io::ErrorKind::DirectoryNotEmpty => StoreError::FileConflict(path.to_string()),
        _ => StoreError::Io(error),
    }
}

/// Files that are in their places.
#[derive(Debug, Default)]
pub(super) struct Moved {
    files: Vec<PathBuf>,
}

impl Moved {
    /// Renames staged files to their places below `folder`, whose folders `make` makes, as far as that goes. Blocking.
    fn into(
        folder: &Path,
        make: impl Fn(&Path) -> io::Result<()>,
        files: Vec<StagedFile>,
    ) -> (Self, Option<StoreError>) {
        let mut moved = Self::default();
        for file in files {
            let path = file.path.clone();
            let target = folder.join(path.as_str());
            let parent = target.parent().unwrap_or(folder);
            match make(parent).and_then(|()| file.move_to(&target)) {
                Ok(()) => moved.add(target),
                Err(error) => return (moved, Some(move_error(error, &path))),
            }
        }
        (moved, None)
    }

    /// Adds one that was moved just now.
    pub(super) fn add(&mut self, file: PathBuf) {
        self.files.push(file);
    }

    /// Makes their names durable. Blocking.
    pub(super) fn sync(&self) -> io::Result<()> {
        let folders: BTreeSet<&Path> = self.files.iter().filter_map(|file| file.parent()).collect();
        folders.into_iter().try_for_each(|folder| match atomic::sync_dir(folder) {
            // Deleted meanwhile, with its dataset: whoever writes the rows will see.
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            other => other,
        })
    }
}
