//! Files out of the store: entity tags, conditional requests and ranges (RFC 9110).

use std::io::SeekFrom;
use std::path::Path;

use axum::body::Body;
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::response::{IntoResponse, Response};
use tokio::io::{AsyncReadExt, AsyncSeekExt};
use tokio_util::io::ReaderStream;

use super::problem::{Code, Problem};

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
    let (status, from, length) = match part(headers, &entity) {
        Part::Whole => (StatusCode::OK, 0, entity.size_bytes),
        Part::Range(from, length) => (StatusCode::PARTIAL_CONTENT, from, length),
        Part::Unsatisfiable => {
            let mut response = Problem::new(Code::RangeNotSatisfiable).into_response();
            let range = format!("bytes */{}", entity.size_bytes);
            response.headers_mut().insert(header::CONTENT_RANGE, text(&range));
            return Ok(response);
        }
    };
    let mut file = tokio::fs::File::open(entity.file).await?;
    if from > 0 {
        file.seek(SeekFrom::Start(from)).await?;
    }
    let stream = ReaderStream::with_capacity(file.take(length), CHUNK_BYTES);
    let mut response = (status, Body::from_stream(stream)).into_response();
    let headers = response.headers_mut();
    headers.insert(header::CONTENT_TYPE, HeaderValue::from_static(entity.media_type));
    headers.insert(header::CONTENT_LENGTH, HeaderValue::from(length));
    headers.insert(header::ETAG, text(&entity.etag));
    headers.insert(header::ACCEPT_RANGES, HeaderValue::from_static("bytes"));
    headers.insert(header::CACHE_CONTROL, HeaderValue::from_static("no-cache"));
    if status == StatusCode::PARTIAL_CONTENT {
        let range = format!("bytes {from}-{}/{}", from + length - 1, entity.size_bytes);
        headers.insert(header::CONTENT_RANGE, text(&range));
    }
    Ok(response)
}

fn text(value: &str) -> HeaderValue {
    HeaderValue::from_str(value).unwrap_or(HeaderValue::from_static(""))
}

fn part(headers: &HeaderMap, entity: &Entity<'_>) -> Part {
    let Some(range) = headers.get(header::RANGE).and_then(|value| value.to_str().ok()) else { return Part::Whole };
    // If-Range with anything but this very tag (a date, a weak tag): the client's part is of another file.
    if headers.get(header::IF_RANGE).is_some_and(|tag| tag.as_bytes() != entity.etag.as_bytes()) {
        return Part::Whole;
    }
    parse_range(range, entity.size_bytes)
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
