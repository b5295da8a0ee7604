//! Whether a data directory is whole: the database in itself, and the files that it speaks of.
//!
//! Nothing is ever deleted here. What belongs to nobody is moved to `quarantine/`, from where the service removes it
//! after a week.

use std::collections::BTreeSet;
use std::fs::File;
use std::io;
use std::path::{Path, PathBuf};
use std::time::Duration;

use sha2::{Digest, Sha256};
use uuid::Uuid;

use super::db::{Db, inventory, now_ms};
use super::incoming::hex;
use super::resumable::HashWriter;
use super::{DataDir, StoreError, atomic};

/// What is wrong with a file.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Finding {
    /// What SQLite says about its file.
    Database(String),
    /// A file that the database speaks of is not there.
    Missing(String),
    /// A file has another length or other bytes than the database says.
    Damaged(String),
    /// A file or folder that the database does not know.
    Orphan(String),
}

/// Examines a data directory, whose service may run. Paths are relative to `root`. With `bytes` every file is read and its hash
/// compared; without, its length.
///
/// # Errors
/// What the system or SQLite said.
pub async fn examine(db: &Db, root: &Path, bytes: bool) -> Result<Vec<Finding>, StoreError> {
    let mut findings: Vec<Finding> =
        inventory::integrity(db.reader()).await?.into_iter().map(Finding::Database).collect();
    let known = inventory::Inventory::read(db.reader()).await?;
    let root = root.to_path_buf();
    let files = move || -> io::Result<Vec<Finding>> {
        let mut findings = Vec::new();
        let mut expected = BTreeSet::new();
        for image in &known.images {
            let path = format!("datasets/{}/images/{}", image.folder, image.path);
            findings.extend(check(&root, &path, image.size_bytes, bytes.then_some(Hash::Sha256(&image.hash)))?);
            expected.insert(path);
        }
        for output in &known.outputs {
            let path = format!("jobs/{}/out/{}", output.folder, output.path);
            findings.extend(check(&root, &path, output.size_bytes, bytes.then_some(Hash::Blake3(&output.hash)))?);
        }
        for (upload, offset) in &known.uploads {
            let there = root.join("uploads").join(upload).metadata().map_or(0, |file| file.len());
            if i64::try_from(there).is_ok_and(|there| there < *offset) {
                findings.push(Finding::Damaged(format!("uploads/{upload}")));
            }
        }
        findings.extend(orphans(&root, &known, &expected)?.into_iter().map(Finding::Orphan));
        Ok(findings)
    };
    findings.extend(tokio::task::spawn_blocking(files).await.map_err(io::Error::other)??);
    Ok(findings)
}

enum Hash<'a> {
    Sha256(&'a str),
    Blake3(&'a str),
}

fn check(root: &Path, path: &str, size_bytes: i64, hash: Option<Hash<'_>>) -> io::Result<Option<Finding>> {
    let mut file = match File::open(root.join(path)) {
        Ok(file) => file,
        Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(Some(Finding::Missing(path.to_owned()))),
        Err(error) => return Err(error),
    };
    let whole = i64::try_from(file.metadata()?.len()) == Ok(size_bytes)
        && match hash {
            None => true,
            Some(Hash::Sha256(known)) => {
                let mut hash = Sha256::new();
                io::copy(&mut file, &mut HashWriter(&mut hash))?;
                hex(&hash.finalize()) == known
            }
            Some(Hash::Blake3(known)) => {
                let mut hash = blake3::Hasher::new();
                io::copy(&mut file, &mut hash)?;
                hash.finalize().to_hex().starts_with(known)
            }
        };
    Ok((!whole).then(|| Finding::Damaged(path.to_owned())))
}

/// Folders of no dataset and no job, and photographs without a row.
fn orphans(root: &Path, known: &inventory::Inventory, images: &BTreeSet<String>) -> io::Result<Vec<String>> {
    let mut found = Vec::new();
    for (kind, ids) in [("datasets", &known.datasets), ("jobs", &known.jobs)] {
        for entry in std::fs::read_dir(root.join(kind))? {
            let name = entry?.file_name().to_string_lossy().into_owned();
            if !ids.contains(&name) {
                found.push(format!("{kind}/{name}"));
            } else if kind == "datasets" {
                let folder = format!("{kind}/{name}/images");
                let stored =
                    atomic::list_files(&root.join(&folder))?.into_iter().map(|path| format!("{folder}/{path}"));
                found.extend(stored.filter(|path| !images.contains(path)));
            }
        }
    }
    Ok(found)
}

/// So long what was put into quarantine is kept.
const QUARANTINE: Duration = Duration::from_secs(7 * 24 * 3600);

impl DataDir {
    fn quarantine(&self) -> PathBuf {
        self.root().join("quarantine")
    }

    /// Moves something that belongs to nobody, given relative to the directory, out of the way. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub fn put_into_quarantine(&self, orphan: &str) -> io::Result<PathBuf> {
        let place = self.quarantine().join(format!("{}-{}", now_ms(), Uuid::now_v7()));
        let target = place.join(orphan);
        atomic::create_dirs(self.root(), target.parent().unwrap_or(&place))?;
        std::fs::rename(self.root().join(orphan), &target)?;
        atomic::sync_parent(&target)?;
        Ok(target)
    }

    /// Removes what has been in quarantine long enough; gives the number. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub fn empty_quarantine(&self) -> io::Result<usize> {
        let before_ms = now_ms().saturating_sub(i64::try_from(QUARANTINE.as_millis()).unwrap_or(i64::MAX));
        let entries = match std::fs::read_dir(self.quarantine()) {
            Ok(entries) => entries,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(0),
            Err(error) => return Err(error),
        };
        let mut removed = 0;
        for entry in entries {
            let entry = entry?;
            let name = entry.file_name();
            let since = name.to_str().and_then(|name| name.split('-').next()?.parse::<i64>().ok());
            if since.is_some_and(|since| since < before_ms) {
                self.discard(&entry.path())?;
                removed += 1;
            }
        }
        Ok(removed)
    }
}
