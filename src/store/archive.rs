//! Photographs out of an uploaded zip file, with every limit counted on the bytes that come out, not on what headers promise.

use std::fs::File;
use std::io::{self, Read, Seek, SeekFrom};
use std::path::Path;

use zip::ZipArchive;
use zip::result::ZipError;

use super::file_name::InvalidFileName;
use super::incoming::{StagedFile, StagedWriter};
use super::{ImagePath, StoreError};

/// How far an archive may go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ArchiveLimits {
    /// Entries, folders and other files included.
    pub max_entries: u64,
    /// Bytes of one unpacked photograph.
    pub max_file_bytes: u64,
    /// Bytes of all unpacked photographs.
    pub max_total_bytes: u64,
    /// All unpacked photographs against the archive's own length; photographs hardly shrink, so 3 is generous. The first 64 MiB
    /// are free of it.
    pub max_ratio: u64,
}

impl Default for ArchiveLimits {
    fn default() -> Self {
        Self { max_entries: 100_000, max_file_bytes: 1 << 30, max_total_bytes: 1 << 38, max_ratio: 10 }
    }
}

/// Unpacked bytes that the ratio is not asked of: a few tiny synthetic pictures may shrink well.
const RATIO_FREE_BYTES: u64 = 64 << 20;
/// Bytes copied at a time.
const CHUNK_BYTES: usize = 128 << 10;
/// The end record is within this many bytes of the end: its 22 bytes and the longest comment.
const END_RECORD_REACH_BYTES: u64 = 22 + 65_535;

/// Why an archive was refused.
#[derive(Debug, thiserror::Error)]
pub enum ArchiveError {
    /// It can't be read as a zip file, or holds what no honest archive of photographs does.
    #[error("the archive can't be used: {0}")]
    Invalid(String),
    /// One of its names is not acceptable.
    #[error("{0:?}: {1}")]
    FileName(String, InvalidFileName),
    /// It breaks a limit.
    #[error("the archive is too large: {0}")]
    TooLarge(String),
    /// What the store said.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<io::Error> for ArchiveError {
    fn from(error: io::Error) -> Self {
        Self::Store(StoreError::Io(error))
    }
}

impl From<ZipError> for ArchiveError {
    fn from(error: ZipError) -> Self {
        Self::Invalid(error.to_string())
    }
}

/// Stages every photograph of a zip file in `scratch` and hands each to `emit`; returns the names left out because they are no
/// photographs. All names are checked before anything is unpacked. Blocking.
///
/// # Errors
/// Why it was refused, or what `emit` said.
pub fn unpack(
    archive: &Path,
    limits: &ArchiveLimits,
    scratch: &Path,
    emit: &mut dyn FnMut(StagedFile) -> Result<(), ArchiveError>,
) -> Result<Vec<String>, ArchiveError> {
    let mut file = File::open(archive)?;
    let archive_bytes = file.metadata()?.len();
    let entries = declared_entries(&mut file, archive_bytes)?;
    if entries > limits.max_entries {
        let message = format!("{entries} entries, at most {} are taken", limits.max_entries);
        return Err(ArchiveError::TooLarge(message));
    }
    let mut archive = ZipArchive::new(io::BufReader::new(file))?;
    // The reader keeps the last of several entries with one name, and says nothing.
    if archive.len() as u64 != entries {
        return Err(ArchiveError::Invalid("its directory does not add up, or holds a name twice".to_owned()));
    }
    let mut ignored = Vec::new();
    let mut photographs = Vec::new();
    for index in 0..archive.len() {
        let entry = archive.by_index_raw(index)?;
        let name = entry.name()?.into_owned();
        if entry.is_symlink() {
            return Err(ArchiveError::Invalid(format!("{name:?} is a link")));
        }
        let path = ImagePath::parse(&name).map_err(|why| ArchiveError::FileName(name.clone(), why))?;
        if entry.is_dir() {
            continue;
        }
        if !path.is_photograph() {
            ignored.push(name);
            continue;
        }
        if entry.encrypted() {
            return Err(ArchiveError::Invalid(format!("{name:?} is encrypted")));
        }
        photographs.push((index, path));
    }
    let budget = limits.max_total_bytes.min(RATIO_FREE_BYTES.max(archive_bytes.saturating_mul(limits.max_ratio)));
    let mut unpacked = 0u64;
    let mut chunk = vec![0; CHUNK_BYTES];
    for (index, path) in photographs {
        let mut entry = archive.by_index(index)?;
        let declared = entry.size();
        let mut writer = StagedWriter::create(scratch)?;
        loop {
            // What the system did not say, the archive is to blame for.
            let read = entry.read(&mut chunk).map_err(|error| match error.raw_os_error() {
                Some(_) => ArchiveError::from(error),
                None => ArchiveError::Invalid(format!("{path}: {error}")),
            })?;
            if read == 0 {
                break;
            }
            unpacked += read as u64;
            if writer.size_bytes() + read as u64 > limits.max_file_bytes || unpacked > budget {
                return Err(ArchiveError::TooLarge(format!("{path} unpacks to more than is taken")));
            }
            writer.write(&chunk[..read])?;
        }
        if writer.size_bytes() != declared {
            return Err(ArchiveError::Invalid(format!("{path} has not the length that its entry states")));
        }
        emit(writer.finish(path)?)?;
    }
    Ok(ignored)
}

/// Entries that the end record speaks of; it is read first, because the reader holds the whole directory in memory.
fn declared_entries(file: &mut File, archive_bytes: u64) -> Result<u64, ArchiveError> {
    let missing = || ArchiveError::Invalid("it is no zip file".to_owned());
    let reach = END_RECORD_REACH_BYTES.min(archive_bytes);
    file.seek(SeekFrom::Start(archive_bytes - reach))?;
    let mut tail = Vec::new();
    file.take(reach).read_to_end(&mut tail)?;
    let end = tail.windows(4).rposition(|word| word == b"PK\x05\x06").ok_or_else(missing)?;
    let count = tail.get(end + 10..end + 12).ok_or_else(missing)?;
    let count = u16::from_le_bytes([count[0], count[1]]);
    if count < u16::MAX {
        return Ok(count.into());
    }
    // More than 65,534: the zip64 locator stands right before, and names the place of the record with the 64-bit count.
    let Some(locator) = end.checked_sub(20).and_then(|at| tail.get(at..end)) else { return Ok(count.into()) };
    if !locator.starts_with(b"PK\x06\x07") {
        return Ok(count.into());
    }
    let word = |bytes: &[u8]| u64::from_le_bytes(std::array::from_fn(|i| bytes[i]));
    file.seek(SeekFrom::Start(word(&locator[8..16])))?;
    let mut record = [0; 40];
    file.read_exact(&mut record).map_err(|_| missing())?;
    Ok(word(&record[32..40]))
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::{Cursor, Write};

    use zip::write::{SimpleFileOptions, ZipWriter};

    use super::*;

    fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Deflated);
        for (name, bytes) in entries {
            zip.start_file(*name, options).unwrap();
            zip.write_all(bytes).unwrap();
        }
        zip.finish().unwrap().into_inner()
    }

    fn unpacked(bytes: &[u8], limits: &ArchiveLimits) -> Result<(Vec<String>, Vec<String>), ArchiveError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("a.zip");
        std::fs::write(&path, bytes).unwrap();
        let mut found = Vec::new();
        let ignored = unpack(&path, limits, folder.path(), &mut |file| {
            found.push(format!("{} {}", file.path, file.size_bytes));
            Ok(())
        })?;
        Ok((found, ignored))
    }

    #[test]
    fn photographs_come_out_and_the_rest_is_named() {
        let bytes =
            archive(&[("a/b.jpg", b"12345"), ("notes.txt", b"x"), ("__MACOSX/a/._b.jpg", b"y"), ("石.png", b"")]);
        let (found, ignored) = unpacked(&bytes, &ArchiveLimits::default()).unwrap();
        assert_eq!(found, ["a/b.jpg 5", "石.png 0"]);
        assert_eq!(ignored, ["notes.txt", "__MACOSX/a/._b.jpg"]);
    }

    #[test]
    fn names_that_leave_the_folder_refuse_the_whole_archive() {
        for name in ["../a.jpg", "/a.jpg", "x/../../a.jpg", "a\\b.jpg", "C:/a.jpg", "a\n.jpg"] {
            let bytes = archive(&[("good.jpg", b"1"), (name, b"2")]);
            assert!(matches!(unpacked(&bytes, &ArchiveLimits::default()), Err(ArchiveError::FileName(..))), "{name:?}");
        }
    }

    #[test]
    fn links_are_refused() {
        let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
        zip.add_symlink("a.jpg", "/etc/passwd", SimpleFileOptions::default()).unwrap();
        let bytes = zip.finish().unwrap().into_inner();
        assert!(matches!(unpacked(&bytes, &ArchiveLimits::default()), Err(ArchiveError::Invalid(_))));
    }

    #[test]
    fn limits_count_what_comes_out() {
        let large = vec![0; 1 << 20];
        let bytes = archive(&[("a.jpg", &large), ("b.jpg", &large)]);
        let limits = ArchiveLimits::default();
        assert!(unpacked(&bytes, &limits).is_ok());
        for tight in [
            ArchiveLimits { max_file_bytes: (1 << 20) - 1, ..limits },
            ArchiveLimits { max_total_bytes: (2 << 20) - 1, ..limits },
            ArchiveLimits { max_entries: 1, ..limits },
        ] {
            assert!(matches!(unpacked(&bytes, &tight), Err(ArchiveError::TooLarge(_))), "{tight:?}");
        }
        let bomb = archive(&[("a.jpg", &vec![0; (RATIO_FREE_BYTES + 1) as usize])]);
        assert!(matches!(unpacked(&bomb, &limits), Err(ArchiveError::TooLarge(_))));
    }

    #[test]
    fn what_is_no_archive_is_refused() {
        let whole = archive(&[("a.jpg", &[5; 1000])]);
        for bytes in [&b""[..], b"hello", &whole[..whole.len() / 2], &whole[10..]] {
            assert!(matches!(unpacked(bytes, &ArchiveLimits::default()), Err(ArchiveError::Invalid(_))));
        }
    }
}
