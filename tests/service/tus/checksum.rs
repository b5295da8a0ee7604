//! Checksums over the bytes of one request.

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use sha1::Digest;

use super::client::{BYTES, Tus, pattern};

fn sha1(bytes: &[u8]) -> String {
    format!("sha1 {}", BASE64_STANDARD.encode(sha1::Sha1::digest(bytes)))
}

fn sha256(bytes: &[u8]) -> String {
    format!("sha256 {}", BASE64_STANDARD.encode(sha2::Sha256::digest(bytes)))
}

#[tokio::test(flavor = "multi_thread")]
async fn options_lists_sha1() {
    let tus = Tus::start().await;
    let answer = tus.send("OPTIONS", &tus.endpoint, &[], None).await;
    assert!(answer.header("tus-checksum-algorithm").unwrap().split(',').any(|name| name == "sha1"));
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_fit_are_taken() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "11")]).await;
    // The example of the protocol's text.
    let known = "sha1 Kq5sNclPz7QV2+lfQIuc6R7oRu0=";
    assert_eq!(sha1(b"hello world"), known);
    tus.patch_with(&upload, 0, &[("upload-checksum", known)], b"hello world").await.expect(204);
    let bytes = pattern(300_000);
    let upload = tus.create(&[("upload-length", "300000")]).await;
    tus.patch_with(&upload, 0, &[("upload-checksum", &sha256(&bytes))], &bytes).await.expect(204);
    assert_eq!(tus.head(&upload).await.offset(), 300_000);
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_do_not_fit_are_460_and_discarded() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "11")]).await;
    for wrong in [sha1(b"hello wordl"), sha256(b"other")] {
        tus.patch_with(&upload, 0, &[("upload-checksum", &wrong)], b"hello world").await.expect(460);
        assert_eq!(tus.head(&upload).await.offset(), 0);
    }
    tus.patch_with(&upload, 0, &[("upload-checksum", &sha1(b"hello"))], b"hello").await.expect(204);
    tus.patch_with(&upload, 5, &[("upload-checksum", &sha1(b"x"))], b" world").await.expect(460);
    tus.patch(&upload, 5, b" world").await.expect(204);
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"hello world");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_unknown_algorithm_is_400() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    for value in ["crc7 AAAA", "sha1", "sha1 !!", "sha1 AAAA", "SHA-1 Kq5sNclPz7QV2+lfQIuc6R7oRu0="] {
        tus.patch_with(&upload, 0, &[("upload-checksum", value)], b"hello").await.expect(400);
    }
    assert_eq!(tus.head(&upload).await.offset(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_creation_with_bytes_is_checked_too() {
    let tus = Tus::start().await;
    let headers =
        |checksum: String| [("upload-length".to_owned(), "5".to_owned()), ("upload-checksum".to_owned(), checksum)];
    for (checksum, status) in [(sha1(b"hello"), 201), (sha1(b"hellx"), 460)] {
        let headers = headers(checksum);
        let mut all: Vec<_> = headers.iter().map(|(name, value)| (name.as_str(), value.as_str())).collect();
        all.push(BYTES);
        tus.post(&all, Some(b"hello")).await.expect(status);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_that_could_not_be_checked_do_not_count() {
    use tokio::io::AsyncWriteExt;
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "11")]).await;
    let mut broken = tus.begin_patch(&upload, 0, 11, &[("upload-checksum", &sha1(b"hello world"))]).await;
    broken.write_all(b"hello").await.unwrap();
    drop(broken);
    tokio::time::sleep(std::time::Duration::from_millis(200)).await;
    assert_eq!(tus.head(&upload).await.offset(), 0);
}
