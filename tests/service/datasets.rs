//! `/api/v1/datasets`

use serde_json::{Value, json};

use crate::jobs::archive;
use crate::service::{Service, file, files_below, photographs};

async fn dataset(service: &Service) -> (Value, String) {
    let answer = service.post_json("/api/v1/datasets", &json!({"name": "Roll 1"})).await;
    assert!(answer.header("location").starts_with("/api/v1/datasets/"));
    let dataset = answer.ok(201);
    let images = dataset["links"]["images"].as_str().unwrap().to_owned();
    (dataset, images)
}

#[tokio::test(flavor = "multi_thread")]
async fn sending_photographs_again_changes_nothing() {
    let service = Service::start().await;
    let (dataset, images) = dataset(&service).await;
    let first = service.post_form(&images, photographs(["a.jpg", "x/b.png", "notes.txt"])).await.ok(200);
    assert_eq!((&first["stored"], &first["unchanged"]), (&json!(2), &json!(0)));
    assert_eq!(first["ignored"], json!(["notes.txt"]));
    let again = service.post_form(&images, photographs(["x/b.png", "a.jpg", "c.jpg"])).await.ok(200);
    assert_eq!((&again["stored"], &again["unchanged"]), (&json!(1), &json!(2)));
    assert_eq!((&again["dataset"]["images"], &again["dataset"]["size_bytes"]), (&json!(3), &json!(5 + 7 + 5)));

    let other = photographs(["d.jpg"]).part("images", file("a.jpg", b"other")).part("images", file("e.jpg", b"e"));
    let answer = service.post_form(&images, other).await;
    answer.assert_problem(409, "file_conflict");
    assert_eq!(answer.json()["path"], "a.jpg");
    let listed = service.get(&format!("{images}?limit=1000")).await.ok(200);
    let paths: Vec<_> = listed["images"].as_array().unwrap().iter().map(|image| &image["path"]).collect();
    assert_eq!(paths, ["a.jpg", "c.jpg", "d.jpg", "x/b.png"], "what came before the conflict stays");
    let folder = service.data_dir().join("datasets").join(dataset["id"].as_str().unwrap());
    assert_eq!(files_below(&folder), ["images/a.jpg", "images/c.jpg", "images/d.jpg", "images/x/b.png"]);
    assert_eq!(std::fs::read(folder.join("images/a.jpg")).unwrap(), b"a.jpg");
}

#[tokio::test(flavor = "multi_thread")]
async fn photographs_are_listed_in_pages_with_their_hash() {
    let service = Service::start().await;
    let (_, images) = dataset(&service).await;
    let form = photographs([])
        .part("archive", file("x.zip", &archive(&[("b.jpg", b"abc"), ("é/a b.jpg", b"2"), ("c.jpg", b"")])));
    service.post_form(&images, form).await.ok(200);
    let page = service.get(&format!("{images}?limit=2")).await.ok(200);
    assert_eq!(page["images"][0]["path"], "b.jpg");
    assert_eq!(page["images"][0]["sha256"], "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad");
    let cursor = page["next_cursor"].as_str().unwrap();
    let cursor = percent_encoding::utf8_percent_encode(cursor, percent_encoding::NON_ALPHANUMERIC);
    let rest = service.get(&format!("{images}?cursor={cursor}")).await.ok(200);
    assert_eq!((&rest["images"][0]["path"], &rest["next_cursor"]), (&json!("é/a b.jpg"), &Value::Null));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_dataset_stays_as_it_is_while_a_job_needs_it() {
    let service = Service::start().await;
    let (dataset, images) = dataset(&service).await;
    let itself = dataset["links"]["self"].as_str().unwrap();
    let new_job = json!({"dataset_id": dataset["id"], "options": {"mode": "hang"}});
    service.post_json("/api/v1/jobs", &new_job).await.assert_problem(422, "no_images");
    service.post_form(&images, photographs(["a.jpg", "b.jpg"])).await.ok(200);
    let job = service.post_json("/api/v1/jobs", &new_job).await.ok(202);
    assert_eq!((&job["name"], &job["images"]["ignored"]), (&json!("Roll 1"), &Value::Null));
    service.wait_hanging(&job).await;
    service.post_form(&images, photographs(["c.jpg"])).await.assert_problem(409, "dataset_in_use");
    service.delete(itself).await.assert_problem(409, "dataset_in_use");
    service.post(job["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&job, "cancelled").await;

    // Resumed, the job takes what the dataset holds by then.
    service.post_form(&images, photographs(["c.jpg"])).await.ok(200);
    service.post(job["links"]["resume"].as_str().unwrap()).await.ok(202);
    let job = service.wait_state(&job, "succeeded").await;
    assert_eq!(job["images"]["registered"], 3);
    service.delete(job["links"]["self"].as_str().unwrap()).await.ok(204);
    assert_eq!(service.get(itself).await.ok(200)["images"], 3, "a dataset made for itself outlives its jobs");
    service.delete(itself).await.ok(204);
    service.get(itself).await.assert_problem(404, "dataset_not_found");
    service.delete(itself).await.assert_problem(404, "dataset_not_found");
    service.post_form(&images, photographs(["a.jpg"])).await.assert_problem(404, "dataset_not_found");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_missing_or_unacknowledged_file_is_noticed() {
    let service = Service::start().await;
    let (dataset, images) = dataset(&service).await;
    service.post_form(&images, photographs(["a.jpg", "b.jpg"])).await.ok(200);
    let folder = service.data_dir().join("datasets").join(dataset["id"].as_str().unwrap()).join("images");
    // As a crash between rename and commit leaves it: a file that nobody was told about is no input.
    std::fs::write(folder.join("stray.jpg"), b"x").unwrap();
    let job = service.post_json("/api/v1/jobs", &json!({"dataset_id": dataset["id"]})).await.ok(202);
    assert_eq!(service.wait_state(&job, "succeeded").await["images"]["registered"], 2);
    std::fs::remove_file(folder.join("b.jpg")).unwrap();
    let job = service.post_json("/api/v1/jobs", &json!({"dataset_id": dataset["id"]})).await.ok(202);
    let failed = service.wait_state(&job, "failed").await;
    assert_eq!(failed["error"]["code"], "input_missing");
    assert!(failed["error"]["message"].as_str().unwrap().contains("b.jpg"));
}

#[tokio::test(flavor = "multi_thread")]
async fn bodies_of_the_wrong_kind_are_refused() {
    let service = Service::start().await;
    let (_, images) = dataset(&service).await;
    service.post_json(&images, &json!({})).await.assert_problem(415, "unsupported_media_type");
    service.post("/api/v1/datasets").await.assert_problem(415, "unsupported_media_type");
    service.post_json("/api/v1/datasets", &json!({"nam": "x"})).await.assert_problem(400, "invalid_json");
    let long = json!({"name": "x".repeat(201)});
    service.post_json("/api/v1/datasets", &long).await.assert_problem(422, "invalid_name");
    let huge = json!({"name": "x".repeat(2 << 20)});
    service.post_json("/api/v1/datasets", &huge).await.assert_problem(413, "payload_too_large");
    service.post_form(&images, photographs(["a.jpg"]).text("name", "x")).await.assert_problem(400, "invalid_multipart");
}
