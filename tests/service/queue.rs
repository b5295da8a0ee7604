//! Order, forecast, quotas and retention of jobs.

use std::process::Command;
use std::time::Duration;

use multistage::store::db::tokens;
use multistage::store::{DataDir, Db, Quota, Scope, create_token};
use reqwest::multipart::Form;
use serde_json::{Value, json};

use crate::service::{Answer, Service, files_below, photographs};

/// One of several who use a service.
struct User<'a> {
    service: &'a Service,
    token: String,
}

impl User<'_> {
    async fn send_form(&self, path: &str, form: Form) -> Answer {
        self.service.send(self.service.request("POST", path).bearer_auth(&self.token).multipart(form)).await
    }

    async fn send_json(&self, method: &str, path: &str, body: &Value) -> Answer {
        self.service.send(self.service.request(method, path).bearer_auth(&self.token).json(body)).await
    }

    async fn get(&self, path: &str) -> Value {
        self.service.send(self.service.request("GET", path).bearer_auth(&self.token)).await.ok(200)
    }

    async fn job(&self, mode: &str, priority: i64) -> Value {
        let options = json!({ "mode": mode }).to_string();
        let form = photographs(["a.jpg", "b.jpg"]).text("options", options).text("priority", priority.to_string());
        self.send_form("/api/v1/jobs", form).await.ok(202)
    }
}

async fn guarded() -> (Service, Db) {
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| config.access.token_required = true).await;
    let db = Db::open(&DataDir::database_in(service.data_dir())).await.unwrap();
    (service, db)
}

async fn user<'a>(service: &'a Service, db: &Db, name: &str, scopes: &[Scope]) -> User<'a> {
    User { service, token: create_token(db, name, scopes).await.unwrap() }
}

#[tokio::test(flavor = "multi_thread")]
async fn priorities_and_turns_decide_who_is_next() {
    let (service, db) = guarded().await;
    let both = [Scope::Read, Scope::Submit];
    let (ann, ben) = (user(&service, &db, "ann", &both).await, user(&service, &db, "ben", &both).await);
    let root = user(&service, &db, "root", &[Scope::Admin]).await;
    let first = ann.job("hang", 0).await;
    let mut jobs = Vec::new();
    for (user, priority) in [(&ann, 0), (&ann, 0), (&ann, 0), (&ben, -3), (&ben, 0), (&root, 7)] {
        jobs.push(user.job("quick", priority).await);
    }
    for (user, priority, status, code) in
        [(&ann, -11, 422, "invalid_priority"), (&root, 11, 422, "invalid_priority"), (&ann, 1, 403, "forbidden")]
    {
        let form = photographs(["a.jpg"]).text("priority", priority.to_string());
        user.send_form("/api/v1/jobs", form).await.assert_problem(status, code);
    }
    let form = photographs(["a.jpg"]).text("priority", "high");
    ann.send_form("/api/v1/jobs", form).await.assert_problem(422, "invalid_priority");

    // ann's third goes to the end of her own by a lower priority.
    let link = |job: &Value| job["links"]["self"].as_str().unwrap().to_owned();
    let moved = ann.send_json("PATCH", &link(&jobs[1]), &json!({"priority": -1.0})).await.ok(200);
    assert_eq!((&moved["priority"], &moved["queue"]["position"]), (&json!(-1), &json!(5)));
    ann.send_json("PATCH", &link(&jobs[1]), &json!({"priority": 2})).await.assert_problem(403, "forbidden");
    ann.send_json("PATCH", &link(&jobs[1]), &json!({"priority": -11})).await.assert_problem(422, "invalid_priority");
    ben.send_json("PATCH", &link(&jobs[1]), &json!({"priority": 0})).await.assert_problem(404, "job_not_found");

    let expected = [5, 4, 0, 2, 1, 3];
    let listed = root.get("/api/v1/jobs").await;
    let position = |job: &Value| {
        let found = listed["jobs"].as_array().unwrap().iter().find(|other| other["id"] == job["id"]).unwrap();
        found["queue"]["position"].as_u64().unwrap() as usize
    };
    for (at, job) in expected.iter().enumerate() {
        assert_eq!(position(&jobs[*job]), at + 1, "job {job}");
        assert_eq!(root.get(&link(&jobs[*job])).await["queue"]["position"], at + 1);
    }
    ann.send_json("POST", first["links"]["cancel"].as_str().unwrap(), &json!({})).await.ok(202);
    let mut started = Vec::new();
    for (at, job) in jobs.iter().enumerate() {
        let done = loop {
            let now = root.get(&link(job)).await;
            if now["state"] == "succeeded" {
                break now;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        };
        assert_eq!(done["queue"], Value::Null);
        started.push((done["started_at"].as_str().unwrap().to_owned(), at));
    }
    started.sort();
    assert_eq!(started.into_iter().map(|(_, at)| at).collect::<Vec<_>>(), expected);
    ann.send_json("PATCH", &link(&jobs[1]), &json!({"priority": 0})).await.assert_problem(409, "job_not_queued");
}

#[tokio::test(flavor = "multi_thread")]
async fn waiting_jobs_tell_when_by_what_was_measured() {
    let service = Service::start().await;
    let hanging = service.job("hang").await;
    service.wait_hanging(&hanging).await;
    let waiting = service.job("quick").await;
    assert_eq!(waiting["queue"]["position"], 1);
    // Half of its second stage is done: the running job tells how long it will still take, and so how long others may.
    let told = service.wait(&waiting, |job| !job["queue"]["starts_in_s"].is_null()).await;
    let (starts, done) = (&told["queue"]["starts_in_s"], &told["eta_s"]);
    let number = |value: &Value, name: &str| value[name].as_f64().unwrap();
    assert!(0.0 < number(starts, "low") && number(starts, "low") < number(starts, "high"), "{told:#}");
    assert!(number(done, "low") > number(starts, "low") && number(done, "high") > number(starts, "high"));
    let last = service.job("quick").await;
    let behind = service.get(last["links"]["self"].as_str().unwrap()).await.ok(200);
    assert_eq!(behind["queue"]["position"], 2);
    assert!(number(&behind["queue"]["starts_in_s"], "high") > number(starts, "high"), "{behind:#}");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_goes_beyond_a_quota_is_refused_by_its_name() {
    let (service, db) = guarded().await;
    let ann = user(&service, &db, "ann", &[Scope::Read, Scope::Submit]).await;
    let quota = async |text: &str| {
        let mut tx = db.write().await.unwrap();
        assert!(tokens::set_quota(&mut tx, "ann", &Quota::parse(text).unwrap()).await.unwrap());
        tx.commit().await.unwrap();
    };
    quota("bytes=12,images=3,jobs=2").await;
    // Five bytes each, the names themselves.
    let job = ann.job("quick", 0).await;
    let form = photographs(["c.jpg", "d.jpg"]);
    ann.send_form("/api/v1/jobs", form).await.assert_problem(403, "bytes_quota_exceeded");
    quota("bytes=1K,images=3,jobs=2").await;
    let form = photographs(["c.jpg", "d.jpg"]);
    let refused = ann.send_form("/api/v1/jobs", form).await;
    refused.assert_problem(403, "images_quota_exceeded");
    assert!(refused.json()["detail"].as_str().unwrap().contains("3 images"), "{}", refused.text());
    let dataset = ann.send_json("POST", "/api/v1/datasets", &json!({})).await.ok(201);
    let images = dataset["links"]["images"].as_str().unwrap();
    ann.send_form(images, photographs(["c.jpg"])).await.ok(200);
    ann.send_form(images, photographs(["d.jpg"])).await.assert_problem(403, "images_quota_exceeded");
    // What is stored already costs nothing.
    assert_eq!(ann.send_form(images, photographs(["c.jpg"])).await.ok(200)["unchanged"], 1);
    // Resumable uploads count as soon as they are announced.
    quota("bytes=20,jobs=2").await;
    let metadata = |path: &str| {
        use base64::Engine;
        let encode = |text: &str| base64::prelude::BASE64_STANDARD.encode(text);
        format!("dataset {},path {}", encode(dataset["id"].as_str().unwrap()), encode(path))
    };
    let upload = async |path: &str, length: usize| {
        let request = service.request("POST", "/api/v1/uploads").bearer_auth(&ann.token);
        let request = request.header("tus-resumable", "1.0.0").header("upload-length", length);
        service.send(request.header("upload-metadata", metadata(path))).await
    };
    upload("e.jpg", 6).await.assert_problem(403, "bytes_quota_exceeded");
    assert_eq!(upload("e.jpg", 5).await.status.as_u16(), 201);
    upload("f.jpg", 1).await.assert_problem(403, "bytes_quota_exceeded");
    quota("jobs=2").await;
    let body = json!({"dataset_id": dataset["id"]});
    ann.send_json("POST", "/api/v1/jobs", &body).await.ok(202);
    ann.send_json("POST", "/api/v1/jobs", &body).await.assert_problem(403, "jobs_quota_exceeded");
    // Deleting makes room; a job whose own upload was refused left nothing.
    loop {
        let gone = service.request("DELETE", job["links"]["self"].as_str().unwrap()).bearer_auth(&ann.token);
        if service.send(gone).await.status.as_u16() == 204 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    ann.send_json("POST", "/api/v1/jobs", &body).await.ok(202);
    let left = files_below(&service.data_dir().join("datasets"));
    assert_eq!(left.iter().filter(|path| path.contains("/images/")).count(), 1, "{left:?}");
}

/// Runs `multistage cleanup` on a data directory.
fn clean_up(data_dir: &std::path::Path, arguments: &[&str]) -> String {
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let output = command.arg("cleanup").arg("--data-dir").arg(data_dir).args(arguments).output().unwrap();
    assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
    String::from_utf8(output.stdout).unwrap()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_nobody_used_for_long_goes_and_a_dry_run_only_says_so() {
    let service = Service::start().await;
    let (old, new) = (service.job("quick").await, service.job("quick").await);
    let dataset = service.post_json("/api/v1/datasets", &json!({"name": "bare"})).await.ok(201);
    let shared = service.post_json("/api/v1/datasets", &json!({"name": "shared"})).await.ok(201);
    for set in [&dataset, &shared] {
        service.post_form(set["links"]["images"].as_str().unwrap(), photographs(["x.jpg"])).await.ok(200);
    }
    let user = service.post_json("/api/v1/jobs", &json!({"dataset_id": shared["id"]})).await.ok(202);
    for job in [&old, &new, &user] {
        service.wait_state(job, "succeeded").await;
    }
    let folder = service.stop().await;
    let db = Db::open(&DataDir::database_in(folder.path())).await.unwrap();
    let mut tx = db.write().await.unwrap();
    // Nine days ago.
    for (table, column) in [("jobs", "finished_ms"), ("datasets", "changed_ms"), ("datasets", "created_ms")] {
        let query = format!("UPDATE {table} SET {column} = {column} - 9 * 86400000");
        sqlx::query(sqlx::AssertSqlSafe(query)).execute(&mut *tx).await.unwrap();
    }
    sqlx::query("UPDATE jobs SET finished_ms = finished_ms + 9 * 86400000 WHERE id IN (?, ?)")
        .bind(new["id"].as_str().unwrap())
        .bind(user["id"].as_str().unwrap())
        .execute(&mut *tx)
        .await
        .unwrap();
    tx.commit().await.unwrap();
    db.close().await;

    let before = files_below(folder.path());
    let said = clean_up(folder.path(), &["--keep-days", "7", "--dry-run"]);
    for thing in [&old["id"], &old["dataset_id"], &dataset["id"]] {
        assert!(said.contains(thing.as_str().unwrap()), "{said}");
    }
    assert!(said.contains("3 things of") && said.contains("would be removed"), "{said}");
    assert!(clean_up(folder.path(), &["--keep-days", "10", "--dry-run"]).contains("0 things"));
    let models = |files: &[String]| files.iter().filter(|file| file.ends_with("points.ply")).count();
    assert_eq!((models(&before), models(&files_below(folder.path()))), (3, 3));

    // Nothing goes unless asked; then the service does it by itself.
    let service = Service::start_in(folder, |_| {}).await;
    assert_eq!(service.get("/api/v1/jobs").await.ok(200)["jobs"].as_array().unwrap().len(), 3);
    let folder = service.stop().await;
    let service = Service::start_in(folder, |config| config.keep = Some(Duration::from_secs(7 * 86400))).await;
    let start = std::time::Instant::now();
    while models(&files_below(service.data_dir())) > 2 {
        assert!(start.elapsed() < Duration::from_secs(10));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let left = service.get("/api/v1/jobs").await.ok(200);
    assert_eq!(left["jobs"].as_array().unwrap().len(), 2);
    let left = service.get("/api/v1/datasets").await.ok(200);
    let left: Vec<_> = left["datasets"].as_array().unwrap().iter().map(|set| &set["id"]).collect();
    assert!(left.contains(&&shared["id"]) && left.contains(&&new["dataset_id"]) && left.len() == 2, "{left:?}");
    // While the service runs, cleaning up by hand works as well.
    assert!(clean_up(service.data_dir(), &["--keep-days", "0"]).contains("removed"));
    assert_eq!(service.get("/api/v1/jobs").await.ok(200)["jobs"], json!([]));
}
