//! Headers of tus requests, each refusal naming the header.

use axum::http::{HeaderMap, HeaderName};
use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha1::Sha1;
use sha2::{Digest, Sha256};
use uuid::Uuid;

use super::{UPLOAD_CHECKSUM, UPLOAD_CONCAT, UPLOAD_DEFER_LENGTH, UPLOAD_LENGTH, UPLOAD_METADATA, UPLOAD_OFFSET};
use crate::http::problem::{Code, Problem};
use crate::store::ImagePath;

/// Partial uploads that may be put together at once.
const MAX_PARTS: usize = 1000;

fn refused(header: &HeaderName, why: &str) -> Problem {
    Problem::new(Code::InvalidUpload).detail(format!("{header}: {why}"))
}

fn text<'a>(headers: &'a HeaderMap, name: &HeaderName) -> Result<Option<&'a str>, Problem> {
    match headers.get(name) {
        None => Ok(None),
        Some(value) => value.to_str().map(|value| Some(value.trim())).map_err(|_| refused(name, "must be plain ASCII")),
    }
}

/// A count of bytes; one too large to count is too large for anything else, too.
fn bytes(headers: &HeaderMap, name: &HeaderName) -> Result<Option<u64>, Problem> {
    let Some(value) = text(headers, name)? else { return Ok(None) };
    if value.is_empty() || !value.bytes().all(|byte| byte.is_ascii_digit()) {
        return Err(refused(name, "must be a number of bytes"));
    }
    Ok(Some(value.parse().unwrap_or(u64::MAX)))
}

/// The offset a sender goes on from.
pub(in crate::http) fn offset(headers: &HeaderMap) -> Result<u64, Problem> {
    bytes(headers, &UPLOAD_OFFSET)?.ok_or_else(|| refused(&UPLOAD_OFFSET, "is missing"))
}

/// The length a sender announces.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::http) enum Length {
    Known(u64),
    Deferred,
}

impl Length {
    /// Reads the length of a new upload.
    pub(in crate::http) fn of_new(headers: &HeaderMap) -> Result<Self, Problem> {
        let deferred = match text(headers, &UPLOAD_DEFER_LENGTH)? {
            None => false,
            Some("1") => true,
            Some(_) => return Err(refused(&UPLOAD_DEFER_LENGTH, "must be 1")),
        };
        match (bytes(headers, &UPLOAD_LENGTH)?, deferred) {
            (Some(length), false) => Ok(Self::Known(length)),
            (None, true) => Ok(Self::Deferred),
            (Some(_), true) => Err(refused(&UPLOAD_LENGTH, "is given and deferred at once")),
            (None, false) => Err(refused(&UPLOAD_LENGTH, "is missing")),
        }
    }

    /// Reads the length that a later request may bring.
    pub(in crate::http) fn of_later(headers: &HeaderMap) -> Result<Option<u64>, Problem> {
        bytes(headers, &UPLOAD_LENGTH)
    }
}

/// What a new upload is for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::http) enum Concat {
    Partial,
    /// Of these uploads, in this order.
    Final(Vec<Uuid>),
}

impl Concat {
    pub(in crate::http) fn of(headers: &HeaderMap) -> Result<Option<Self>, Problem> {
        let Some(value) = text(headers, &UPLOAD_CONCAT)? else { return Ok(None) };
        if value == "partial" {
            return Ok(Some(Self::Partial));
        }
        let Some(list) = value.strip_prefix("final;") else {
            return Err(refused(&UPLOAD_CONCAT, "must be `partial` or `final;` and a list of uploads"));
        };
        let parts: Option<Vec<Uuid>> =
            list.split_ascii_whitespace().map(|address| address.rsplit('/').next()?.parse().ok()).collect();
        match parts {
            Some(parts) if (1..=MAX_PARTS).contains(&parts.len()) => Ok(Some(Self::Final(parts))),
            Some(_) => Err(refused(&UPLOAD_CONCAT, "must list from 1 to 1000 uploads")),
            None => Err(refused(&UPLOAD_CONCAT, "lists what is no upload")),
        }
    }
}

/// Where a complete upload goes.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(in crate::http) struct Target {
    pub(in crate::http) dataset: Uuid,
    pub(in crate::http) path: ImagePath,
}

impl Target {
    /// Out of the metadata: the keys `dataset`, and `path` or else `filename`.
    pub(in crate::http) fn of(headers: &HeaderMap) -> Result<Self, Problem> {
        let pairs = metadata(headers)?;
        let value = |key: &str| pairs.iter().find(|(name, _)| name == key).map(|(_, value)| value.as_slice());
        let missing = |key: &str| refused(&UPLOAD_METADATA, &format!("the key `{key}` is missing"));
        let dataset = value("dataset").ok_or_else(|| missing("dataset"))?;
        let dataset = std::str::from_utf8(dataset).ok().and_then(|id| id.parse().ok());
        let dataset = dataset.ok_or_else(|| Problem::new(Code::DatasetNotFound))?;
        let name = value("path").or_else(|| value("filename")).ok_or_else(|| missing("path"))?;
        let name = std::str::from_utf8(name)
            .map_err(|_| Problem::file_name(&String::from_utf8_lossy(name), crate::store::InvalidFileName::Encoding))?;
        let path = ImagePath::parse(name).map_err(|why| Problem::file_name(name, why))?;
        if !path.is_photograph() {
            return Err(Problem::new(Code::InvalidFileName).detail("by its name this is no photograph").path(name));
        }
        Ok(Self { dataset, path })
    }
}

/// The pairs of the metadata header.
pub(in crate::http) fn metadata(headers: &HeaderMap) -> Result<Vec<(String, Vec<u8>)>, Problem> {
    let Some(header) = text(headers, &UPLOAD_METADATA)? else { return Ok(Vec::new()) };
    let mut pairs: Vec<(String, Vec<u8>)> = Vec::new();
    if header.is_empty() {
        return Ok(pairs);
    }
    for pair in header.split(',') {
        let mut words = pair.split_ascii_whitespace();
        let (Some(key), value, None) = (words.next(), words.next(), words.next()) else {
            return Err(refused(&UPLOAD_METADATA, "must be pairs of a key and a value, with commas between"));
        };
        let value = BASE64_STANDARD
            .decode(value.unwrap_or(""))
            .map_err(|_| refused(&UPLOAD_METADATA, &format!("the value of `{key}` is not base64")))?;
        if pairs.iter().any(|(there, _)| there == key) {
            return Err(refused(&UPLOAD_METADATA, &format!("the key `{key}` is there twice")));
        }
        pairs.push((key.to_owned(), value));
    }
    Ok(pairs)
}

/// A checksum over the bytes of one request, on its way.
pub(in crate::http) struct Checksum {
    running: Running,
    expected: Vec<u8>,
}

enum Running {
    Sha1(Sha1),
    Sha256(Sha256),
}

impl Checksum {
    pub(in crate::http) fn of(headers: &HeaderMap) -> Result<Option<Self>, Problem> {
        let Some(value) = text(headers, &UPLOAD_CHECKSUM)? else { return Ok(None) };
        let (algorithm, expected) = value
            .split_once(' ')
            .ok_or_else(|| refused(&UPLOAD_CHECKSUM, "must be an algorithm and a checksum in base64"))?;
        let (running, length) = match algorithm {
            "sha1" => (Running::Sha1(Sha1::new()), 20),
            "sha256" => (Running::Sha256(Sha256::new()), 32),
            _ => return Err(refused(&UPLOAD_CHECKSUM, "the algorithm is not known here")),
        };
        match BASE64_STANDARD.decode(expected.trim()) {
            Ok(expected) if expected.len() == length => Ok(Some(Self { running, expected })),
            _ => Err(refused(&UPLOAD_CHECKSUM, "the checksum is not base64 or has the wrong length")),
        }
    }

    pub(super) fn update(&mut self, bytes: &[u8]) {
        match &mut self.running {
            Running::Sha1(hash) => hash.update(bytes),
            Running::Sha256(hash) => hash.update(bytes),
        }
    }

    /// Whether the bytes were those the sender meant.
    pub(super) fn holds(self) -> bool {
        match self.running {
            Running::Sha1(hash) => hash.finalize().as_slice() == self.expected,
            Running::Sha256(hash) => hash.finalize().as_slice() == self.expected,
        }
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use axum::http::HeaderValue;
    use proptest::prelude::*;

    use super::*;

    fn headers(name: HeaderName, value: &[u8]) -> HeaderMap {
        HeaderValue::from_bytes(value).map(|value| HeaderMap::from_iter([(name, value)])).unwrap_or_default()
    }

    #[test]
    fn metadata_is_pairs_of_keys_and_base64() {
        let read = |value: &str| metadata(&headers(UPLOAD_METADATA, value.as_bytes())).ok();
        let pair = |key: &str, value: &str| (key.to_owned(), value.as_bytes().to_vec());
        assert_eq!(read("a Yg==,is_empty , c ZA=="), Some(vec![pair("a", "b"), pair("is_empty", ""), pair("c", "d")]));
        assert_eq!(read(""), Some(vec![]));
        for wrong in ["a Yg==,a Yg==", "a !", ",", "a Yg== x", "a b c"] {
            assert_eq!(read(wrong), None, "{wrong}");
        }
    }

    proptest! {
        #[test]
        fn no_header_can_do_harm(value in prop::collection::vec(any::<u8>(), 0..80), text in "[a-z0-9;,/ =+-]{0,60}") {
            for value in [value.as_slice(), text.as_bytes()] {
                let _ = (Target::of(&headers(UPLOAD_METADATA, value)), Concat::of(&headers(UPLOAD_CONCAT, value)));
                let _ = (Checksum::of(&headers(UPLOAD_CHECKSUM, value)).is_ok(), offset(&headers(UPLOAD_OFFSET, value)));
                let _ = (Length::of_new(&headers(UPLOAD_LENGTH, value)), Length::of_new(&headers(UPLOAD_DEFER_LENGTH, value)));
            }
        }
    }
}
