//! Expiration, with short times.

use std::time::Duration;

use super::client::Tus;

#[tokio::test(flavor = "multi_thread")]
async fn an_unfinished_upload_tells_when_it_goes() {
    let tus = Tus::start().await;
    let answer = tus.post(&[("upload-length", "10")], None).await.expect(201);
    let upload = tus.address(&answer);
    let patched = tus.patch(&upload, 0, b"12345").await.expect(204);
    for date in [answer.header("upload-expires"), patched.header("upload-expires")] {
        let date = date.expect("a date");
        let time = jiff::fmt::rfc2822::DateTimeParser::new().parse_timestamp(date).expect(date);
        assert!(date.ends_with("GMT") && time > jiff::Timestamp::now(), "{date}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_expired_upload_is_gone() {
    let tus = Tus::start_own(|config| config.upload_expiry = Duration::from_millis(300)).await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    tokio::time::sleep(Duration::from_millis(400)).await;
    assert_eq!(tus.head(&upload).await.expect(410).header("upload-offset"), None);
    tus.patch(&upload, 0, b"x").await.expect(410);
    tus.send("DELETE", &upload, &[], None).await.expect(410);
}

#[tokio::test(flavor = "multi_thread")]
async fn every_byte_prolongs_the_time() {
    let tus = Tus::start_own(|config| config.upload_expiry = Duration::from_millis(1500)).await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    for at in 0..4 {
        tokio::time::sleep(Duration::from_millis(600)).await;
        tus.patch(&upload, at, b"x").await.expect(204);
    }
    assert_eq!(tus.head(&upload).await.offset(), 4);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_photograph_that_is_stored_outlives_its_upload() {
    let tus = Tus::start_own(|config| config.upload_expiry = Duration::from_millis(300)).await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let answer = tus.patch(&upload, 0, b"hello").await.expect(204);
    assert_eq!(answer.header("upload-expires"), None, "nothing about it will go");
    tokio::time::sleep(Duration::from_millis(400)).await;
    tus.head(&upload).await.expect(410);
    assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"hello");
}
