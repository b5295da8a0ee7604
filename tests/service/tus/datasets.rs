//! What only Multistage promises: a complete upload is a photograph of its dataset, once.

use serde_json::json;

use super::client::{BYTES, Tus, pattern};
use crate::service::{files_below, photographs};

#[tokio::test(flavor = "multi_thread")]
async fn a_complete_upload_is_a_photograph_of_its_dataset() {
    let tus = Tus::start_own(|_| {}).await;
    let (service, dataset) = tus.own.as_ref().unwrap();
    let bytes = pattern(200_000);
    let metadata = tus.metadata("north face/石 1.JPG");
    let upload = tus.create(&[("upload-length", "200000"), ("upload-metadata", &metadata)]).await;
    tus.patch(&upload, 0, &bytes[..150_000]).await.expect(204);
    let list = format!("/api/v1/datasets/{dataset}/images");
    assert_eq!(service.get(&list).await.ok(200)["images"], json!([]), "half a photograph is none");
    tus.patch(&upload, 150_000, &bytes[150_000..]).await.expect(204);
    assert_eq!(tus.stored("north face/石 1.JPG").unwrap(), bytes);
    let images = service.get(&list).await.ok(200);
    assert_eq!(images["images"][0]["path"], "north face/石 1.JPG");
    assert_eq!(files_below(&service.data_dir().join("uploads")), [""; 0]);
    assert_eq!(files_below(&service.data_dir().join("incoming")), [""; 0]);
    let job = service.post_json("/api/v1/jobs", &json!({ "dataset_id": dataset })).await.ok(202);
    service.wait_state(&job, "succeeded").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn the_same_photograph_again_is_stored_once_and_another_is_a_conflict() {
    let tus = Tus::start_own(|_| {}).await;
    let metadata = tus.metadata("a.jpg");
    let create =
        async |length: &str| tus.post(&[("upload-length", length), ("upload-metadata", &metadata)], None).await;
    for _ in 0..2 {
        let upload = tus.address(&create("5").await.expect(201));
        tus.patch(&upload, 0, b"hello").await.expect(204);
    }
    create("6").await.expect(422);
    let upload = tus.address(&create("5").await.expect(201));
    tus.patch(&upload, 0, b"jello").await.expect(422);
    tus.head(&upload).await.expect(404);
    assert_eq!(tus.stored("a.jpg").unwrap(), b"hello");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_needs_a_dataset_and_a_photographs_name() {
    let tus = Tus::start_own(|_| {}).await;
    let b64 = |text: &str| {
        use base64::Engine;
        base64::prelude::BASE64_STANDARD.encode(text)
    };
    let nowhere = format!("dataset {},path {}", b64("00000000-0000-7000-8000-000000000000"), b64("a.jpg"));
    let dataset = format!("dataset {}", b64(&tus.own.as_ref().unwrap().1));
    for (metadata, status) in [
        (String::new(), 400),
        (dataset.clone(), 400),
        (format!("path {}", b64("a.jpg")), 400),
        (format!("dataset {},path {}", b64("x"), b64("a.jpg")), 404),
        (nowhere, 404),
        (format!("{dataset},path {}", b64("../a.jpg")), 422),
        (format!("{dataset},path {}", b64("/etc/a.jpg")), 422),
        (format!("{dataset},path {}", b64("a\0.jpg")), 422),
        (format!("{dataset},path {}", b64("a.exe")), 422),
        (format!("{dataset},path //79"), 422),
        (format!("{dataset},filename {}", b64("a.jpg")), 201),
    ] {
        let answer = tus.post(&[("upload-length", "5"), ("upload-metadata", &metadata)], None).await;
        assert_eq!(answer.status, status, "{metadata}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dataset_in_use_takes_the_photograph_later() {
    let tus = Tus::start_own(|_| {}).await;
    let (service, dataset) = tus.own.as_ref().unwrap();
    service.post_form(&format!("/api/v1/datasets/{dataset}/images"), photographs(["a.jpg"])).await.ok(200);
    let upload = tus.create(&[("upload-length", "5")]).await;
    let new = json!({"dataset_id": dataset, "options": {"mode": "hang"}});
    let job = service.post_json("/api/v1/jobs", &new).await.ok(202);
    service.wait_hanging(&job).await;
    tus.post(&[("upload-length", "5")], None).await.expect(409);
    tus.post(&[("upload-length", "5"), BYTES], Some(b"hello")).await.expect(409);
    tus.patch(&upload, 0, b"hello").await.expect(409);
    // A sender that was told of all its bytes would think that all is well.
    tus.head(&upload).await.expect(409);
    service.post(job["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&job, "cancelled").await;
    assert_eq!(tus.head(&upload).await.expect(200).offset(), 5);
    assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"hello");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deleted_dataset_takes_its_uploads_along() {
    let tus = Tus::start_own(|_| {}).await;
    let (service, dataset) = tus.own.as_ref().unwrap();
    let upload = tus.create(&[("upload-length", "10")]).await;
    tus.patch(&upload, 0, b"hello").await.expect(204);
    service.delete(&format!("/api/v1/datasets/{dataset}")).await.ok(204);
    tus.head(&upload).await.expect(404);
    tus.patch(&upload, 5, b"world").await.expect(404);
}

#[tokio::test(flavor = "multi_thread")]
async fn open_uploads_survive_a_restart() {
    let mut tus = Tus::start_own(|_| {}).await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    tus.patch(&upload, 0, b"hello").await.expect(204);
    let (service, dataset) = tus.own.take().unwrap();
    let service = crate::service::Service::start_in(service.stop().await, |_| {}).await;
    let upload = upload.replace(&tus.endpoint, &format!("{}/api/v1/uploads", service.base));
    tus.own = Some((service, dataset));
    assert_eq!(tus.head(&upload).await.offset(), 5);
    tus.patch(&upload, 5, b"world").await.expect(204);
    assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"helloworld");
}
