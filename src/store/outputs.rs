//! Checksums of what jobs made.

use std::fs::File;
use std::io::{self, Read};

use uuid::Uuid;

use super::db::job_outputs::{self, JobOutputRow};
use super::{Store, StoreError};

/// Bytes read at a time.
const CHUNK_BYTES: usize = 128 << 10;

/// What identifies a file's bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Checksums {
    /// Its length.
    pub size_bytes: u64,
    /// The first 128 bits of its BLAKE3, in hexadecimal.
    pub blake3: String,
    /// CRC-32, for archives.
    pub crc32: u32,
}

impl Checksums {
    /// Reads to the end. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub fn of(file: &mut impl Read) -> io::Result<Self> {
        let (mut blake3, mut crc32, mut size_bytes) = (blake3::Hasher::new(), crc32fast::Hasher::new(), 0);
        let mut chunk = vec![0; CHUNK_BYTES];
        loop {
            let read = match file.read(&mut chunk) {
                Ok(0) => break,
                Ok(read) => read,
                Err(error) if error.kind() == io::ErrorKind::Interrupted => continue,
                Err(error) => return Err(error),
            };
            blake3.update(&chunk[..read]);
            crc32.update(&chunk[..read]);
            size_bytes += read as u64;
        }
        let blake3 = blake3.finalize().to_hex()[..32].to_owned();
        Ok(Self { size_bytes, blake3, crc32: crc32.finalize() })
    }
}

impl Store {
    /// The outputs of a job, each with its CRC-32: what earlier versions did not note is read from the files once.
    ///
    /// # Errors
    /// What the system or SQLite said.
    pub async fn outputs_to_archive(&self, job: Uuid) -> Result<Vec<JobOutputRow>, StoreError> {
        let mut outputs = job_outputs::list(self.db.reader(), job).await?;
        for output in outputs.iter_mut().filter(|output| output.crc32.is_none()) {
            let path = self.data.out(job).join(&output.path);
            let sums = tokio::task::spawn_blocking(move || Checksums::of(&mut File::open(path)?));
            let crc32 = sums.await.map_err(io::Error::other)??.crc32;
            let mut tx = self.db.write().await?;
            job_outputs::set_crc32(&mut tx, job, &output.path, crc32).await?;
            tx.commit().await?;
            output.crc32 = Some(crc32);
        }
        Ok(outputs)
    }
}
