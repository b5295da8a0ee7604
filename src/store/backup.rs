//! A copy of a data directory whose service may run.
//!
//! First the database as it is at one moment, then the files it speaks of, which never change under their names. The
//! service leaves the files of what is deleted meanwhile in place. When one is gone all the same, as that of an upload
//! that was completed, the copy starts over with a new moment, and takes what it has copied already. Results of stages
//! are left out: they can be computed again.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;
use std::time::Duration;

use uuid::Uuid;

use super::db::inventory::{self, Inventory};
use super::db::{Db, discards, now_ms};
use super::{DataDir, StoreError, atomic};

/// Moments that are tried.
const ATTEMPTS: usize = 5;

/// A copy that dies holds up the removal of deleted files no longer.
const HELD: Duration = Duration::from_secs(6 * 3600);

/// What was copied.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BackedUp {
    /// Files besides the database.
    pub files: usize,
    /// Their bytes.
    pub bytes: u64,
}

/// Copies the data directory `root` to `target`, which may hold an earlier copy. The result is a data directory itself.
///
/// # Errors
/// What the system or SQLite said; [`io::ErrorKind::NotFound`] when files are missing that nobody deleted.
pub async fn back_up(db: &Db, root: &Path, target: &Path) -> Result<BackedUp, StoreError> {
    std::fs::create_dir_all(target)?;
    let id = Uuid::now_v7();
    let copied = attempt(db, root, target, id).await;
    let mut tx = db.write().await?;
    discards::release(&mut tx, id).await?;
    tx.commit().await?;
    copied
}

/// Keeps deleted files in place for a while.
async fn hold(db: &Db, id: Uuid) -> sqlx::Result<()> {
    let mut tx = db.write().await?;
    discards::hold(&mut tx, id, now_ms().saturating_add(i64::try_from(HELD.as_millis()).unwrap_or(i64::MAX))).await?;
    tx.commit().await
}

async fn attempt(db: &Db, root: &Path, target: &Path, id: Uuid) -> Result<BackedUp, StoreError> {
    let snapshot = target.join("snapshot.db");
    let mut missing = None;
    for _ in 0..ATTEMPTS {
        hold(db, id).await?;
        remove_if_there(&snapshot)?;
        inventory::snapshot(db.reader(), &snapshot).await?;
        let copy = Db::open(&snapshot).await?;
        let known = Inventory::read(copy.reader()).await?;
        copy.close().await;
        let (from, to) = (root.to_path_buf(), target.to_path_buf());
        let copied = tokio::task::spawn_blocking(move || copy_files(&known, &from, &to));
        match copied.await.map_err(io::Error::other)? {
            Ok(account) => {
                File::open(&snapshot)?.sync_all()?;
                for journal in ["multistage.db-wal", "multistage.db-shm"] {
                    remove_if_there(&target.join(journal))?;
                }
                std::fs::rename(&snapshot, DataDir::database_in(target))?;
                atomic::sync_dir(target)?;
                return Ok(account);
            }
            Err(error) if error.kind() == io::ErrorKind::NotFound => missing = Some(error),
            Err(error) => return Err(error.into()),
        }
    }
    Err(missing.unwrap_or_else(|| io::ErrorKind::NotFound.into()).into())
}

fn remove_if_there(path: &Path) -> io::Result<()> {
    match std::fs::remove_file(path) {
        Err(error) if error.kind() != io::ErrorKind::NotFound => Err(error),
        _ => Ok(()),
    }
}

fn copy_files(known: &Inventory, root: &Path, target: &Path) -> io::Result<BackedUp> {
    let mut account = BackedUp::default();
    let images =
        known.images.iter().map(|file| (format!("datasets/{}/images/{}", file.folder, file.path), file.size_bytes));
    let outputs = known.outputs.iter().map(|file| (format!("jobs/{}/out/{}", file.folder, file.path), file.size_bytes));
    let uploads = known.uploads.iter().map(|(id, offset)| (format!("uploads/{id}"), *offset));
    for (path, size) in images.chain(outputs).chain(uploads) {
        let size = u64::try_from(size).unwrap_or(0);
        let to = target.join(&path);
        // Outputs of a job that ran again have the same name; uploads grow.
        let kept = path.starts_with("datasets/") && to.metadata().is_ok_and(|there| there.len() == size);
        if !kept {
            copy(&root.join(&path), target, &to, size)?;
        }
        account.files += 1;
        account.bytes += size;
    }
    Ok(account)
}

/// Copies the first `size` bytes of a file durably.
fn copy(from: &Path, root: &Path, to: &Path, size: u64) -> io::Result<()> {
    let mut source = File::open(from)?.take(size);
    let folder = to.parent().unwrap_or(root);
    atomic::create_dirs(root, folder)?;
    let mut part = atomic::temporary_in(folder)?;
    if io::copy(&mut source, part.as_file_mut())? != size {
        // It was replaced meanwhile.
        return Err(io::Error::new(io::ErrorKind::NotFound, format!("{} is shorter than it was", from.display())));
    }
    part.as_file().sync_all()?;
    part.persist(to).map_err(|failed| failed.error)?;
    atomic::sync_dir(folder)
}
