//! Zip archives of stored (not deflated) files, laid out before a byte of a file is read: the length is known
//! beforehand, any part can be made on its own, and memory holds headers alone. (APPNOTE.TXT 6.3.10, sections 4.3 to
//! 4.5; zip64 where it is needed.)

/// A file to be in an archive.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct StoredFile {
    /// Relative, with `/`.
    pub name: String,
    /// Its length.
    pub size_bytes: u64,
    /// CRC-32 (ISO 3309) of its bytes.
    pub crc32: u32,
}

/// A run of an archive's bytes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Piece {
    /// These bytes.
    Bytes(Vec<u8>),
    /// Bytes of a file.
    File {
        /// Its place in the list the archive was made of.
        index: usize,
        /// Where they begin.
        from: u64,
        /// How many.
        size_bytes: u64,
    },
}

/// The layout of an archive.
#[derive(Clone, Debug)]
pub struct StoredZip {
    pieces: Vec<Piece>,
    /// Where each piece ends.
    ends: Vec<u64>,
}

/// From here on a 32-bit field can't hold the number; the field then says so by this value.
const MAX_32: u64 = 0xffff_ffff;
/// The same for 16 bits.
const MAX_16: u64 = 0xffff;
/// Names are UTF-8.
const FLAG_UTF8: u16 = 1 << 11;
/// 1 January 1980, the first day the format knows: the same files give the same bytes.
const DOS_DATE: u16 = 0x0021;
/// Read and write for the owner, read for others, as Unix writes it.
const UNIX_MODE: u32 = 0o100_644 << 16;
/// Version 4.5 of the format, for zip64, made on Unix.
const MADE_BY: u16 = 3 << 8 | 45;

/// Bytes of an archive that are no file's.
#[derive(Default)]
struct Header(Vec<u8>);

impl Header {
    fn u16(mut self, value: u16) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u32(mut self, value: u32) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn u64(mut self, value: u64) -> Self {
        self.0.extend(value.to_le_bytes());
        self
    }

    fn bytes(mut self, bytes: &[u8]) -> Self {
        self.0.extend(bytes);
        self
    }

    /// A number where it fits into 32 bits, else the mark that it stands in the zip64 field.
    fn narrow(self, value: u64) -> Self {
        self.u32(value.min(MAX_32) as u32)
    }

    /// Version needed, flags, method, time, date, CRC and both lengths: what the local and the central header have in common.
    fn common(self, file: &StoredFile, zip64: bool) -> Self {
        self.u16(if zip64 { 45 } else { 20 })
            .u16(FLAG_UTF8)
            .u16(0)
            .u16(0)
            .u16(DOS_DATE)
            .u32(file.crc32)
            .narrow(file.size_bytes)
            .narrow(file.size_bytes)
            // A name is at most a kilobyte long.
            .u16(file.name.len().min(MAX_16 as usize) as u16)
    }
}

/// The extra field with the numbers that 32 bits can't hold.
fn zip64_field(numbers: &[u64]) -> Vec<u8> {
    if numbers.is_empty() {
        return Vec::new();
    }
    let head = Header::default().u16(1).u16((numbers.len() * 8) as u16);
    numbers.iter().fold(head, |header, number| header.u64(*number)).0
}

fn local_header(file: &StoredFile) -> Vec<u8> {
    let wide = file.size_bytes >= MAX_32;
    let sizes = [file.size_bytes; 2];
    let extra = zip64_field(if wide { &sizes } else { &[] });
    let header = Header::default().u32(0x0403_4b50).common(file, wide).u16(extra.len() as u16);
    header.bytes(file.name.as_bytes()).bytes(&extra).0
}

fn central_header(file: &StoredFile, offset: u64) -> Vec<u8> {
    let mut numbers = Vec::new();
    if file.size_bytes >= MAX_32 {
        numbers.extend([file.size_bytes; 2]);
    }
    if offset >= MAX_32 {
        numbers.push(offset);
    }
    let extra = zip64_field(&numbers);
    let header = Header::default().u32(0x0201_4b50).u16(MADE_BY).common(file, !numbers.is_empty());
    // No comment, the first disk, no internal attributes.
    let header = header.u16(extra.len() as u16).u16(0).u16(0).u16(0).u32(UNIX_MODE).narrow(offset);
    header.bytes(file.name.as_bytes()).bytes(&extra).0
}

/// The end of the directory, which has `entries` entries and lies at `offset`.
fn end(entries: u64, size_bytes: u64, offset: u64) -> Vec<u8> {
    let mut header = Header::default();
    if entries >= MAX_16 || size_bytes >= MAX_32 || offset >= MAX_32 {
        header = header.u32(0x0606_4b50).u64(44).u16(MADE_BY).u16(45).u32(0).u32(0);
        header = header.u64(entries).u64(entries).u64(size_bytes).u64(offset);
        // The locator: where the record above lies.
        header = header.u32(0x0706_4b50).u32(0).u64(offset + size_bytes).u32(1);
    }
    let count = entries.min(MAX_16) as u16;
    header.u32(0x0605_4b50).u16(0).u16(0).u16(count).u16(count).narrow(size_bytes).narrow(offset).u16(0).0
}

impl Piece {
    fn size_bytes(&self) -> u64 {
        match self {
            Self::Bytes(bytes) => bytes.len() as u64,
            Self::File { size_bytes, .. } => *size_bytes,
        }
    }

    /// The part of this piece from `skipped` on, of at most `most` bytes.
    fn part(&self, skipped: u64, most: u64) -> Self {
        let size = (self.size_bytes() - skipped).min(most);
        match self {
            Self::Bytes(bytes) => Self::Bytes(bytes[skipped as usize..(skipped + size) as usize].to_vec()),
            Self::File { index, from, .. } => Self::File { index: *index, from: from + skipped, size_bytes: size },
        }
    }
}

impl StoredZip {
    /// Lays out an archive of these files, in their order.
    pub fn new(files: &[StoredFile]) -> Self {
        let (mut pieces, mut directory, mut at) = (Vec::new(), Vec::new(), 0);
        for (index, file) in files.iter().enumerate() {
            directory.extend(central_header(file, at));
            let header = local_header(file);
            at += header.len() as u64 + file.size_bytes;
            pieces.push(Piece::Bytes(header));
            pieces.push(Piece::File { index, from: 0, size_bytes: file.size_bytes });
        }
        directory.extend(end(files.len() as u64, directory.len() as u64, at));
        pieces.push(Piece::Bytes(directory));
        let mut end = 0;
        let ends = pieces.iter().map(|piece| {
            end += piece.size_bytes();
            end
        });
        Self { ends: ends.collect(), pieces }
    }

    /// Bytes of the archive.
    pub fn size_bytes(&self) -> u64 {
        self.ends.last().copied().unwrap_or(0)
    }

    /// What the `size_bytes` bytes from `from` on are made of; less when the archive ends before.
    pub fn pieces(&self, from: u64, size_bytes: u64) -> Vec<Piece> {
        let first = self.ends.partition_point(|end| *end <= from);
        let mut skip = if first == 0 { from } else { from - self.ends[first - 1] };
        let (mut left, mut found) = (size_bytes, Vec::new());
        for piece in &self.pieces[first..] {
            if left == 0 {
                break;
            }
            let part = piece.part(skip, left);
            skip = 0;
            left -= part.size_bytes();
            if part.size_bytes() > 0 {
                found.push(part);
            }
        }
        found
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::io::{Cursor, Read};

    use proptest::prelude::*;

    use super::*;

    fn stored(files: &[(String, Vec<u8>)]) -> StoredZip {
        let entry = |(name, bytes): &(String, Vec<u8>)| StoredFile {
            name: name.clone(),
            size_bytes: bytes.len() as u64,
            crc32: crc32fast::hash(bytes),
        };
        StoredZip::new(&files.iter().map(entry).collect::<Vec<_>>())
    }

    fn bytes_of(pieces: &[Piece], files: &[(String, Vec<u8>)]) -> Vec<u8> {
        pieces.iter().fold(Vec::new(), |mut all, piece| {
            match piece {
                Piece::Bytes(bytes) => all.extend(bytes),
                Piece::File { index, from, size_bytes } => {
                    all.extend(&files[*index].1[*from as usize..(from + size_bytes) as usize]);
                }
            }
            all
        })
    }

    proptest! {
        /// An independent reader finds every file, and any part is that part of the whole.
        #[test]
        fn archives_are_read_by_others_and_cut_anywhere(
            contents in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..300), 0..6),
            from in 0u64..2500,
            size in 0u64..2500,
        ) {
            let named = |(n, bytes): (usize, Vec<u8>)| (format!("石/{n}.bin"), bytes);
            let files: Vec<_> = contents.into_iter().enumerate().map(named).collect();
            let zip = stored(&files);
            let whole = bytes_of(&zip.pieces(0, u64::MAX), &files);
            prop_assert_eq!(whole.len() as u64, zip.size_bytes());
            let mut read = zip::ZipArchive::new(Cursor::new(&whole)).unwrap();
            prop_assert_eq!(read.len(), files.len());
            for (n, (name, bytes)) in files.iter().enumerate() {
                let mut entry = read.by_index(n).unwrap();
                prop_assert_eq!(&*entry.name().unwrap(), name.as_str());
                let mut content = Vec::new();
                entry.read_to_end(&mut content).unwrap();
                prop_assert_eq!(&content, bytes);
            }
            let (first, last) = ((from as usize).min(whole.len()), ((from + size) as usize).min(whole.len()));
            prop_assert_eq!(&bytes_of(&zip.pieces(from, size), &files), &whole[first..last]);
        }
    }

    /// A reader over the archive of files too long for a test: they hold zeros alone.
    struct Long {
        zip: StoredZip,
        at: u64,
    }

    impl Read for Long {
        fn read(&mut self, buffer: &mut [u8]) -> std::io::Result<usize> {
            let mut read = 0;
            for piece in self.zip.pieces(self.at, buffer.len() as u64) {
                let size = piece.size_bytes() as usize;
                match piece {
                    Piece::Bytes(bytes) => buffer[read..read + size].copy_from_slice(&bytes),
                    Piece::File { .. } => buffer[read..read + size].fill(0),
                }
                read += size;
            }
            self.at += read as u64;
            Ok(read)
        }
    }

    impl std::io::Seek for Long {
        fn seek(&mut self, to: std::io::SeekFrom) -> std::io::Result<u64> {
            self.at = match to {
                std::io::SeekFrom::Start(at) => at,
                std::io::SeekFrom::End(back) => self.zip.size_bytes().saturating_add_signed(back),
                std::io::SeekFrom::Current(on) => self.at.saturating_add_signed(on),
            };
            Ok(self.at)
        }
    }

    #[test]
    fn files_beyond_4_gib_and_many_of_them_are_found() {
        let long = |name: &str, size_bytes| StoredFile { name: name.to_owned(), size_bytes, crc32: 7 };
        let mut files = vec![long("a", 5 << 30), long("b", 10), long("c", 5 << 30), long("d", MAX_32)];
        let check = |files: &[StoredFile]| {
            let mut read = zip::ZipArchive::new(Long { zip: StoredZip::new(files), at: 0 }).unwrap();
            assert_eq!(read.len(), files.len());
            for (n, file) in files.iter().enumerate() {
                let entry = read.by_index(n).unwrap();
                assert_eq!((&*entry.name().unwrap(), entry.size()), (file.name.as_str(), file.size_bytes));
            }
        };
        check(&files);
        files.truncate(1);
        check(&files);
        check(&(0..70_000).map(|n| long(&n.to_string(), 0)).collect::<Vec<_>>());
    }
}
