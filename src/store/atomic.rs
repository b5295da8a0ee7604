//! Files that appear whole or not at all.
//!
//! A file is written under a temporary name, synced, renamed to its final name, and its folder synced: after a crash or a
//! power cut at any moment the name stands for the old bytes, the new bytes or nothing.

use std::fs::{File, OpenOptions};
use std::io::{self, Write};
use std::os::unix::fs::OpenOptionsExt;
use std::path::Path;

use tempfile::NamedTempFile;

/// A new temporary file in `folder`, readable by others once it is renamed; deleted when dropped.
pub(crate) fn temporary_in(folder: &Path) -> io::Result<NamedTempFile> {
    // Opened here, so that an error is the system's own: the crate's hides its number.
    let open = |path: &Path| OpenOptions::new().read(true).write(true).create_new(true).mode(0o644).open(path);
    tempfile::Builder::new().prefix(".part-").make_in(folder, open)
}

/// Writes `parts`, one after the other, to the file `path`; the temporary file is made in `scratch` (same file system).
pub(crate) fn write_atomic(path: &Path, scratch: &Path, parts: &[&[u8]]) -> io::Result<()> {
    let file = written(scratch, parts)?;
    file.as_file().sync_all()?;
    file.persist(path).map_err(|failed| failed.error)?;
    sync_parent(path)
}

/// [`write_atomic`] without waiting for the disk: whole or not at all for as long as the system runs, but after a power cut
/// the name may stand for any part of the bytes, and whoever reads must find that out.
pub(crate) fn write_whole(path: &Path, scratch: &Path, parts: &[&[u8]]) -> io::Result<()> {
    written(scratch, parts)?.persist(path).map_err(|failed| failed.error)?;
    Ok(())
}

fn written(scratch: &Path, parts: &[&[u8]]) -> io::Result<NamedTempFile> {
    let mut file = temporary_in(scratch)?;
    for part in parts {
        // Not through the temporary file itself, which hides the system's error in one of its own.
        file.as_file_mut().write_all(part)?;
    }
    Ok(file)
}

/// Makes the entries of a folder durable.
pub(crate) fn sync_dir(folder: &Path) -> io::Result<()> {
    File::open(folder)?.sync_all()
}

/// Makes the entry of a file or folder in its parent durable.
pub(crate) fn sync_parent(path: &Path) -> io::Result<()> {
    match path.parent() {
        Some(parent) => sync_dir(parent),
        None => Ok(()),
    }
}

/// Makes a folder with all its ancestors below `root`, each durable.
pub(crate) fn create_dirs(root: &Path, folder: &Path) -> io::Result<()> {
    if folder.is_dir() {
        return Ok(());
    }
    if folder != root
        && let Some(parent) = folder.parent()
    {
        create_dirs(root, parent)?;
    }
    match std::fs::create_dir(folder) {
        Ok(()) => sync_parent(folder),
        Err(error) if error.kind() == io::ErrorKind::AlreadyExists && folder.is_dir() => Ok(()),
        Err(error) => Err(error),
    }
}

/// Every file below `folder` as a path relative to it, with `/`, in byte order; a missing folder has none.
/// Links are not followed, names that are not UTF-8 are left out.
pub(crate) fn list_files(folder: &Path) -> io::Result<Vec<String>> {
    fn visit(folder: &Path, prefix: &str, found: &mut Vec<String>) -> io::Result<()> {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            let Ok(name) = entry.file_name().into_string() else { continue };
            let kind = entry.file_type()?;
            if kind.is_dir() {
                visit(&entry.path(), &format!("{prefix}{name}/"), found)?;
            } else if kind.is_file() {
                found.push(format!("{prefix}{name}"));
            }
        }
        Ok(())
    }
    let mut found = Vec::new();
    if folder.is_dir() {
        visit(folder, "", &mut found)?;
    }
    found.sort_unstable();
    Ok(found)
}

/// Syncs every folder below `folder`, itself included, deepest first.
pub(crate) fn sync_folders(folder: &Path) -> io::Result<()> {
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            sync_folders(&entry.path())?;
        }
    }
    sync_dir(folder)
}

/// Removes what a folder holds, and makes the folder if it is not there.
pub(crate) fn empty_dir(folder: &Path) -> io::Result<()> {
    std::fs::create_dir_all(folder)?;
    for entry in std::fs::read_dir(folder)? {
        let entry = entry?;
        if entry.file_type()?.is_dir() {
            std::fs::remove_dir_all(entry.path())?;
        } else {
            std::fs::remove_file(entry.path())?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn a_file_is_replaced_whole_and_leaves_no_scratch() {
        let root = tempfile::tempdir().unwrap();
        let (scratch, path) = (root.path().join("scratch"), root.path().join("a/b/file"));
        std::fs::create_dir(&scratch).unwrap();
        create_dirs(root.path(), path.parent().unwrap()).unwrap();
        write_atomic(&path, &scratch, &[b"one"]).unwrap();
        write_atomic(&path, &scratch, &[b"two", b"+"]).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), b"two+");
        assert_eq!(list_files(root.path()).unwrap(), ["a/b/file"]);
        empty_dir(root.path()).unwrap();
        assert_eq!(std::fs::read_dir(root.path()).unwrap().count(), 0);
    }
}
