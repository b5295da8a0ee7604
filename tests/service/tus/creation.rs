//! Creation, with bytes at once, and with the length told later.

use super::client::{BYTES, Tus, pattern};

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_is_made_and_has_an_address() {
    let tus = Tus::start().await;
    let answer = tus.post(&[("upload-length", "5")], None).await.expect(201);
    let upload = tus.address(&answer);
    let head = tus.head(&upload).await.expect_one_of(&[200, 204]);
    assert_eq!((head.offset(), head.header("upload-length")), (0, Some("5")));
}

#[tokio::test(flavor = "multi_thread")]
async fn two_uploads_have_two_addresses() {
    let tus = Tus::start().await;
    assert_ne!(tus.create(&[("upload-length", "5")]).await, tus.create(&[("upload-length", "5")]).await);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_length_that_is_missing_or_no_number_is_400() {
    let tus = Tus::start().await;
    tus.post(&[], None).await.expect(400);
    for length in ["-1", "x", "1.5", "1e3", "0x5"] {
        tus.post(&[("upload-length", length)], None).await.expect(400);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_length_beyond_the_limit_is_413() {
    let tus = Tus::start().await;
    let options = tus.send("OPTIONS", &tus.endpoint, &[], None).await;
    let most: u64 = options.header("tus-max-size").unwrap().parse().unwrap();
    tus.post(&[("upload-length", &(most + 1).to_string())], None).await.expect(413);
    tus.post(&[("upload-length", "99999999999999999999999")], None).await.expect(413);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_of_nothing_is_complete_at_once() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "0")]).await;
    let head = tus.head(&upload).await;
    assert_eq!((head.offset(), head.header("upload-length")), (0, Some("0")));
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn metadata_comes_back_as_it_was() {
    let tus = Tus::start().await;
    let metadata = format!("{},is_confidential,note 55+z", tus.metadata("神社/石段.jpg"));
    let upload =
        tus.create(&[("upload-length", "5"), ("upload-metadata", &metadata.replace("55+z", "NTUreg=="))]).await;
    let head = tus.head(&upload).await;
    assert_eq!(head.header("upload-metadata"), Some(metadata.replace("55+z", "NTUreg==").as_str()));
}

#[tokio::test(flavor = "multi_thread")]
async fn metadata_that_is_malformed_is_400() {
    let tus = Tus::start().await;
    let good = tus.fresh_metadata();
    for wrong in
        [format!("{good},a !!!"), format!("{good},a YQ==,a YQ=="), format!("{good},,"), format!("{good},a b c")]
    {
        tus.post(&[("upload-length", "5"), ("upload-metadata", &wrong)], None).await.expect(400);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn bytes_may_come_with_the_creation() {
    let tus = Tus::start().await;
    let bytes = pattern(50_000);
    let answer = tus.post(&[("upload-length", "50000"), BYTES], Some(&bytes)).await.expect(201);
    assert_eq!(answer.offset(), 50_000);
    assert_eq!(tus.head(&tus.address(&answer)).await.offset(), 50_000);
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), bytes);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_of_the_bytes_may_come_with_the_creation() {
    let tus = Tus::start().await;
    let answer = tus.post(&[("upload-length", "10"), BYTES], Some(b"1234")).await.expect(201);
    assert_eq!(answer.offset(), 4);
    let upload = tus.address(&answer);
    tus.patch(&upload, 4, b"567890").await.expect(204);
    let answer = tus.post(&[("upload-length", "10"), BYTES], Some(b"")).await.expect(201);
    assert_eq!(answer.offset(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_body_of_another_kind_is_no_upload() {
    let tus = Tus::start().await;
    let answer = tus.post(&[("upload-length", "4"), ("content-type", "text/plain")], Some(b"1234")).await;
    if answer.status == 201 {
        assert_eq!(tus.head(&tus.address(&answer)).await.offset(), 0);
    } else {
        answer.expect_one_of(&[400, 415]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_length_may_be_told_later() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-defer-length", "1")]).await;
    let head = tus.head(&upload).await;
    assert_eq!((head.header("upload-defer-length"), head.header("upload-length")), (Some("1"), None));
    tus.patch(&upload, 0, b"12345").await.expect(204);
    assert_eq!(tus.head(&upload).await.header("upload-defer-length"), Some("1"));
    tus.patch_with(&upload, 5, &[("upload-length", "8")], b"678").await.expect(204);
    let head = tus.head(&upload).await;
    assert_eq!((head.header("upload-defer-length"), head.header("upload-length")), (None, Some("8")));
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"12345678");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deferred_length_may_be_told_without_bytes() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-defer-length", "1")]).await;
    tus.patch(&upload, 0, b"12345").await.expect(204);
    tus.patch_with(&upload, 5, &[("upload-length", "5")], b"").await.expect(204);
    assert_eq!(tus.head(&upload).await.header("upload-length"), Some("5"));
}

#[tokio::test(flavor = "multi_thread")]
async fn deferring_takes_no_other_value_than_1() {
    let tus = Tus::start().await;
    for value in ["0", "2", "true", "x"] {
        tus.post(&[("upload-defer-length", value)], None).await.expect(400);
    }
    tus.post(&[("upload-defer-length", "1"), ("upload-length", "5")], None).await.expect(400);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_length_once_told_stays() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-defer-length", "1")]).await;
    tus.patch_with(&upload, 0, &[("upload-length", "10")], b"12345").await.expect(204);
    tus.patch_with(&upload, 5, &[("upload-length", "11")], b"6").await.expect(400);
    tus.patch_with(&upload, 5, &[("upload-length", "10")], b"6").await.expect(204);
    let shorter = tus.create(&[("upload-defer-length", "1")]).await;
    tus.patch(&shorter, 0, b"12345").await.expect(204);
    tus.patch_with(&shorter, 5, &[("upload-length", "3")], b"").await.expect(400);
}
