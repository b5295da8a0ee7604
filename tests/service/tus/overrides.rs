//! `X-HTTP-Method-Override`, for senders who know only POST.

use super::client::{BYTES, Tus};

const OVERRIDE: &str = "x-http-method-override";

#[tokio::test(flavor = "multi_thread")]
async fn post_as_patch_brings_bytes() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let headers = [(OVERRIDE, "PATCH"), BYTES, ("upload-offset", "0")];
    let answer = tus.send("POST", &upload, &headers, Some(b"hello")).await.expect(204);
    assert_eq!(answer.offset(), 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn post_as_delete_ends_an_upload() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    tus.send("POST", &upload, &[(OVERRIDE, "DELETE")], None).await.expect(204);
    tus.head(&upload).await.expect_one_of(&[404, 410]);
}

#[tokio::test(flavor = "multi_thread")]
async fn post_as_head_tells_the_offset() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let answer = tus.send("POST", &upload, &[(OVERRIDE, "HEAD")], None).await.expect_one_of(&[200, 204]);
    assert_eq!(answer.offset(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn post_as_options_needs_no_version() {
    let tus = Tus::start().await;
    let headers = [(OVERRIDE, "OPTIONS"), ("tus-resumable", "")];
    let answer = tus.send("POST", &tus.endpoint, &headers, None).await.expect_one_of(&[200, 204]);
    assert_eq!(answer.header("tus-version"), Some("1.0.0"));
}

#[tokio::test(flavor = "multi_thread")]
async fn post_as_something_else_is_405() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    tus.send("POST", &upload, &[(OVERRIDE, "BREW")], None).await.expect(405);
    tus.send("POST", &upload, &[], None).await.expect(405);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_overridden_patch_obeys_the_same_rules() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    let send = async |headers: &[(&str, &str)]| tus.send("POST", &upload, headers, Some(b"x")).await.status;
    assert_eq!(send(&[(OVERRIDE, "PATCH"), ("upload-offset", "0")]).await, 415);
    assert_eq!(send(&[(OVERRIDE, "PATCH"), BYTES, ("upload-offset", "3")]).await, 409);
    assert_eq!(send(&[(OVERRIDE, "PATCH"), BYTES, ("upload-offset", "0"), ("tus-resumable", "2")]).await, 412);
}
