//! Photographs that come whole, with the request that makes their upload.
//!
//! Nothing of them is on the disk before, so it all happens in one go: one blocking call writes the bytes under a
//! temporary name, syncs them, gives them their name in the dataset and syncs the folder; then photograph and upload
//! are noted in one request to SQLite, committed together with those of other requests; then the sender is answered. A
//! crash in between leaves at most a file without a row, which nobody was told about.

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::db::dataset_images::DatasetImageRow;
use super::db::uploads::UploadRow;
use super::db::{now_ms, uploads};
use super::placing::{Moved, Note, check_place, image_row, move_error};
use super::resumable::upload_row;
use super::{ImagePath, NewUpload, Quantity, StagedFile, StagedWriter, Store, StoreError, UploadError, check_quota};

/// What became of the bytes.
enum Written {
    /// They are durable in their place.
    Placed(DatasetImageRow),
    /// Something lies there already, so they wait beside the dataset.
    Staged(StagedFile),
}

impl Store {
    /// Adds an upload whose bytes are all there, in `pieces`, as a photograph of its dataset; they are dropped as soon
    /// as they are written.
    ///
    /// # Errors
    /// [`UploadError::Conflict`], a dataset that takes nothing now, or what the store said; there is no upload then.
    pub async fn store_whole<P>(self: &Arc<Self>, new: NewUpload, pieces: Vec<P>) -> Result<UploadRow, UploadError>
    where
        P: AsRef<[u8]> + Send + 'static,
    {
        let (dataset, path) = new.target.clone().ok_or(UploadError::NotFound)?;
        let row = upload_row(&new);
        let length = pieces.iter().map(|piece| piece.as_ref().len()).sum::<usize>();
        let length = i64::try_from(length).unwrap_or(i64::MAX);
        let row = UploadRow { length: Some(length), offset: length, stored: true, ..row };
        let store = Arc::clone(self);
        // In a task of its own: between the file and its row nothing may be given up.
        let storing = tokio::spawn(async move {
            let _claim = store.claims.take(dataset, [path.as_str().to_owned()].into()).await;
            store.store_claimed(dataset, path, pieces, row).await
        });
        match storing.await.map_err(io::Error::other)? {
            Ok(row) => Ok(row),
            Err(StoreError::FileConflict(path)) => Err(UploadError::Conflict(path)),
            Err(error) => Err(error.into()),
        }
    }

    async fn store_claimed<P>(
        self: &Arc<Self>,
        dataset: Uuid,
        path: ImagePath,
        pieces: Vec<P>,
        row: UploadRow,
    ) -> Result<UploadRow, StoreError>
    where
        P: AsRef<[u8]> + Send + 'static,
    {
        // Nothing may appear, even for a moment, in the folder of a dataset that a job uses, nor a folder of none.
        self.writable.check(&self.db, dataset).await?;
        let target = self.data.images(dataset).join(path.as_str());
        let store = Arc::clone(self);
        let writing = tokio::task::spawn_blocking(move || {
            let mut moved = Moved::default();
            (store.write_whole(path, target, pieces, &mut moved), moved)
        });
        let (written, moved) = writing.await.map_err(io::Error::other)?;
        let noted = match written {
            Ok(Written::Staged(file)) => {
                self.place_claimed(dataset, vec![file], Some(Note::Insert(row.clone()))).await?;
                return Ok(row);
            }
            Ok(Written::Placed(image)) => {
                let rows = Arc::new((row.clone(), image));
                let noted = self.group.commit(move |tx| {
                    let rows = Arc::clone(&rows);
                    Box::pin(async move { insert(tx, &rows.0, &rows.1).await })
                });
                noted.await
            }
            Err(error) => Err(error),
        };
        match noted {
            Ok(()) => Ok(row),
            Err(error) => Err(self.withdraw(dataset, moved, error).await),
        }
    }

    /// Makes the pieces durable at `target` unless something lies there; notes in `moved` that they do. Blocking.
    fn write_whole(
        &self,
        path: ImagePath,
        target: PathBuf,
        pieces: Vec<impl AsRef<[u8]>>,
        moved: &mut Moved,
    ) -> Result<Written, StoreError> {
        let mut file = StagedWriter::create(&self.data.incoming())?;
        for piece in pieces {
            file.write(piece.as_ref())?;
        }
        let file = file.finish(path.clone())?;
        let image = image_row(&file);
        let folder = target.parent().unwrap_or(&target);
        let entered = self.folders.make(self.data.root(), folder).and_then(|()| file.move_if_free(&target));
        match entered.map_err(|error| move_error(error, &path))? {
            Some(file) => Ok(Written::Staged(file)),
            None => {
                moved.add(target);
                moved.sync()?;
                Ok(Written::Placed(image))
            }
        }
    }
}

async fn insert(tx: &mut SqliteConnection, upload: &UploadRow, image: &DatasetImageRow) -> Result<(), StoreError> {
    let place = check_place(uploads::insert_stored(tx, upload, image, now_ms()).await?)?;
    // The row of a file that was lost.
    if place.sha256.is_some_and(|there| there != image.sha256) {
        return Err(StoreError::FileConflict(image.path.clone()));
    }
    check_quota(tx, place.owner_token.as_deref(), &[Quantity::Bytes, Quantity::Images]).await
}
