//! Files out of the store: entity tags, conditional requests and ranges (RFC 9110).

use std::future::ready;
use std::io::{self, SeekFrom};
use std::path::{Path, PathBuf};

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use bytes::Bytes;
use futures_util::stream::{self, Stream, StreamExt, TryStreamExt};
use tokio::fs::File;
use tokio::io::{AsyncReadExt, AsyncSeekExt, Take};
use tokio_util::io::ReaderStream;

use super::problem::{Code, Problem};
use crate::formats::stored_zip::{Piece, StoredFile, StoredZip};
use crate::store::db::job_outputs::JobOutputRow;

/// Bytes read at a time.
const CHUNK_BYTES: usize = 128 << 10;

/// A stored file as a client sees it.
pub(super) struct Entity<'a> {
    pub(super) file: &'a Path,
    pub(super) size_bytes: u64,
    /// With its quotes.
    pub(super) etag: String,
    pub(super) media_type: &'static str,
}

/// The part of a file that is asked for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Part {
    Whole,
    /// From, and how many bytes.
    Range(u64, u64),
    Unsatisfiable,
}

impl Part {
    /// From, and how many bytes.
    fn bounds(self, size_bytes: u64) -> Option<(u64, u64)> {
        match self {
            Self::Whole => Some((0, size_bytes)),
            Self::Range(from, length) => Some((from, length)),
            Self::Unsatisfiable => None,
        }
    }
}

/// A strong entity tag of a hash.
pub(super) fn etag(hash: &str) -> String {
    format!("\"{hash}\"")
}

/// Whether `If-None-Match` names this tag.
pub(super) fn not_modified(headers: &HeaderMap, etag: &str) -> bool {
    headers.get_all(header::IF_NONE_MATCH).iter().filter_map(|value| value.to_str().ok()).any(|value| {
        value.split(',').map(str::trim).any(|tag| tag == "*" || tag.strip_prefix("W/").unwrap_or(tag) == etag)
    })
}

/// The answer 304.
pub(super) fn unchanged(etag: &str) -> Response {
    (StatusCode::NOT_MODIFIED, [(header::ETAG, etag.to_owned())]).into_response()
}

/// Answers with the file, a part of it, or nothing when the client has it.
pub(super) async fn serve(headers: &HeaderMap, entity: Entity<'_>) -> Result<Response, Problem> {
    if not_modified(headers, &entity.etag) {
        return Ok(unchanged(&entity.etag));
    }
    let part = part(headers, &entity.etag, entity.size_bytes);
    let Some((from, length)) = part.bounds(entity.size_bytes) else {
        return Ok(unsatisfiable(entity.size_bytes));
    };
    let body = Body::from_stream(read(entity.file, from, length).await?);
    Ok(answer(part, body, entity.size_bytes, &entity.etag, entity.media_type))
}

/// `size_bytes` bytes of a file from `from` on.
async fn read(file: &Path, from: u64, size_bytes: u64) -> io::Result<ReaderStream<Take<File>>> {
    let mut file = File::open(file).await?;
    if from > 0 {
        file.seek(SeekFrom::Start(from)).await?;
    }
    Ok(ReaderStream::with_capacity(file.take(size_bytes), CHUNK_BYTES))
}

/// Files of a folder as one archive, or the part of it that is asked for. Nothing is read but what is sent.
pub(super) fn serve_archive(headers: &HeaderMap, folder: &Path, outputs: &[JobOutputRow]) -> Response {
    let mut names = blake3::Hasher::new();
    let mut entries = Vec::with_capacity(outputs.len());
    for output in outputs {
        names.update(output.blake3.as_bytes()).update(output.path.as_bytes()).update(b"\n");
        entries.push(StoredFile {
            name: output.path.clone(),
            size_bytes: u64::try_from(output.size_bytes).unwrap_or(0),
            crc32: output.crc32.unwrap_or(0),
        });
    }
    let etag = etag(&names.finalize().to_hex()[..32]);
    if not_modified(headers, &etag) {
        return unchanged(&etag);
    }
    let zip = StoredZip::new(&entries);
    let part = part(headers, &etag, zip.size_bytes());
    let Some((from, length)) = part.bounds(zip.size_bytes()) else { return unsatisfiable(zip.size_bytes()) };
    let files: Vec<PathBuf> = outputs.iter().map(|output| folder.join(&output.path)).collect();
    let pieces = stream::iter(zip.pieces(from, length)).then(move |piece| {
        let file = match &piece {
            Piece::File { index, .. } => files.get(*index).cloned().unwrap_or_default(),
            Piece::Bytes(_) => PathBuf::new(),
        };
        async move {
            Ok::<_, io::Error>(match piece {
                Piece::Bytes(bytes) => stream::once(ready(Ok(Bytes::from(bytes)))).left_stream(),
                Piece::File { from, size_bytes, .. } => {
                    whole_or_error(read(&file, from, size_bytes).await?, size_bytes).right_stream()
                }
            })
        }
    });
    answer(part, Body::from_stream(pieces.try_flatten()), zip.size_bytes(), &etag, "application/zip")
}

/// The same bytes, with an error in place of an end that comes too early: nobody must take a short archive for a whole one.
fn whole_or_error(
    bytes: impl Stream<Item = io::Result<Bytes>>,
    size_bytes: u64,
) -> impl Stream<Item = io::Result<Bytes>> {
    let mut left = size_bytes;
    let end = stream::once(ready(Ok(Bytes::new())));
    bytes.chain(end).map(move |chunk| {
        let chunk = chunk?;
        if chunk.is_empty() && left > 0 {
            return Err(io::ErrorKind::UnexpectedEof.into());
        }
        left -= chunk.len() as u64;
        Ok(chunk)
    })
}

fn unsatisfiable(size_bytes: u64) -> Response {
    let mut response = Problem::new(Code::RangeNotSatisfiable).into_response();
    response.headers_mut().insert(header::CONTENT_RANGE, text(&format!("bytes */{size_bytes}")));
    response
}

fn answer(part: Part, body: Body, size_bytes: u64, etag: &str, media_type: &'static str) -> Response {
    let mut response = body.into_response();
    let length = part.bounds(size_bytes).map_or(0, |(_, length)| length);
    if let Part::Range(from, length) = part {
        *response.status_mut() = StatusCode::PARTIAL_CONTENT;
        let range = format!("bytes {from}-{}/{size_bytes}", from + length - 1);
        response.headers_mut().insert(header::CONTENT_RANGE, text(&range));
    }
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(media_type));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    headers.insert(header::ETAG, text(etag));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    response
}

fn text(value: &str) -> HeaderValue {
    HeaderValue::from_str(value).unwrap_or(HeaderValue::from_static(""))
}

fn part(headers: &HeaderMap, etag: &str, size_bytes: u64) -> Part {
    let Some(range) = headers.get(header::RANGE).and_then(|value| value.to_str().ok()) else { return Part::Whole };
    // If-Range with anything but this very tag (a date, a weak tag): the client's part is of another file.
    if headers.get(header::IF_RANGE).is_some_and(|tag| tag.as_bytes() != etag.as_bytes()) {
        return Part::Whole;
    }
    parse_range(range, size_bytes)
}

/// One range in bytes. What can't be understood, other units and several ranges at once are ignored, as the standard allows.
fn parse_range(range: &str, size_bytes: u64) -> Part {
    let Some((unit, range)) = range.split_once('=') else { return Part::Whole };
    let Some((first, last)) = range.trim().split_once('-') else { return Part::Whole };
    let digits = |s: &str| s.bytes().all(|byte| byte.is_ascii_digit());
    if !unit.trim().eq_ignore_ascii_case("bytes") || !digits(first) || !digits(last) {
        return Part::Whole;
    }
    match (first.parse::<u64>(), last.parse::<u64>()) {
        (Ok(first), _) if first >= size_bytes => Part::Unsatisfiable,
        (Ok(first), Ok(last)) if last < first => Part::Whole,
        (Ok(first), Ok(last)) => Part::Range(first, last.min(size_bytes - 1) - first + 1),
        (Ok(first), Err(_)) if last.is_empty() => Part::Range(first, size_bytes - first),
        // The last so many bytes.
        (Err(_), Ok(0)) if first.is_empty() => Part::Unsatisfiable,
        (Err(_), Ok(_)) if first.is_empty() && size_bytes == 0 => Part::Unsatisfiable,
        (Err(_), Ok(last)) if first.is_empty() => Part::Range(size_bytes - last.min(size_bytes), last.min(size_bytes)),
        _ => Part::Whole,
    }
}

/// The media type that goes with a file's extension.
pub(super) fn media_type_of(path: &str) -> &'static str {
    match path.rsplit_once('.').map_or("", |(_, extension)| extension) {
        "html" => "text/html; charset=utf-8",
        "css" => "text/css; charset=utf-8",
        "js" | "mjs" => "text/javascript; charset=utf-8",
        "json" => "application/json",
        "svg" => "image/svg+xml",
        "png" => "image/png",
        "jpg" | "jpeg" => "image/jpeg",
        "webp" => "image/webp",
        "ico" => "image/vnd.microsoft.icon",
        "woff2" => "font/woff2",
        "txt" | "out" | "md" => "text/plain; charset=utf-8",
        "yaml" => "application/yaml",
        "zip" => "application/zip",
        "ply" => "model/ply",
        _ => "application/octet-stream",
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ranges_are_cut_to_the_file() {
        for (range, part) in [
            ("bytes=0-9", Part::Range(0, 10)),
            ("bytes=90-", Part::Range(90, 10)),
            ("bytes=90-1000", Part::Range(90, 10)),
            ("bytes=-5", Part::Range(95, 5)),
            ("bytes=-500", Part::Range(0, 100)),
            ("bytes=100-", Part::Unsatisfiable),
            ("bytes=100-200", Part::Unsatisfiable),
            ("bytes=-0", Part::Unsatisfiable),
            ("bytes=5-4", Part::Whole),
            ("bytes=0-1,5-6", Part::Whole),
            ("lines=0-1", Part::Whole),
            ("bytes=a-b", Part::Whole),
            ("bytes=-", Part::Whole),
            ("bytes=99999999999999999999-", Part::Whole),
            ("", Part::Whole),
        ] {
            assert_eq!(parse_range(range, 100), part, "{range}");
        }
        assert_eq!(parse_range("bytes=0-", 0), Part::Unsatisfiable);
        assert_eq!(parse_range("bytes=-5", 0), Part::Unsatisfiable);
    }
}
