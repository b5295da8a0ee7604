//! Bytes on their way into the file of a resumable upload.

use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};

use sha2::{Digest, Sha256};
use uuid::Uuid;

use super::Store;

/// Appends to the file of an upload. Blocking.
pub struct Appender {
    file: File,
    appended: Appended,
}

/// What an [`Appender`] made durable.
#[derive(Debug)]
pub struct Appended {
    /// The file's length.
    pub size_bytes: u64,
    /// Of its bytes, where the appender was given one of those before.
    pub hash: Option<Sha256>,
    /// What ended the writing.
    pub failure: Option<io::Error>,
}

impl Appender {
    /// Takes bytes; after a failure it takes no more, and [`Self::finish`] tells.
    pub fn write(&mut self, bytes: &[u8]) -> bool {
        let Appended { size_bytes, hash, failure } = &mut self.appended;
        let mut rest = bytes;
        while failure.is_none() && !rest.is_empty() {
            match self.file.write(rest) {
                Ok(0) => *failure = Some(io::ErrorKind::WriteZero.into()),
                Ok(written) => {
                    if let Some(hash) = hash {
                        hash.update(&rest[..written]);
                    }
                    *size_bytes += written as u64;
                    rest = &rest[written..];
                }
                Err(error) if error.kind() == io::ErrorKind::Interrupted => {}
                Err(error) => *failure = Some(error),
            }
        }
        failure.is_none()
    }

    /// Makes the bytes that were written durable.
    ///
    /// # Errors
    /// When nothing can be said about what is durable.
    pub fn finish(self) -> io::Result<Appended> {
        self.file.sync_data()?;
        Ok(self.appended)
    }
}

impl Store {
    /// Opens the file of an upload behind its first `offset` bytes, whose hash may be given to go on with it; what lies
    /// there goes. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub fn append_upload(&self, id: Uuid, offset: u64, hash: Option<Sha256>) -> io::Result<Appender> {
        let path = self.data.upload(id);
        let mut file = File::options().create(true).truncate(false).write(true).open(path)?;
        file.set_len(offset)?;
        file.seek(SeekFrom::Start(offset))?;
        Ok(Appender { file, appended: Appended { size_bytes: offset, hash, failure: None } })
    }
}
