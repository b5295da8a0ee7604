//! Photographs on their way to a dataset: each is *staged*, which is to be written under a temporary name outside the dataset,
//! hashed while it is written, and synced.

use std::io::{self, Write};
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use tempfile::{NamedTempFile, TempPath};
use uuid::Uuid;

use super::{ImagePath, atomic};

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
    origin: Origin,
}

#[derive(Debug)]
enum Origin {
    /// A file that goes with this value.
    Temporary(TempPath),
    /// A file that keeps its name, and a folder of its file system for names on the way.
    Kept { file: PathBuf, scratch: PathBuf },
}

impl Origin {
    /// A file that may be renamed.
    fn into_temporary(self) -> io::Result<TempPath> {
        match self {
            Self::Temporary(file) => Ok(file),
            Self::Kept { file, scratch } => {
                let link = scratch.join(format!(".part-{}", Uuid::now_v7()));
                std::fs::hard_link(file, &link)?;
                TempPath::try_from_path(link)
            }
        }
    }
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
        Ok(StagedFile {
            path,
            size_bytes: self.size_bytes,
            sha256,
            origin: Origin::Temporary(self.file.into_temp_path()),
        })
    }
}

/// Bytes in hexadecimal.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl StagedFile {
    /// A durable file that gets a second name in the dataset; its first name stays. `scratch` lies on the same file system.
    pub(super) fn kept(file: PathBuf, scratch: PathBuf, path: ImagePath, size_bytes: u64, sha256: String) -> Self {
        Self { path, size_bytes, sha256, origin: Origin::Kept { file, scratch } }
    }

    /// Where its bytes lie now.
    pub fn staged_at(&self) -> &Path {
        match &self.origin {
            Origin::Temporary(file) => file,
            Origin::Kept { file, .. } => file,
        }
    }

    /// Renames it, over what lies there.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn move_to(self, target: &Path) -> io::Result<()> {
        self.origin.into_temporary()?.persist(target).map_err(|failed| failed.error)
    }

    /// Renames it to where nothing lies; gives it back when something does.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn move_if_free(self, target: &Path) -> io::Result<Option<Self>> {
        match self.origin.into_temporary()?.persist_noclobber(target) {
            Ok(()) => Ok(None),
            Err(failed) if failed.error.kind() == io::ErrorKind::AlreadyExists => {
                Ok(Some(Self { origin: Origin::Temporary(failed.path), ..self }))
            }
            Err(failed) => Err(failed.error),
        }
    }
}
