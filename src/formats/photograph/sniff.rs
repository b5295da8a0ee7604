//! What a file is, by its first bytes, and whether it is all there, by its container's structure.

use super::{PhotographError, PhotographFormat, jpeg};

/// The format of a file.
pub(super) fn format(bytes: &[u8]) -> Result<PhotographFormat, PhotographError> {
    if bytes.is_empty() {
        return Err(PhotographError::Unreadable("the file is empty".into()));
    }
    if bytes.starts_with(&[0xff, 0xd8, 0xff]) {
        return Ok(PhotographFormat::Jpeg);
    }
    if bytes.starts_with(PNG_SIGNATURE) {
        return Ok(PhotographFormat::Png);
    }
    if bytes.starts_with(b"II*\0")
        || bytes.starts_with(b"MM\0*")
        || bytes.starts_with(b"II+\0")
        || bytes.starts_with(b"MM\0+")
    {
        return Ok(PhotographFormat::Tiff);
    }
    if bytes.starts_with(b"RIFF") && bytes.get(8..12) == Some(b"WEBP") {
        return Ok(PhotographFormat::Webp);
    }
    match other_image(bytes) {
        Some(name) => Err(PhotographError::UnsupportedFormat(format!("{name}; JPEG, PNG, TIFF and WebP are read"))),
        None => Err(PhotographError::Unreadable("its content is not that of a picture".into())),
    }
}

const PNG_SIGNATURE: &[u8] = b"\x89PNG\r\n\x1a\n";

/// Image kinds that are recognised only to tell people what they have.
fn other_image(bytes: &[u8]) -> Option<&'static str> {
    let brand = (bytes.get(4..8) == Some(b"ftyp")).then(|| bytes.get(8..12)).flatten();
    match brand {
        Some(b"avif" | b"avis") => return Some("AVIF"),
        Some(b"crx ") => return Some("Canon raw"),
        Some(b"heic" | b"heix" | b"heim" | b"heis" | b"hevc" | b"hevx" | b"mif1" | b"msf1") => return Some("HEIC"),
        _ => {}
    }
    let signatures: [(&[u8], &str); 7] = [
        (b"GIF8", "GIF"),
        (b"BM", "BMP"),
        (b"FUJIFILMCCD-RAW", "Fujifilm raw"),
        (b"\xff\x0a", "JPEG XL"),
        (b"\0\0\0\x0cJXL ", "JPEG XL"),
        (b"\0\0\0\x0cjP  ", "JPEG 2000"),
        (b"8BPS", "Photoshop"),
    ];
    signatures.iter().find(|(signature, _)| bytes.starts_with(signature)).map(|&(_, name)| name)
}

/// Refuses files that end before their picture does. Decoders can't be asked: most of them fill what is missing with grey.
pub(super) fn check_complete(bytes: &[u8], format: PhotographFormat) -> Result<(), PhotographError> {
    let complete = match format {
        PhotographFormat::Jpeg => jpeg::has_end(bytes),
        PhotographFormat::Png => png_has_end(bytes),
        PhotographFormat::Webp => bytes
            .get(4..8)
            .and_then(|len| len.try_into().ok())
            // The padding byte of the last chunk may be missing.
            .is_some_and(|len| bytes.len() as u64 + 1 >= u64::from(u32::from_le_bytes(len)) + 8),
        // Its parts may lie anywhere; the decoder fails on those it can't reach.
        PhotographFormat::Tiff => true,
    };
    if complete { Ok(()) } else { Err(PhotographError::Truncated("the end of the picture is missing".into())) }
}

/// Walks the chunks (length, type, data, checksum) to `IEND`.
fn png_has_end(bytes: &[u8]) -> bool {
    let mut at = PNG_SIGNATURE.len();
    while let Some(header) = bytes.get(at..).and_then(|rest| rest.first_chunk::<8>()) {
        if &header[4..] == b"IEND" {
            return true;
        }
        let len = u32::from_be_bytes([header[0], header[1], header[2], header[3]]);
        let Some(next) = at.checked_add(12 + len as usize) else { return false };
        at = next;
    }
    false
}
