//! The core protocol: versions, HEAD, PATCH and their headers.

use super::client::{BYTES, Tus, pattern};

#[tokio::test(flavor = "multi_thread")]
async fn options_tells_what_is_spoken_without_a_version() {
    let tus = Tus::start().await;
    let answer = tus.send("OPTIONS", &tus.endpoint, &[("tus-resumable", "")], None).await.expect_one_of(&[200, 204]);
    assert_eq!(answer.header("tus-version"), Some("1.0.0"));
    assert_eq!(answer.header("tus-resumable"), Some("1.0.0"));
    assert!(answer.header("tus-max-size").is_some_and(|size| size.parse::<u64>().is_ok()));
}

#[tokio::test(flavor = "multi_thread")]
async fn options_lists_every_extension() {
    let tus = Tus::start().await;
    let answer = tus.send("OPTIONS", &tus.endpoint, &[], None).await;
    let extensions: Vec<_> = answer.header("tus-extension").unwrap().split(',').collect();
    for extension in [
        "creation",
        "creation-with-upload",
        "creation-defer-length",
        "expiration",
        "checksum",
        "termination",
        "concatenation",
    ] {
        assert!(extensions.contains(&extension), "{extensions:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn options_ignores_the_version_of_the_sender() {
    let tus = Tus::start().await;
    tus.send("OPTIONS", &tus.endpoint, &[("tus-resumable", "9.9.9")], None).await.expect_one_of(&[200, 204]);
}

#[tokio::test(flavor = "multi_thread")]
async fn another_version_is_412_and_nothing_happens() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let answer = tus.patch_with(&upload, 0, &[("tus-resumable", "0.2.2")], b"hello").await.expect(412);
    assert_eq!(answer.header("tus-version"), Some("1.0.0"));
    assert_eq!(tus.head(&upload).await.offset(), 0);
    let answer = tus.post(&[("tus-resumable", "0.2.2"), ("upload-length", "5")], None).await.expect(412);
    assert_eq!(answer.header("location"), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_version_is_412() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    for method in ["HEAD", "DELETE"] {
        tus.send(method, &upload, &[("tus-resumable", "")], None).await.expect(412);
    }
    tus.head(&upload).await.expect_one_of(&[200, 204]);
}

#[tokio::test(flavor = "multi_thread")]
async fn every_answer_names_the_version() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let missing = format!("{}/00000000-0000-7000-8000-000000000000", tus.endpoint);
    for answer in [
        tus.post(&[("upload-length", "5")], None).await,
        tus.post(&[("upload-length", "x")], None).await,
        tus.head(&upload).await,
        tus.head(&missing).await,
        tus.patch(&upload, 3, b"x").await,
        tus.patch(&upload, 0, b"x").await,
        tus.send("PATCH", &upload, &[("upload-offset", "1")], Some(b"x")).await,
        tus.send("DELETE", &upload, &[], None).await,
    ] {
        assert_eq!(answer.header("tus-resumable"), Some("1.0.0"), "{answer:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn head_tells_offset_and_length_and_is_never_kept() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    tus.patch(&upload, 0, b"1234").await.expect(204);
    let answer = tus.head(&upload).await.expect_one_of(&[200, 204]);
    assert_eq!((answer.header("upload-offset"), answer.header("upload-length")), (Some("4"), Some("10")));
    assert_eq!(answer.header("cache-control"), Some("no-store"));
    assert!(answer.body.is_empty());
}

#[tokio::test(flavor = "multi_thread")]
async fn head_of_nothing_has_no_offset() {
    let tus = Tus::start().await;
    for id in ["00000000-0000-7000-8000-000000000000", "nothing", "..%2f..%2fmultistage.db"] {
        let answer = tus.head(&format!("{}/{id}", tus.endpoint)).await.expect_one_of(&[403, 404, 410]);
        assert_eq!(answer.header("upload-offset"), None);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn patch_of_nothing_is_refused() {
    let tus = Tus::start().await;
    let missing = format!("{}/00000000-0000-7000-8000-000000000000", tus.endpoint);
    tus.patch(&missing, 0, b"x").await.expect_one_of(&[403, 404, 410]);
}

#[tokio::test(flavor = "multi_thread")]
async fn patch_of_another_media_type_is_415() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    for media_type in ["application/octet-stream", "text/plain", ""] {
        let headers = [("content-type", media_type), ("upload-offset", "0")];
        tus.send("PATCH", &upload, &headers, Some(b"hello")).await.expect(415);
    }
    assert_eq!(tus.head(&upload).await.offset(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn patch_answers_with_the_new_offset() {
    let tus = Tus::start().await;
    let bytes = pattern(100_000);
    let upload = tus.create(&[("upload-length", "100000")]).await;
    let mut offset = 0;
    for piece in bytes.chunks(30_000) {
        let answer = tus.patch(&upload, offset, piece).await.expect(204);
        offset += piece.len() as u64;
        assert_eq!(answer.offset(), offset);
    }
    assert_eq!(tus.head(&upload).await.offset(), 100_000);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_patch_of_nothing_changes_nothing() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    assert_eq!(tus.patch(&upload, 0, b"").await.expect(204).offset(), 0);
    tus.patch(&upload, 0, b"hello").await.expect(204);
    assert_eq!(tus.patch(&upload, 5, b"").await.expect(204).offset(), 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn no_byte_beyond_the_length_is_taken() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let answer = tus.patch(&upload, 0, b"hello world").await;
    assert!((400..500).contains(&answer.status), "{answer:?}");
    assert!(tus.head(&upload).await.offset() <= 5);
    let chunked = tus.create(&[("upload-length", "5")]).await;
    // Without a content length the server only notices on the way.
    let stream = futures_util::stream::iter((0..40).map(|_| Ok::<_, std::io::Error>(pattern(1000))));
    let request = reqwest::Client::new()
        .patch(&chunked)
        .header("tus-resumable", "1.0.0")
        .header(BYTES.0, BYTES.1)
        .header("upload-offset", "0")
        .body(reqwest::Body::wrap_stream(stream));
    if let Ok(answer) = request.send().await {
        assert!(answer.status().is_client_error());
    }
    assert!(tus.head(&chunked).await.offset() <= 5);
}
