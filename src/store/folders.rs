//! Folders that are there for good: made with their ancestors, each entry durable before anybody builds on it.

use std::collections::HashSet;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

use super::{DataDir, atomic};

/// Folders that are remembered; beyond that all are forgotten and found out again, which costs a sync each.
const MOST: usize = 10_000;

/// The folders below a root that are known to be durable.
#[derive(Debug, Default)]
pub(super) struct DurableFolders(Mutex<HashSet<PathBuf>>);

impl DurableFolders {
    /// Makes `folder`, at or below `root`, with its ancestors. That one is there does not mean that it is durable:
    /// another request or another process may have made it just now. So whoever comes first syncs it, and the others
    /// wait. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn make(&self, root: &Path, folder: &Path) -> io::Result<()> {
        // A panic elsewhere can't leave the set half changed.
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if known.len() > MOST {
            known.clear();
        }
        let below = folder.strip_prefix(root).map_err(|_| io::Error::from(io::ErrorKind::InvalidInput))?;
        let mut path = root.to_path_buf();
        for part in below.components() {
            path.push(part);
            if known.contains(&path) {
                continue;
            }
            match std::fs::create_dir(&path) {
                Err(error) if error.kind() == io::ErrorKind::AlreadyExists && path.is_dir() => {}
                other => other?,
            }
            atomic::sync_parent(&path)?;
            known.insert(path.clone());
        }
        Ok(())
    }

    /// Removes `folder` with all below it, as far as it is there. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub(super) fn discard(&self, data: &DataDir, folder: &Path) -> io::Result<()> {
        let removed = data.discard(folder);
        // Afterwards: whoever makes it again meanwhile must not be believed for longer than it is there.
        self.forget(folder);
        removed
    }

    fn forget(&self, folder: &Path) {
        let mut known = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        known.retain(|path| !path.starts_with(folder));
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn folders_are_made_with_their_ancestors_and_no_file_is_taken_for_one() {
        let root = tempfile::tempdir().unwrap();
        let folders = DurableFolders::default();
        let deep = root.path().join("a/b/c");
        folders.make(root.path(), &deep).unwrap();
        folders.make(root.path(), &deep).unwrap();
        assert!(deep.is_dir());
        std::fs::remove_dir_all(root.path().join("a/b")).unwrap();
        folders.forget(&root.path().join("a/b"));
        folders.make(root.path(), &deep).unwrap();
        assert!(deep.is_dir());
        std::fs::write(root.path().join("a/file"), b"x").unwrap();
        assert!(folders.make(root.path(), &root.path().join("a/file")).is_err());
        assert!(folders.make(root.path(), &root.path().join("a/file/d")).is_err());
    }
}
