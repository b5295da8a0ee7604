//! Ending uploads.

use super::client::Tus;
use crate::service::files_below;

#[tokio::test(flavor = "multi_thread")]
async fn an_ended_upload_is_gone() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    tus.patch(&upload, 0, b"12345").await.expect(204);
    tus.send("DELETE", &upload, &[], None).await.expect(204);
    tus.head(&upload).await.expect_one_of(&[404, 410]);
    tus.patch(&upload, 5, b"x").await.expect_one_of(&[404, 410]);
    tus.send("DELETE", &upload, &[], None).await.expect_one_of(&[404, 410]);
    if let Some((service, _)) = &tus.own {
        assert_eq!(files_below(&service.data_dir().join("uploads")), [""; 0], "its bytes are gone, too");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn ending_nothing_is_refused() {
    let tus = Tus::start().await;
    let missing = format!("{}/00000000-0000-7000-8000-000000000000", tus.endpoint);
    tus.send("DELETE", &missing, &[], None).await.expect_one_of(&[404, 410]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_complete_upload_may_be_ended_and_its_photograph_stays() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "5")]).await;
    tus.patch(&upload, 0, b"hello").await.expect(204);
    tus.send("DELETE", &upload, &[], None).await.expect(204);
    tus.head(&upload).await.expect_one_of(&[404, 410]);
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"hello");
    }
}
