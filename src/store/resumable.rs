//! Uploads that go on where they broke off, whatever protocol brings the bytes.
//!
//! The bytes lie in one file an upload; its row counts those that are durable. Bytes behind that count were never acknowledged
//! and are written over. A complete upload enters its dataset like any other photograph, in the transaction that marks it
//! stored; until then its own file stays, so a failure in between costs nothing but another try.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

use sha2::{Digest, Sha256};
use sqlx::SqliteConnection;
use uuid::Uuid;

use super::db::uploads::UploadRow;
use super::db::{now_ms, uploads};
use super::incoming::{StagedFile, hex};
use super::placing::find_place;
use super::{ImagePath, Quantity, Store, StoreError, atomic, check_quota};

/// Bytes copied at a time.
const CHUNK_BYTES: usize = 1 << 20;

/// What an upload is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum UploadKind {
    /// A photograph.
    Whole,
    /// A part of one that is put together later.
    Partial,
    /// A photograph put together from parts.
    Final,
}

impl UploadKind {
    /// The name in the database.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Whole => "whole",
            Self::Partial => "partial",
            Self::Final => "final",
        }
    }
}

/// What a new upload is made of.
#[derive(Clone, Debug)]
pub struct NewUpload {
    /// What it is for.
    pub kind: UploadKind,
    /// Its bytes in the end, where known.
    pub length: Option<u64>,
    /// Headers of the sender, kept to be told again.
    pub metadata: String,
    /// Likewise.
    pub concat: Option<String>,
    /// The dataset and the path there; none for a partial one.
    pub target: Option<(Uuid, ImagePath)>,
    /// Until when it is kept without a further byte.
    pub expires_ms: i64,
    /// Whose it is.
    pub owner_token: Option<Uuid>,
}

/// Why an upload was refused.
#[derive(Debug, thiserror::Error)]
pub enum UploadError {
    /// There is no such upload.
    #[error("there is no such upload")]
    NotFound,
    /// Its time is over.
    #[error("the upload has expired")]
    Expired,
    /// As [`StoreError::FileConflict`].
    #[error("something else is stored already at {0:?} or at one of its folders")]
    Conflict(String),
    /// Something to be put together is no complete partial upload.
    #[error("{0} is no complete partial upload")]
    NotAPart(Uuid),
    /// The parts add up to more than is taken.
    #[error("the parts add up to more than {0} bytes")]
    TooLong(u64),
    /// What the store said.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<sqlx::Error> for UploadError {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}

impl From<io::Error> for UploadError {
    fn from(error: io::Error) -> Self {
        Self::Store(error.into())
    }
}

impl Store {
    /// Adds an upload without bytes.
    ///
    /// # Errors
    /// A dataset that takes nothing now, a path stored with another length, or what the store said.
    pub async fn create_upload(&self, new: NewUpload) -> Result<UploadRow, UploadError> {
        let new = Arc::new(new);
        let created = self.group.commit(move |tx| {
            let new = Arc::clone(&new);
            Box::pin(async move { insert_upload(tx, &new).await })
        });
        let row = created.await?;
        self.promised.grew();
        Ok(row)
    }

    /// Adds an upload whose bytes are those of `parts`, in order; the parts stay.
    ///
    /// # Errors
    /// Parts that can't be used, or as [`Self::create_upload`].
    pub async fn concatenate_uploads(
        &self,
        mut new: NewUpload,
        parts: Vec<Uuid>,
        max_bytes: u64,
    ) -> Result<UploadRow, UploadError> {
        let mut tx = self.db.write().await?;
        let mut length = 0u64;
        for id in &parts {
            let part = uploads::find(&mut *tx, *id).await?.ok_or(UploadError::NotAPart(*id))?;
            if part.kind != UploadKind::Partial.as_str() || part.length != Some(part.offset) {
                return Err(UploadError::NotAPart(*id));
            }
            length = length.saturating_add(to_u64(part.offset));
        }
        if length > max_bytes {
            return Err(UploadError::TooLong(max_bytes));
        }
        new.length = Some(length);
        let mut row = insert_upload(&mut tx, &new).await?;
        tx.commit().await?;
        self.promised.grew();
        let id = upload_id(&row)?;
        let (target, sources) = (self.data.upload(id), parts.iter().map(|part| self.data.upload(*part)));
        let sources: Vec<PathBuf> = sources.collect();
        let copied =
            tokio::task::spawn_blocking(move || copy_parts(&target, &sources)).await.map_err(io::Error::other)?;
        match copied {
            Ok(copied) if copied == length => {
                row.offset = to_i64(length);
                self.save_upload(&row, false).await?;
                Ok(row)
            }
            other => {
                self.remove_upload(id).await?;
                Err(other.err().unwrap_or_else(|| io::ErrorKind::UnexpectedEof.into()).into())
            }
        }
    }

    /// An upload whose time is not over.
    ///
    /// # Errors
    /// [`UploadError::NotFound`], [`UploadError::Expired`], or what the store said.
    pub async fn find_upload(&self, id: Uuid) -> Result<UploadRow, UploadError> {
        let row = uploads::find(self.db.reader(), id).await?.ok_or(UploadError::NotFound)?;
        if row.expires_ms <= now_ms() { Err(UploadError::Expired) } else { Ok(row) }
    }

    /// Writes the row of an upload, whose bytes are durable; with `is_new`, the entry of its file is made durable before.
    ///
    /// # Errors
    /// What the system or SQLite said.
    pub async fn save_upload(&self, row: &UploadRow, is_new: bool) -> Result<(), StoreError> {
        if is_new {
            let uploads = self.data.uploads();
            tokio::task::spawn_blocking(move || atomic::sync_dir(&uploads)).await.map_err(io::Error::other)??;
        }
        let row = Arc::new(row.clone());
        let saved = self.group.commit(move |tx| {
            let row = Arc::clone(&row);
            Box::pin(async move { Ok::<_, StoreError>(uploads::update(tx, &row).await?) })
        });
        saved.await?;
        // Its length may have been told just now.
        self.promised.grew();
        Ok(())
    }

    /// Puts a complete upload, whose bytes are durable, into its dataset and writes its row. Where the caller does not
    /// know the SHA-256 of its bytes, they are read. Asking again is no error; for a partial or incomplete one nothing
    /// happens.
    ///
    /// # Errors
    /// [`UploadError::Conflict`], after which the upload is gone; a dataset that takes nothing now; what the store said.
    pub async fn store_upload(
        self: &Arc<Self>,
        row: &mut UploadRow,
        sha256: Option<[u8; 32]>,
    ) -> Result<(), UploadError> {
        let (Some(dataset), Some(path)) = (&row.dataset_id, &row.path) else { return Ok(()) };
        if row.stored || row.length != Some(row.offset) {
            return Ok(());
        }
        let dataset: Uuid = dataset.parse().map_err(|_| UploadError::NotFound)?;
        let path = ImagePath::parse(path).map_err(|error| io::Error::new(io::ErrorKind::InvalidData, error))?;
        let id = upload_id(row)?;
        let (file, size_bytes) = (self.data.upload(id), to_u64(row.offset));
        let sha256 = match sha256 {
            Some(sha256) => sha256,
            None => {
                let file = file.clone();
                let hashing = tokio::task::spawn_blocking(move || hash_upload(&file, size_bytes));
                hashing.await.map_err(io::Error::other)??
            }
        };
        let staged = StagedFile::kept(file, self.data.incoming(), path, size_bytes, hex(&sha256));
        let stored = UploadRow { stored: true, ..row.clone() };
        match self.place_upload(dataset, staged, stored).await {
            Ok(()) => {}
            // A sender who asks for the state of a refused upload must not learn that all its bytes came, so it goes.
            Err(StoreError::FileConflict(path)) => {
                self.remove_upload(id).await?;
                return Err(UploadError::Conflict(path));
            }
            Err(error) => return Err(error.into()),
        }
        row.stored = true;
        // Nobody need wait for that.
        let store = Arc::clone(self);
        tokio::spawn(async move { store.forget_file(id).await });
        Ok(())
    }

    /// Removes an upload; whether it was there.
    ///
    /// # Errors
    /// What the store said.
    pub async fn remove_upload(&self, id: Uuid) -> Result<bool, StoreError> {
        let mut tx = self.db.write().await?;
        let removed = uploads::delete(&mut tx, id).await?;
        tx.commit().await?;
        self.forget_file(id).await;
        Ok(removed)
    }

    /// Removes uploads whose time is over, and files that serve none; gives the number of the former.
    ///
    /// # Errors
    /// What the store said.
    pub async fn sweep_uploads(&self) -> Result<usize, StoreError> {
        // Listed first: a file that comes later belongs to a row that is there by then.
        let files: Vec<Uuid> =
            atomic::list_files(&self.data.uploads())?.iter().filter_map(|name| name.parse().ok()).collect();
        let expired: Vec<Uuid> =
            uploads::expired(self.db.reader(), now_ms()).await?.iter().filter_map(|id| id.parse().ok()).collect();
        for id in &expired {
            self.remove_upload(*id).await?;
        }
        let known: std::collections::BTreeSet<Uuid> =
            uploads::with_file(self.db.reader()).await?.iter().filter_map(|id| id.parse().ok()).collect();
        for id in files.into_iter().filter(|id| !known.contains(id)) {
            self.forget_file(id).await;
        }
        Ok(expired.len())
    }

    /// Failing costs space, no more; the next sweep tries again.
    async fn forget_file(&self, id: Uuid) {
        match tokio::fs::remove_file(self.data.upload(id)).await {
            Ok(()) => {}
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => tracing::warn!(upload = %id, %error, "the file of an upload could not be removed"),
        }
    }
}

async fn insert_upload(tx: &mut SqliteConnection, new: &NewUpload) -> Result<UploadRow, UploadError> {
    if let Some((dataset, path)) = &new.target {
        let stored_bytes = find_place(tx, *dataset, path.as_str()).await?.size_bytes;
        if stored_bytes.zip(new.length).is_some_and(|(stored, length)| i64::try_from(length) != Ok(stored)) {
            return Err(UploadError::Conflict(path.to_string()));
        }
    }
    let row = upload_row(new);
    uploads::insert(tx, &row).await?;
    check_quota(tx, row.owner_token.as_deref(), &[Quantity::Bytes, Quantity::Images]).await?;
    Ok(row)
}

/// The row of a new upload without bytes.
pub(super) fn upload_row(new: &NewUpload) -> UploadRow {
    UploadRow {
        id: Uuid::now_v7().to_string(),
        created_ms: now_ms(),
        expires_ms: new.expires_ms,
        kind: new.kind.as_str().to_owned(),
        length: new.length.map(to_i64),
        offset: 0,
        metadata: new.metadata.clone(),
        concat: new.concat.clone(),
        dataset_id: new.target.as_ref().map(|(dataset, _)| dataset.to_string()),
        path: new.target.as_ref().map(|(_, path)| path.to_string()),
        stored: false,
        owner_token: new.owner_token.map(|token| token.to_string()),
    }
}

/// The id of a row, which was written from one.
pub(crate) fn upload_id(row: &UploadRow) -> Result<Uuid, StoreError> {
    row.id.parse().map_err(|_| sqlx::Error::Decode(format!("{:?} is no id", row.id).into()).into())
}

fn to_i64(bytes: u64) -> i64 {
    i64::try_from(bytes).unwrap_or(i64::MAX)
}

fn to_u64(bytes: i64) -> u64 {
    u64::try_from(bytes).unwrap_or(0)
}

fn hash_upload(file: &Path, size_bytes: u64) -> io::Result<[u8; 32]> {
    let mut hash = Sha256::new();
    // An upload of nothing never had a file.
    let source = File::options().read(true).write(true).create(size_bytes == 0).truncate(false).open(file)?;
    let mut reader = io::BufReader::with_capacity(CHUNK_BYTES, &source);
    if io::copy(&mut reader, &mut HashWriter(&mut hash))? != size_bytes {
        return Err(io::Error::new(io::ErrorKind::UnexpectedEof, "an upload's file lost bytes"));
    }
    if size_bytes == 0 {
        source.sync_all()?;
    }
    Ok(hash.finalize().into())
}

/// Feeds what is written into a hash.
pub(super) struct HashWriter<'a>(pub(super) &'a mut Sha256);

impl Write for HashWriter<'_> {
    fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
        self.0.update(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> io::Result<()> {
        Ok(())
    }
}

/// Writes the bytes of all parts into one durable file.
fn copy_parts(target: &Path, parts: &[PathBuf]) -> io::Result<u64> {
    let mut file = File::create(target)?;
    let mut length = 0;
    for part in parts {
        match File::open(part) {
            Ok(mut part) => length += io::copy(&mut part, &mut file)?,
            // A part of no bytes never had a file.
            Err(error) if error.kind() == io::ErrorKind::NotFound => {}
            Err(error) => return Err(error),
        }
    }
    file.sync_all()?;
    atomic::sync_parent(target)?;
    Ok(length)
}
