//! Results of units of work as content-addressed files: what a run keeps in its work folder to go on after a crash.
//!
//! A key names a value for good (it is made from the hash of everything the value depends on), so a value is written
//! once and never changed; only what is kept of work that still goes on is replaced, as a whole, by what it has become.
//! Each file starts with a header
//!
//! ```text
//! 0..8    magic and version, "MSFMART1"
//! 8..16   length of the value in bytes, u64 little-endian
//! 16..24  XXH3-64 of the value, u64 little-endian
//! 24..64  zero, so that a value that is mapped starts on a cache line
//! ```
//!
//! and a file whose header does not fit its content counts as absent: the unit is simply computed again. So nobody waits for
//! the disk when one is written. A program that crashes loses none; a power cut may cost the work of the last seconds, where
//! waiting cost a set of ten photographs a twentieth of its time.

use std::fs::File;
use std::io::{self, Read};
use std::path::{Path, PathBuf};

use xxhash_rust::xxh3::xxh3_64;

use super::atomic;

/// Bytes before the value.
const HEADER_BYTES: usize = 64;
/// The first bytes of every artifact.
const MAGIC: &[u8; 8] = b"MSFMART1";

/// A folder of artifacts. Cheap to clone; any number of threads may use it at once.
#[derive(Clone, Debug)]
pub struct ArtifactStore {
    folder: PathBuf,
    scratch: PathBuf,
}

impl ArtifactStore {
    /// Opens a folder of artifacts, makes it when it is not there, and clears what an interrupted write left behind. Only one
    /// run may use a folder at a time.
    ///
    /// # Errors
    /// What the system said.
    pub fn open(folder: &Path) -> io::Result<Self> {
        let store = Self { folder: folder.to_path_buf(), scratch: folder.join("scratch") };
        atomic::empty_dir(&store.scratch)?;
        Ok(store)
    }

    /// Reads a value; none when it was never put, or when the file is damaged.
    ///
    /// # Errors
    /// What the system said when a file that is there could not be read, or an invalid key.
    pub fn get(&self, key: &str) -> io::Result<Option<Vec<u8>>> {
        let path = self.path(key)?;
        let mut file = match File::open(&path) {
            Ok(file) => file,
            Err(error) if error.kind() == io::ErrorKind::NotFound => return Ok(None),
            Err(error) => return Err(error),
        };
        let mut header = [0; HEADER_BYTES];
        let file_bytes = file.metadata()?.len();
        if file_bytes < HEADER_BYTES as u64 {
            return Ok(None);
        }
        file.read_exact(&mut header)?;
        let word = |at: usize| u64::from_le_bytes(std::array::from_fn(|i| header[at + i]));
        let value_bytes = file_bytes - HEADER_BYTES as u64;
        let Ok(capacity) = usize::try_from(value_bytes) else { return Ok(None) };
        if header[..8] != *MAGIC || word(8) != value_bytes {
            return Ok(None);
        }
        let mut value = Vec::with_capacity(capacity);
        file.read_to_end(&mut value)?;
        Ok((value.len() == capacity && xxh3_64(&value) == word(16)).then_some(value))
    }

    /// Stores a value, whole for every later reader of this system and, when the power fails within seconds, whole or absent
    /// for those of the next start. A key that has one already gets it again.
    ///
    /// # Errors
    /// What the system said, or an invalid key.
    pub fn put(&self, key: &str, value: &[u8]) -> io::Result<()> {
        let path = self.path(key)?;
        if let Some(parent) = path.parent() {
            atomic::create_dirs(&self.folder, parent)?;
        }
        let mut header = [0; HEADER_BYTES];
        header[..8].copy_from_slice(MAGIC);
        header[8..16].copy_from_slice(&(value.len() as u64).to_le_bytes());
        header[16..24].copy_from_slice(&xxh3_64(value).to_le_bytes());
        atomic::write_whole(&path, &self.scratch, &[&header, value])
    }

    /// Removes every value whose key starts with `folder` and a `/`; there need be none.
    ///
    /// # Errors
    /// What the system said, or an invalid key.
    pub fn remove_folder(&self, folder: &str) -> io::Result<()> {
        match std::fs::remove_dir_all(self.path(folder)?) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(()),
            outcome => outcome,
        }
    }

    /// The file of a key. Keys are one or more parts joined by `/`, each of letters, digits, `_`, `-` and `.`, not starting
    /// with a dot; `scratch` is taken.
    fn path(&self, key: &str) -> io::Result<PathBuf> {
        let fits = |part: &str| {
            !part.is_empty()
                && !part.starts_with('.')
                && part.bytes().all(|b| b.is_ascii_alphanumeric() || matches!(b, b'_' | b'-' | b'.'))
        };
        if key.split('/').all(fits) && key.split('/').next() != Some("scratch") {
            Ok(self.folder.join(key))
        } else {
            Err(io::Error::new(io::ErrorKind::InvalidInput, format!("invalid artifact key {key:?}")))
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    fn store() -> (tempfile::TempDir, ArtifactStore) {
        let folder = tempfile::tempdir().unwrap();
        let store = ArtifactStore::open(&folder.path().join("work")).unwrap();
        (folder, store)
    }

    #[test]
    fn what_is_put_is_got() {
        let (_folder, store) = store();
        assert_eq!(store.get("features/ab12").unwrap(), None);
        for value in [&b""[..], b"x", &[7; 100_000]] {
            store.put("features/ab12", value).unwrap();
            assert_eq!(store.get("features/ab12").unwrap().unwrap(), value);
        }
    }

    #[test]
    fn a_damaged_file_counts_as_absent() {
        let (folder, store) = store();
        store.put("k", &[1; 1000]).unwrap();
        let path = folder.path().join("work/k");
        let whole = std::fs::read(&path).unwrap();
        for at in [0, 9, 17, HEADER_BYTES, whole.len() - 1] {
            let mut damaged = whole.clone();
            damaged[at] ^= 1;
            std::fs::write(&path, damaged).unwrap();
            assert_eq!(store.get("k").unwrap(), None, "byte {at}");
        }
        for length in [0, 10, HEADER_BYTES, whole.len() - 1] {
            std::fs::write(&path, &whole[..length]).unwrap();
            assert_eq!(store.get("k").unwrap(), None, "cut to {length}");
        }
        store.put("k", b"again").unwrap();
        assert_eq!(store.get("k").unwrap().unwrap(), b"again");
    }

    #[test]
    fn keys_cannot_leave_the_folder() {
        let (_folder, store) = store();
        for key in ["", "/etc/x", "../x", "a/../b", "a//b", ".hidden", "scratch/x", "a b", "a\0b"] {
            assert!(store.put(key, b"").is_err(), "{key:?}");
        }
    }

    #[test]
    fn opening_clears_interrupted_writes() {
        let (folder, store) = store();
        store.put("kept", b"v").unwrap();
        std::fs::write(folder.path().join("work/scratch/.part-1"), b"half").unwrap();
        let again = ArtifactStore::open(&folder.path().join("work")).unwrap();
        assert_eq!(std::fs::read_dir(folder.path().join("work/scratch")).unwrap().count(), 0);
        assert_eq!(again.get("kept").unwrap().unwrap(), b"v");
    }
}
