//! `/api/v1/jobs`

use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::service::{Service, file, files_below, photographs};

#[tokio::test(flavor = "multi_thread")]
async fn a_folder_of_photographs_becomes_a_model() {
    let service = Service::start().await;
    let form = photographs(["a.jpg", "sub/b 石.JPG", "lone.png", "sub/bad.tif", "readme.txt"])
        .text("name", "Temple")
        .text("options", r#"{"mode": "quick"}"#);
    let answer = service.post_form("/api/v1/jobs", form).await;
    let location = answer.header("location").to_owned();
    let job = answer.ok(202);
    assert_eq!(job["links"]["self"], location);
    assert_eq!((&job["name"], &job["options"]), (&json!("Temple"), &json!({"mode": "quick"})));
    assert_eq!((&job["images"]["uploaded"], &job["images"]["ignored"]), (&json!(4), &json!(1)));
    assert_eq!(job["images"]["registered"], Value::Null);

    let job = service.wait_state(&job, "succeeded").await;
    let images = json!({"uploaded": 4, "ignored": 1, "registered": 2, "unregistered": 1, "rejected": 1});
    assert_eq!(job["images"], images);
    assert_eq!(job["models"][0]["points"], 1000);
    assert_eq!(job["error"], Value::Null);
    let stages = job["stages"].as_array().unwrap();
    assert_eq!(stages.len(), 3);
    assert!(
        stages.iter().all(|stage| stage["state"] == "done" && stage["done"] == 4 && stage["counts"]["things"] == 3.0)
    );
    assert!(job["finished_at"].as_str() >= job["started_at"].as_str());
    let dataset = job["dataset_id"].as_str().unwrap();
    let stored = files_below(&service.data_dir().join("datasets").join(dataset).join("images"));
    assert_eq!(stored, ["a.jpg", "lone.png", "sub/b 石.JPG", "sub/bad.tif"]);
    // No upload leaves scraps.
    assert_eq!(files_below(&service.data_dir().join("incoming")), [""; 0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_with_other_options_goes_on_from_what_an_earlier_one_did() {
    let service = Service::start().await;
    let first = service.job("quick").await;
    let first = service.wait_state(&first, "succeeded").await;
    let body = json!({"dataset_id": first["dataset_id"], "options": {"mode": "no_model"}});
    let second = service.post_json("/api/v1/jobs", &body).await.ok(202);
    let second = service.wait_state(&second, "failed").await;
    assert!(second["stages"].as_array().unwrap().iter().all(|stage| stage["state"] == "reused"), "{second:#}");
    // It goes with the photographs.
    for job in [&first, &second] {
        service.delete(job["links"]["self"].as_str().unwrap()).await.ok(204);
    }
    let left = service.get("/api/v1/datasets").await.ok(200);
    for dataset in left["datasets"].as_array().unwrap() {
        service.delete(dataset["links"]["self"].as_str().unwrap()).await.ok(204);
    }
    assert_eq!(files_below(&service.data_dir().join("datasets")), [""; 0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn jobs_are_listed_newest_first_in_pages() {
    let service = Service::start().await;
    let mut ids = Vec::new();
    for _ in 0..5 {
        ids.insert(0, service.job("quick").await["id"].clone());
    }
    let (mut seen, mut cursor) = (Vec::new(), String::new());
    loop {
        let page = service.get(&format!("/api/v1/jobs?limit=2{cursor}")).await.ok(200);
        seen.extend(page["jobs"].as_array().unwrap().iter().map(|job| job["id"].clone()));
        match page["next_cursor"].as_str() {
            Some(next) => cursor = format!("&cursor={next}"),
            None => break,
        }
    }
    assert_eq!(seen, ids);
    for query in ["limit=0", "limit=1001", "limit=x", "cursor=x", "limit=-1"] {
        service.get(&format!("/api/v1/jobs?{query}")).await.assert_problem(400, "invalid_query");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_running_job_is_cancelled_within_seconds_and_resumed() {
    let service = Service::start().await;
    let job = service.job("hang").await;
    let hanging = service.wait_hanging(&job).await;
    assert_eq!(hanging["state"], "running");
    let waiting = service.job("quick").await;
    assert_eq!(waiting["state"], "queued", "one job at a time");
    let link = |what: &str| job["links"][what].as_str().unwrap().to_owned();
    service.delete(&link("self")).await.assert_problem(409, "job_running");
    service.post(&link("resume")).await.assert_problem(409, "job_not_resumable");
    let start = Instant::now();
    let asked = service.post(&link("cancel")).await.ok(202);
    assert!(asked["state"] == "cancelled" || asked["cancel_requested"] == true);
    let cancelled = service.wait_state(&job, "cancelled").await;
    assert!(start.elapsed() < Duration::from_secs(3));
    assert_eq!((&cancelled["error"], &cancelled["cancel_requested"]), (&Value::Null, &json!(false)));
    service.post(&link("cancel")).await.ok(202);
    service.wait_state(&waiting, "succeeded").await;

    assert_eq!(service.post(&link("resume")).await.ok(202)["state"], "queued");
    let done = service.wait_state(&job, "succeeded").await;
    assert_eq!(done["stages"][0]["state"], "reused", "a finished stage is not run again");
    assert_eq!(done["stages"][1]["state"], "done");
    assert_eq!(service.engine.runs.load(Ordering::SeqCst), 3);
    service.post(&link("cancel")).await.assert_problem(409, "job_not_active");
    service.post(&link("resume")).await.assert_problem(409, "job_not_resumable");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_queued_job_is_cancelled_at_once() {
    let service = Service::start().await;
    let first = service.job("hang").await;
    service.wait_hanging(&first).await;
    let second = service.job("quick").await;
    let cancel = second["links"]["cancel"].as_str().unwrap();
    assert_eq!(service.post(cancel).await.ok(202)["state"], "cancelled");
    service.post(first["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&first, "cancelled").await;
    assert_eq!(service.engine.runs.load(Ordering::SeqCst), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn failures_say_where_and_why() {
    let service = Service::start().await;
    for (mode, code, stage) in [
        ("panic", "panic", json!("coarse_match")),
        ("disk_error", "disk_error", json!("coarse_match")),
        ("no_model", "no_model", Value::Null),
    ] {
        let job = service.job(mode).await;
        let failed = service.wait_state(&job, "failed").await;
        assert_eq!((&failed["error"]["code"], &failed["error"]["stage"]), (&json!(code), &stage), "{failed:#}");
        assert!(failed["error"]["message"].as_str().unwrap().len() > 10);
        let outputs = service.get(failed["links"]["outputs"].as_str().unwrap()).await.ok(200);
        if mode == "no_model" {
            assert_eq!(failed["images"]["unregistered"], 3);
            assert_eq!(outputs["files"][1]["path"], "report.json", "the report is there although no model is");
        } else {
            assert_eq!(failed["images"]["registered"], Value::Null);
            assert_eq!(outputs["files"], json!([]));
        }
    }
    // The process lives on.
    let job = service.job("quick").await;
    service.wait_state(&job, "succeeded").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn what_can_not_be_a_job_is_refused_and_leaves_nothing() {
    let service = Service::start().await;
    let post = async |form| service.post_form("/api/v1/jobs", form).await;
    post(photographs([]).text("name", "nothing")).await.assert_problem(422, "no_images");
    post(photographs(["readme.txt"])).await.assert_problem(422, "no_images");
    let long = "x".repeat(201);
    post(photographs(["a.jpg"]).text("name", long)).await.assert_problem(422, "invalid_name");
    post(photographs(["a.jpg"]).text("options", "{")).await.assert_problem(400, "invalid_json");
    post(photographs(["a.jpg"]).text("options", "[]")).await.assert_problem(422, "invalid_options");
    let answer = post(photographs(["a.jpg"]).text("options", r#"{"mode": "odd", "more": 1}"#)).await;
    answer.assert_problem(422, "invalid_options");
    assert_eq!(answer.json()["errors"].as_array().unwrap().len(), 2);
    post(photographs(["a.jpg"]).text("colour", "red")).await.assert_problem(400, "invalid_multipart");
    for name in ["../a.jpg", "/a.jpg", "a\\b.jpg", "C:/a.jpg", "x/../../y.jpg"] {
        let answer = post(photographs(["good.jpg", name])).await;
        answer.assert_problem(422, "invalid_file_name");
        assert_eq!(answer.json()["path"], name);
    }
    let twice = photographs(["a.jpg"]).part("images", file("a.jpg", b"other bytes"));
    post(twice).await.assert_problem(409, "file_conflict");
    let nested = photographs(["a.jpg", "a.jpg/b.jpg"]);
    post(nested).await.assert_problem(409, "file_conflict");
    let large = photographs([]).part("images", file("a.jpg", &vec![0; (4 << 20) + 1]));
    post(large).await.assert_problem(413, "payload_too_large");

    let broken = service.request("POST", "/api/v1/jobs").header("content-type", "multipart/form-data; boundary=x");
    service.send(broken.body("--x\r\nrubbish")).await.assert_problem(400, "invalid_multipart");
    let unbounded = service.request("POST", "/api/v1/jobs").header("content-type", "multipart/form-data");
    service.send(unbounded.body("x")).await.assert_problem(400, "invalid_multipart");
    let plain = service.request("POST", "/api/v1/jobs").header("content-type", "text/plain");
    service.send(plain.body("x")).await.assert_problem(415, "unsupported_media_type");
    let json = service.request("POST", "/api/v1/jobs").header("content-type", "application/json");
    service.send(json.body("{")).await.assert_problem(400, "invalid_json");
    service.post_json("/api/v1/jobs", &json!({"dataset": "x"})).await.assert_problem(400, "invalid_json");
    let nobody = json!({"dataset_id": "00000000-0000-7000-8000-000000000000"});
    service.post_json("/api/v1/jobs", &nobody).await.assert_problem(404, "dataset_not_found");
    service.get("/api/v1/jobs/nonsense").await.assert_problem(404, "job_not_found");

    assert_eq!(service.get("/api/v1/jobs").await.ok(200)["jobs"], json!([]));
    // The datasets of refused uploads go in the background.
    let start = Instant::now();
    while files_below(&service.data_dir().join("datasets")) != [""; 0] {
        assert!(start.elapsed() < Duration::from_secs(10), "a refused upload left files");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(service.get("/api/v1/datasets").await.ok(200)["datasets"], json!([]));
    assert_eq!(files_below(&service.data_dir().join("incoming")), [""; 0]);
}

#[tokio::test(flavor = "multi_thread")]
async fn thousands_of_parts_and_archives_both_work() {
    let service = Service::start().await;
    let names: Vec<String> = (0..2000).map(|i| format!("roll {}/{i:04}.jpg", i % 7)).collect();
    let job = service.post_form("/api/v1/jobs", photographs(names.iter().map(String::as_str))).await.ok(202);
    assert_eq!(job["images"]["uploaded"], 2000);
    service.wait_state(&job, "succeeded").await;

    let form = photographs(["beside.jpg"])
        .part("archive", file("x.zip", &archive(&[("in/a.jpg", b"1"), ("in/b.png", b"2"), ("notes.txt", b"3")])));
    let job = service.post_form("/api/v1/jobs", form).await.ok(202);
    assert_eq!((&job["images"]["uploaded"], &job["images"]["ignored"]), (&json!(3), &json!(1)));
    let job = service.wait_state(&job, "succeeded").await;
    let images = service.get(job["links"]["images"].as_str().unwrap()).await.ok(200);
    let names: Vec<_> = images["images"].as_array().unwrap().iter().map(|image| &image["name"]).collect();
    assert_eq!(names, ["beside.jpg", "in/a.jpg", "in/b.png"]);

    for (bytes, status, code) in [
        (archive(&[("a.jpg", b"1"), ("../b.jpg", b"2")]), 422, "invalid_file_name"),
        (b"no archive".to_vec(), 422, "invalid_archive"),
        (archive(&[("a.jpg", &vec![0; (4 << 20) + 1])]), 413, "archive_too_large"),
    ] {
        let form = photographs([]).part("archive", file("x.zip", &bytes));
        service.post_form("/api/v1/jobs", form).await.assert_problem(status, code);
    }
}

pub fn archive(entries: &[(&str, &[u8])]) -> Vec<u8> {
    use std::io::Write;
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for (name, bytes) in entries {
        zip.start_file(*name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_deleted_job_takes_its_files_and_its_own_photographs_along() {
    let service = Service::start().await;
    let job = service.job("quick").await;
    let job = service.wait_state(&job, "succeeded").await;
    let other = service.post_json("/api/v1/jobs", &json!({"dataset_id": job["dataset_id"]})).await.ok(202);
    service.wait_state(&other, "succeeded").await;
    let dataset = job["links"]["dataset"].as_str().unwrap().to_owned();
    service.delete(&dataset).await.assert_problem(409, "dataset_in_use");
    for job in [&job, &other] {
        let link = job["links"]["self"].as_str().unwrap();
        service.delete(link).await.ok(204);
        service.get(link).await.assert_problem(404, "job_not_found");
        service.delete(link).await.assert_problem(404, "job_not_found");
        service.get(&format!("{link}/outputs")).await.assert_problem(404, "job_not_found");
    }
    // Two jobs used the photographs, so neither took them along; a job that is alone with its upload does.
    service.delete(&dataset).await.ok(204);
    let alone = service.job("quick").await;
    service.wait_state(&alone, "succeeded").await;
    service.delete(alone["links"]["self"].as_str().unwrap()).await.ok(204);
    service.get(alone["links"]["dataset"].as_str().unwrap()).await.assert_problem(404, "dataset_not_found");
    for folder in ["jobs", "datasets", "trash"] {
        assert_eq!(files_below(&service.data_dir().join(folder)), [""; 0], "{folder}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_sender_who_leaves_or_stalls_leaves_nothing() {
    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
        config.upload_idle_timeout = Duration::from_millis(300);
    })
    .await;
    let head = "POST /api/v1/jobs HTTP/1.1\r\nhost: x\r\ncontent-type: multipart/form-data; boundary=x\r\ncontent-length: 100000\r\n\r\n\
        --x\r\ncontent-disposition: form-data; name=\"images\"; filename=\"a.jpg\"\r\n\r\nhalf";
    let connect = async || tokio::net::TcpStream::connect(service.server.as_ref().unwrap().address).await.unwrap();
    let mut leaves = connect().await;
    leaves.write_all(head.as_bytes()).await.unwrap();
    drop(leaves);
    let mut stalls = connect().await;
    stalls.write_all(head.as_bytes()).await.unwrap();
    let mut answer = vec![0; 4096];
    let read = tokio::time::timeout(Duration::from_secs(10), stalls.read(&mut answer)).await.unwrap().unwrap();
    let answer = String::from_utf8_lossy(&answer[..read]).into_owned();
    assert!(answer.starts_with("HTTP/1.1 408") && answer.contains("request_timeout"), "{answer}");
    let start = Instant::now();
    while !files_below(&service.data_dir().join("datasets")).is_empty()
        || !files_below(&service.data_dir().join("incoming")).is_empty()
    {
        assert!(start.elapsed() < Duration::from_secs(10));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    assert_eq!(service.get("/api/v1/jobs").await.ok(200)["jobs"], json!([]));
}
