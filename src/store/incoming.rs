//! Photographs on their way to a dataset: each is *staged*, which is to be written under a temporary name outside the dataset,
//! hashed while it is written, and synced.

use std::io::{self, Write};
use std::path::Path;

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

    /// Renames it, over what lies there.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn move_to(self, target: &Path) -> io::Result<()> {
        self.file.persist(target).map_err(|failed| failed.error)
    }
}
