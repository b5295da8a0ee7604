//! The interface of NodeODM: PyODM drives it, and what PyODM never does is asked by hand.

mod pyodm;

use std::collections::BTreeSet;
use std::io::{BufRead, Read};
use std::sync::{Arc, Mutex};
use std::time::Duration;

use multistage::store::{DataDir, Db, Scope, create_token};
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};
use uuid::Uuid;

use crate::program::Program;
use crate::service::{Service, file, files_below, photographs};

async fn start() -> Service {
    start_in(tempfile::tempdir().unwrap(), false).await
}

async fn start_in(folder: tempfile::TempDir, token_required: bool) -> Service {
    Service::start_in(folder, |config| {
        config.nodeodm_bind = Some(config.bind);
        config.access.token_required = token_required;
    })
    .await
}

/// A client by hand; its answers are JSON with status 200 unless said otherwise.
struct Client {
    base: String,
    http: reqwest::Client,
}

impl Client {
    fn of(service: &Service) -> Self {
        Self { base: service.nodeodm(), http: reqwest::Client::new() }
    }

    async fn get(&self, path: &str) -> Value {
        Self::json(self.http.get(format!("{}{path}", self.base))).await
    }

    async fn post(&self, path: &str, form: Form) -> Value {
        Self::json(self.http.post(format!("{}{path}", self.base)).multipart(form)).await
    }

    async fn json(request: reqwest::RequestBuilder) -> Value {
        let response = request.send().await.unwrap();
        assert_eq!(response.status(), 200);
        assert!(response.headers()["content-type"].to_str().unwrap().starts_with("application/json"));
        response.json().await.unwrap()
    }

    async fn begin(&self, id: Option<&str>) -> Value {
        let request =
            self.http.post(format!("{}/task/new/init", self.base)).multipart(Form::new().text("name", "a task"));
        Self::json(id.into_iter().fold(request, |request, id| request.header("set-uuid", id))).await
    }

    async fn commit(&self, id: &str) -> Value {
        Self::json(self.http.post(format!("{}/task/new/commit/{id}", self.base))).await
    }

    async fn completed(&self, id: &str) -> Value {
        for _ in 0..1000 {
            let info = self.get(&format!("/task/{id}/info")).await;
            if info["status"]["code"] == 40 {
                return info;
            }
            assert!(info["status"]["code"].as_u64().unwrap() <= 20, "{info}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        panic!("it does not end");
    }
}

/// A form that names a task.
fn form_of(request: reqwest::RequestBuilder, id: &str) -> reqwest::RequestBuilder {
    request.header("content-type", "application/x-www-form-urlencoded").body(format!("uuid={id}"))
}

fn error_of(answer: &Value) -> &str {
    answer["error"].as_str().unwrap_or_else(|| panic!("no error: {answer}"))
}

#[tokio::test(flavor = "multi_thread")]
async fn every_step_may_be_sent_again() {
    let service = start().await;
    let client = Client::of(&service);
    let id = Uuid::new_v4().to_string();
    for _ in 0..2 {
        assert_eq!(client.begin(Some(&id)).await["uuid"], id);
    }
    for _ in 0..3 {
        assert_eq!(
            client.post(&format!("/task/new/upload/{id}"), photographs(["a.jpg", "b.jpg"])).await["success"],
            true
        );
    }
    let changed = Form::new().part("images", file("a.jpg", b"other bytes"));
    assert!(error_of(&client.post(&format!("/task/new/upload/{id}"), changed).await).contains("a.jpg"));
    for _ in 0..2 {
        assert_eq!(client.commit(&id).await["uuid"], id);
    }
    let info = client.completed(&id).await;
    assert_eq!((&info["imagesCount"], &info["name"]), (&json!(2), &json!("a task")));
    // It is a job like any other, and its photographs go with it.
    let job = service.get(&format!("/api/v1/jobs/{id}")).await.ok(200);
    assert_eq!((&job["state"], &job["name"]), (&json!("succeeded"), &json!("a task")));
    assert_eq!(client.get("/task/list").await, json!([{"uuid": id}]));
    assert!(error_of(&client.begin(Some(&id)).await).contains("taken"));
    let late = client.post(&format!("/task/new/upload/{id}"), photographs(["c.jpg"])).await;
    assert!(error_of(&late).contains("not found"));
    let remove = client.http.post(format!("{}/task/remove", client.base)).json(&json!({"uuid": id}));
    assert_eq!(Client::json(remove).await["success"], true);
    assert_eq!(files_below(&service.data_dir().join("datasets")), Vec::<String>::new());
    assert_eq!(service.get("/api/v1/datasets").await.ok(200)["datasets"], json!([]));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_in_one_request_and_without_a_length() {
    let service = start().await;
    let client = Client::of(&service);
    // Chunked: some clients never say how long a body is.
    let text = "--X\r\nContent-Disposition: form-data; name=\"options\"\r\n\r\n[{\"name\":\"iterations\",\"value\":1}]\r\n\
                --X\r\nContent-Disposition: form-data; name=\"images\"; filename=\"sub/A.jpg\"\r\n\r\none\r\n\
                --X\r\nContent-Disposition: form-data; name=\"images\"; filename=\"sub/a.jpg\"\r\n\r\ntwo\r\n\
                --X\r\nContent-Disposition: form-data; name=\"images\"; filename=\"gcp_list.txt\"\r\n\r\nEPSG\r\n\
                --X\r\nContent-Disposition: form-data; name=\"outputs\"\r\n\r\n[]\r\n--X--\r\n";
    let chunks = text.as_bytes().chunks(100).map(|chunk| Ok::<_, std::io::Error>(chunk.to_vec()));
    let body = reqwest::Body::wrap_stream(futures_util::stream::iter(chunks.collect::<Vec<_>>()));
    let request = client.http.post(format!("{}/task/new", client.base)).body(body);
    let answer = Client::json(request.header("content-type", "multipart/form-data; boundary=X")).await;
    let id = answer["uuid"].as_str().unwrap().to_owned();
    let info = client.completed(&id).await;
    assert_eq!((&info["imagesCount"], &info["options"]), (&json!(2), &json!([{"name": "iterations", "value": 1}])));
    let images = service.get(&format!("/api/v1/jobs/{id}/images")).await.ok(200);
    let names: Vec<_> = images["images"].as_array().unwrap().iter().map(|image| image["name"].clone()).collect();
    assert_eq!(names, ["sub/A.jpg", "sub/a.jpg"]);
    // Photographs in a zip among the rest.
    let mut zip = zip::ZipWriter::new(std::io::Cursor::new(Vec::new()));
    for name in ["x.jpg", "y.jpg"] {
        zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
    }
    let zip = zip.finish().unwrap().into_inner();
    let form = Form::new().part("images", file("all.zip", &zip)).part("images", file("seed.zip", b"no zip at all"));
    let answer = client.post("/task/new", form).await;
    assert_eq!(client.completed(answer["uuid"].as_str().unwrap()).await["imagesCount"], 2);
}

/// Listens where tasks tell of their end; gives the bodies it was sent.
async fn hook() -> (String, Arc<Mutex<Vec<Value>>>) {
    let listener = tokio::net::TcpListener::bind("127.0.0.1:0").await.unwrap();
    let url = format!("http://{}/done", listener.local_addr().unwrap());
    let heard = Arc::new(Mutex::new(Vec::new()));
    let kept = Arc::clone(&heard);
    let hear = async move |headers: axum::http::HeaderMap, axum::Json(body): axum::Json<Value>| {
        assert!(!headers.contains_key("x-multistage-signature"), "there is no secret to sign by");
        kept.lock().unwrap().push(body);
    };
    tokio::spawn(async move { axum::serve(listener, axum::Router::new().fallback(hear)).await });
    (url, heard)
}

#[tokio::test(flavor = "multi_thread")]
async fn webhooks_hear_of_a_tasks_end_and_reach_public_addresses_alone() {
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
        config.nodeodm_bind = Some(config.bind);
        config.webhooks.allowed = vec!["127.0.0.1".parse().unwrap()];
    })
    .await;
    let client = Client::of(&service);
    let (url, heard) = hook().await;
    let named = || Form::new().text("name", "a task").text("webhook", url.clone());
    // In three steps, and in one.
    let begun = client.post("/task/new/init", named()).await["uuid"].as_str().unwrap().to_owned();
    client.post(&format!("/task/new/upload/{begun}"), photographs(["a.jpg", "b.jpg"])).await;
    client.commit(&begun).await;
    let whole = client.post("/task/new", named().part("images", file("a.jpg", b"one"))).await;
    let whole = whole["uuid"].as_str().unwrap().to_owned();
    for (id, images) in [(&begun, 2), (&whole, 1)] {
        let info = client.completed(id).await;
        for _ in 0..500 {
            if heard.lock().unwrap().iter().any(|told| told["uuid"] == **id) {
                break;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
        let all = heard.lock().unwrap().clone();
        let told: Vec<_> = all.iter().filter(|told| told["uuid"] == **id).collect();
        assert_eq!(told.len(), 1, "of its end alone: {all:#?}");
        for field in ["name", "dateCreated", "processingTime", "status", "imagesCount", "progress"] {
            assert_eq!(told[0][field].as_f64(), info[field].as_f64(), "{field}");
            assert_eq!(told[0][field].as_str(), info[field].as_str(), "{field}");
        }
        assert_eq!((&told[0]["status"], &told[0]["imagesCount"]), (&json!({"code": 40}), &json!(images)));
    }
    for within in ["http://10.0.0.1/x", "http://[::1]/x", "file:///etc/passwd"] {
        let form = Form::new().text("webhook", within);
        assert!(error_of(&client.post("/task/new/init", form).await).contains("webhook"), "{within}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_wrong_is_said_in_words_with_status_200() {
    let service = start().await;
    let client = Client::of(&service);
    let fields = |name: &'static str, value: &'static str| Form::new().text(name, value);
    for (form, message) in [
        (fields("options", "no JSON"), "options"),
        (
            fields("options", r#"[{"name": "iterations", "value": "0"}]"#),
            r#"[{"error":"must be a whole number from 1 to 10","name":"iterations"}]"#,
        ),
        (fields("zipurl", "http://127.0.0.1/a.zip"), "zipurl"),
    ] {
        assert!(error_of(&client.post("/task/new/init", form).await).contains(message), "{message}");
    }
    let long = Form::new().text("name", "x".repeat(201));
    assert!(error_of(&client.post("/task/new/init", long).await).contains("200"));
    assert!(error_of(&client.begin(Some("../../etc")).await).contains("UUID"));
    let id = client.begin(None).await["uuid"].as_str().unwrap().to_owned();
    let empty = client.post(&format!("/task/new/upload/{id}"), fields("x", "y")).await;
    assert_eq!((error_of(&empty), &empty["noRetry"]), ("Need at least 1 file.", &json!(true)));
    assert!(error_of(&client.commit(&id).await).contains("Not enough images"));
    let climbing = Form::new().part("images", Part::bytes(b"x".to_vec()).file_name("../a.jpg"));
    assert!(error_of(&client.post(&format!("/task/new/upload/{id}"), climbing).await).contains("folder"));
    assert!(error_of(&client.get(&format!("/task/{id}/info")).await).contains("not found"), "not committed yet");
    for path in ["/task/x/output", "/task/%ff/info", "/task/x/download/all.zip", "/task/x/info?with_output=y"] {
        let answer = client.http.get(format!("{}{path}", client.base)).send().await.unwrap();
        assert_eq!(answer.status(), 200, "{path}");
        error_of(&answer.json().await.unwrap());
    }
    for (method, path, status) in [("GET", "/nowhere", 404), ("POST", "/info", 405)] {
        let request = client.http.request(method.parse().unwrap(), format!("{}{path}", client.base));
        let answer = request.send().await.unwrap();
        assert_eq!(answer.status(), status);
        error_of(&answer.json().await.unwrap());
    }
    // A page of another site.
    let foreign = client.http.post(format!("{}/task/remove", client.base)).header("origin", "https://evil.example");
    let foreign = form_of(foreign, &id).send().await.unwrap();
    assert_eq!(foreign.status(), 403);
    assert!(client.get("/auth/info").await["message"].as_str().unwrap().contains("not required"));
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_of_the_archive_are_exact_and_a_client_may_leave() {
    let service = start().await;
    let client = Client::of(&service);
    let id = client.post("/task/new", photographs(["large.jpg", "b.jpg"])).await["uuid"].as_str().unwrap().to_owned();
    client.completed(&id).await;
    let link = format!("{}/task/{id}/download/all.zip", client.base);
    for _ in 0..20 {
        let aborted = client.http.get(&link).send().await.unwrap();
        assert_eq!(aborted.headers()["accept-ranges"], "bytes");
        drop(aborted);
    }
    let whole = client.http.get(&link).send().await.unwrap().bytes().await.unwrap();
    let mut parts = Vec::new();
    while parts.len() < whole.len() {
        let range = format!("bytes={}-{}", parts.len(), parts.len() + 7_000_000);
        let part = client.http.get(&link).header("range", range).send().await.unwrap();
        assert_eq!(part.status(), 206);
        let length: usize = part.headers()["content-length"].to_str().unwrap().parse().unwrap();
        let bytes = part.bytes().await.unwrap();
        assert_eq!(bytes.len(), length);
        parts.extend(bytes);
    }
    assert!(parts == whole);
    let mut points = Vec::new();
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(&whole[..])).unwrap();
    zip.by_name("ply/0/points.ply").unwrap().read_to_end(&mut points).unwrap();
    assert_eq!(points.len(), 36_000_000);
}

#[tokio::test(flavor = "multi_thread")]
async fn five_thousand_photographs_arrive() {
    let service = start().await;
    let client = std::sync::Arc::new(Client::of(&service));
    let id = client.begin(None).await["uuid"].as_str().unwrap().to_owned();
    let senders = (0..10).map(|sender| {
        let (client, id) = (std::sync::Arc::clone(&client), id.clone());
        tokio::spawn(async move {
            for request in 0..50 {
                let names: Vec<_> = (0..10).map(|n| format!("{sender}/{request}-{n}.jpg")).collect();
                let form = photographs(names.iter().map(String::as_str));
                assert_eq!(client.post(&format!("/task/new/upload/{id}"), form).await["success"], true);
            }
        })
    });
    for sender in senders.collect::<Vec<_>>() {
        sender.await.unwrap();
    }
    client.commit(&id).await;
    assert_eq!(client.completed(&id).await["imagesCount"], 5000);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_of_another_token_is_not_there() {
    let service = start_in(tempfile::tempdir().unwrap(), true).await;
    let db = Db::open(&DataDir::database_in(service.data_dir())).await.unwrap();
    let both = [Scope::Read, Scope::Submit];
    let (mine, other) = (create_token(&db, "a", &both).await.unwrap(), create_token(&db, "b", &both).await.unwrap());
    let client = Client::of(&service);
    let begun = client.post(&format!("/task/new/init?token={mine}"), Form::new().text("name", "mine")).await;
    let id = begun["uuid"].as_str().unwrap();
    let uploaded = async |token: &str| {
        client.post(&format!("/task/new/upload/{id}?token={token}"), photographs(["a.jpg", "b.jpg"])).await
    };
    assert!(error_of(&uploaded(&other).await).contains("not found"));
    assert_eq!(uploaded(&mine).await["success"], true);
    let commit =
        |token: &str| Client::json(client.http.post(format!("{}/task/new/commit/{id}?token={token}", client.base)));
    assert!(error_of(&commit(&other).await).contains("not found"));
    assert_eq!(commit(&mine).await["uuid"], id);
    let stolen = client.http.post(format!("{}/task/new/init?token={other}", client.base)).header("set-uuid", id);
    assert!(error_of(&Client::json(stolen.multipart(Form::new().text("name", "x"))).await).contains("taken"));
    for path in ["info", "output", "download/all.zip"] {
        assert!(
            error_of(&client.get(&format!("/task/{id}/{path}?token={other}")).await).contains("not found"),
            "{path}"
        );
        for token in ["", "?token=", "?token=wrong"] {
            let answer = client.get(&format!("/task/{id}/{path}{token}")).await;
            assert_eq!(error_of(&answer), "Invalid authentication token: token does not match.");
        }
    }
    for change in ["cancel", "restart", "remove"] {
        let request = client.http.post(format!("{}/task/{change}?token={other}", client.base));
        assert!(error_of(&Client::json(form_of(request, id)).await).contains("not found"), "{change}");
    }
    assert_eq!(client.get(&format!("/task/list?token={other}")).await, json!([]));
    assert_eq!(client.get(&format!("/task/list?token={mine}")).await, json!([{"uuid": id}]));
    assert!(client.get("/auth/info").await["message"].as_str().unwrap().contains("token"));
}

/// The program is killed between upload and commit; the task is committed to the next one.
#[tokio::test(flavor = "multi_thread")]
async fn a_begun_task_outlives_the_program() {
    let folder = tempfile::tempdir().unwrap();
    let start = || {
        let mut program = Program::start_with(folder.path(), &["--nodeodm-bind", "127.0.0.1:0"]);
        let mut line = String::new();
        program.output.read_line(&mut line).unwrap();
        let base = line.trim().rsplit(' ').next().unwrap().trim_end_matches('/').to_owned();
        (program, Client { base, http: reqwest::Client::new() })
    };
    let (program, client) = start();
    let id = client.begin(None).await["uuid"].as_str().unwrap().to_owned();
    client.post(&format!("/task/new/upload/{id}"), photographs(["a.jpg", "b.jpg"])).await;
    program.kill();
    let (program, client) = start();
    client.post(&format!("/task/new/upload/{id}"), photographs(["b.jpg", "c.jpg"])).await;
    assert_eq!(client.commit(&id).await["uuid"], id);
    program.kill();
    let (_program, client) = start();
    let info = client.get(&format!("/task/{id}/info")).await;
    assert_eq!(info["imagesCount"], 3);
    // No photographs at all, so it fails, and says why in the console, which is kept as well.
    let lines: BTreeSet<String> = loop {
        let info = client.get(&format!("/task/{id}/info?with_output=0")).await;
        if info["status"]["code"] == 30 {
            assert!(info["status"]["errorMessage"].as_str().unwrap().contains("photographs"), "{info}");
            break serde_json::from_value(info["output"].clone()).unwrap();
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    };
    assert!(lines.iter().any(|line| line.contains("job queued")), "{lines:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_task_that_is_never_committed_goes() {
    let service = start().await;
    let client = Client::of(&service);
    let mut begun = Vec::new();
    for _ in 0..2 {
        let id = client.begin(None).await["uuid"].as_str().unwrap().to_owned();
        client.post(&format!("/task/new/upload/{id}"), photographs(["a.jpg"])).await;
        begun.push(id);
    }
    assert_eq!(client.commit(&begun[0]).await["uuid"], begun[0]);
    client.completed(&begun[0]).await;
    let datasets =
        async |service: &Service| service.get("/api/v1/datasets").await.ok(200)["datasets"].as_array().unwrap().len();
    assert_eq!(datasets(&service).await, 2);
    let service = Service::start_in(service.stop().await, |config| config.upload_expiry = Duration::ZERO).await;
    for _ in 0..500 {
        if datasets(&service).await == 1 {
            break;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let service = start_in(service.stop().await, false).await;
    assert!(error_of(&Client::of(&service).commit(&begun[1]).await).contains("not found"));
    assert_eq!(Client::of(&service).completed(&begun[0]).await["imagesCount"], 1);
}
