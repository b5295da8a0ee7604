//! Who may do what, and what pages of other sites may not.

use std::collections::BTreeSet;

use multistage::config::ServerConfig;
use multistage::store::{DataDir, Db, Scope, create_token};
use serde_json::{Value, json};

use crate::service::{Answer, Service, photographs};

/// A service that wants tokens, and some of them.
struct Guarded {
    service: Service,
    db: Db,
}

impl Guarded {
    async fn start(change: impl FnOnce(&mut ServerConfig)) -> Self {
        let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
            config.access.token_required = true;
            change(config);
        })
        .await;
        let db = Db::open(&DataDir::database_in(service.data_dir())).await.unwrap();
        Self { service, db }
    }

    async fn token(&self, name: &str, scopes: &[Scope]) -> String {
        create_token(&self.db, name, scopes).await.unwrap()
    }

    async fn send(&self, token: &str, method: &str, path: &str) -> Answer {
        self.service.send(self.service.request(method, path).bearer_auth(token)).await
    }

    async fn job(&self, token: &str) -> Value {
        let form = photographs(["a.jpg", "b.jpg"]);
        self.service.send(self.service.request("POST", "/api/v1/jobs").bearer_auth(token).multipart(form)).await.ok(202)
    }
}

/// Every documented operation with an address, its parameters filled in.
fn addresses(service: &Service, job: &str, dataset: &str, upload: &str) -> Vec<(String, String)> {
    let fill = |path: String| {
        path.replace("{job_id}", job)
            .replace("{dataset_id}", dataset)
            .replace("{upload_id}", upload)
            .replace("{webhook_id}", NOTHING)
            .replace("{n}", "0")
            .replace("{path}", "report.json")
    };
    service.contract.operations().into_iter().map(|op| (op.method.to_uppercase(), fill(op.path))).collect()
}

const NOTHING: &str = "00000000-0000-7000-8000-000000000000";
/// What tells nothing about anybody's things.
const OPEN: [&str; 5] = ["/healthz", "/readyz", "/openapi.yaml", "/", "/static/report.json"];

#[tokio::test(flavor = "multi_thread")]
async fn without_a_valid_token_every_address_says_the_same() {
    let guarded = Guarded::start(|config| config.access.failures_per_min = 1000).await;
    let service = &guarded.service;
    let mut bodies = BTreeSet::new();
    for (method, path) in addresses(service, NOTHING, NOTHING, NOTHING) {
        for token in [None, Some("msf_wrong"), Some("")] {
            let request = service.request(&method, &path).header("tus-resumable", "1.0.0");
            let request = token.into_iter().fold(request, |request, token| request.bearer_auth(token));
            let answer = service.send(request).await;
            if OPEN.contains(&path.as_str()) {
                assert_ne!(answer.status.as_u16(), 401, "{path}");
                continue;
            }
            assert_eq!(answer.status.as_u16(), 401, "{method} {path}");
            assert!(answer.header("www-authenticate").contains("Bearer"));
            if method != "HEAD" {
                let mut body = answer.json();
                body.as_object_mut().unwrap().remove("request_id");
                bodies.insert(body.to_string());
            }
        }
    }
    assert_eq!(bodies.len(), 1, "{bodies:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn scopes_say_what_a_token_may() {
    let guarded = Guarded::start(|_| {}).await;
    let reader = guarded.token("reader", &[Scope::Read]).await;
    let sender = guarded.token("sender", &[Scope::Submit]).await;
    guarded.send(&reader, "GET", "/api/v1/jobs").await.ok(200);
    guarded.send(&reader, "POST", "/api/v1/datasets").await.assert_problem(403, "forbidden");
    guarded.send(&sender, "GET", "/api/v1/jobs").await.assert_problem(403, "forbidden");
    guarded.job(&sender).await;
    // As browsers ask for it.
    let basic = guarded.service.request("GET", "/api/v1/jobs").basic_auth("anybody", Some(&reader));
    guarded.service.send(basic).await.ok(200);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_thing_of_another_token_is_not_there() {
    let guarded = Guarded::start(|_| {}).await;
    let both = [Scope::Read, Scope::Submit];
    let (mine, other) = (guarded.token("mine", &both).await, guarded.token("other", &both).await);
    let admin = guarded.token("admin", &[Scope::Admin]).await;
    let service = &guarded.service;
    let job = guarded.job(&mine).await;
    let id = |value: &Value| value.as_str().unwrap().to_owned();
    let (job_id, dataset_id) = (id(&job["id"]), id(&job["dataset_id"]));
    let create = service.request("POST", "/api/v1/uploads").bearer_auth(&mine).header("tus-resumable", "1.0.0");
    let upload = service.send(create.header("upload-length", "5").header("upload-concat", "partial")).await;
    let upload_id = upload.header("location").rsplit('/').next().unwrap().to_owned();
    for _ in 0..200 {
        let now = guarded.send(&mine, "GET", &format!("/api/v1/jobs/{job_id}")).await.ok(200);
        if now["state"] == "succeeded" {
            break;
        }
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
    let mut tried = 0;
    for (method, path) in addresses(service, &job_id, &dataset_id, &upload_id) {
        if path.contains(&job_id) || path.contains(&dataset_id) || path.contains(&upload_id) {
            let request = service.request(&method, &path).header("tus-resumable", "1.0.0");
            let there = service.send(request.bearer_auth(&other)).await;
            assert_eq!(there.status.as_u16(), 404, "{method} {path}");
            // And it looks like one that never was.
            let path = path.replace(&job_id, NOTHING).replace(&dataset_id, NOTHING).replace(&upload_id, NOTHING);
            let request = service.request(&method, &path).header("tus-resumable", "1.0.0");
            let never = service.send(request.bearer_auth(&other)).await;
            if method != "HEAD" {
                assert_eq!(there.json()["code"], never.json()["code"], "{method} {path}");
            }
            tried += 1;
        }
    }
    assert!(tried > 15, "{tried}");
    for (path, list) in [("/api/v1/jobs", "jobs"), ("/api/v1/datasets", "datasets")] {
        for (token, count) in [(&mine, 1), (&other, 0), (&admin, 1)] {
            let page = guarded.send(token, "GET", path).await.ok(200);
            assert_eq!(page[list].as_array().unwrap().len(), count, "{path}");
        }
    }
    let new = service.request("POST", "/api/v1/jobs").bearer_auth(&other).json(&json!({"dataset_id": dataset_id}));
    service.send(new).await.assert_problem(404, "dataset_not_found");
    let list = format!("final;/api/v1/uploads/{upload_id}");
    use base64::Engine;
    let b64 = |text: &str| base64::prelude::BASE64_STANDARD.encode(text);
    let metadata = format!("dataset {},path {}", b64(&dataset_id), b64("x.jpg"));
    let steal = service.request("POST", "/api/v1/uploads").bearer_auth(&other).header("tus-resumable", "1.0.0");
    let steal = steal.header("upload-concat", list).header("upload-metadata", metadata);
    service.send(steal).await.assert_problem(404, "dataset_not_found");
    guarded.send(&admin, "DELETE", &format!("/api/v1/jobs/{job_id}")).await.ok(204);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_revoked_token_opens_nothing_at_once() {
    let guarded = Guarded::start(|_| {}).await;
    let token = guarded.token("short", &[Scope::Read]).await;
    guarded.send(&token, "GET", "/api/v1/jobs").await.ok(200);
    let mut tx = guarded.db.write().await.unwrap();
    assert!(multistage::store::db::tokens::revoke(&mut tx, "short", 1).await.unwrap());
    tx.commit().await.unwrap();
    guarded.send(&token, "GET", "/api/v1/jobs").await.assert_problem(401, "unauthorized");
}

#[tokio::test(flavor = "multi_thread")]
async fn guesses_and_floods_are_slowed() {
    let guarded = Guarded::start(|config| config.access.requests_per_s = 2).await;
    let token = guarded.token("busy", &[Scope::Read]).await;
    let mut statuses = Vec::new();
    for _ in 0..40 {
        let answer = guarded.send(&token, "GET", "/api/v1/jobs").await;
        if answer.status.as_u16() == 429 {
            assert!(answer.header("retry-after").parse::<u32>().unwrap() >= 1);
        }
        statuses.push(answer.status.as_u16());
    }
    assert_eq!(statuses[..20], [200; 20], "a burst is fine");
    assert!(statuses.contains(&429), "{statuses:?}");
    for _ in 0..10 {
        guarded.send("msf_guess", "GET", "/api/v1/jobs").await.assert_problem(401, "unauthorized");
    }
    guarded.send("msf_guess", "GET", "/api/v1/jobs").await.assert_problem(429, "rate_limited");
    let right = guarded.token("right", &[Scope::Read]).await;
    guarded.send(&right, "GET", "/api/v1/jobs").await.assert_problem(429, "rate_limited");
}

#[tokio::test(flavor = "multi_thread")]
async fn pages_of_other_sites_change_nothing() {
    let service = Service::start().await;
    let own = service.base.clone();
    let mut refused = 0;
    for (method, path) in addresses(&service, NOTHING, NOTHING, NOTHING) {
        if ["GET", "HEAD", "OPTIONS"].contains(&method.as_str()) {
            continue;
        }
        for (name, value) in
            [("origin", "https://evil.example"), ("origin", "null"), ("sec-fetch-site", "cross-site"), ("origin", "x")]
        {
            let request = service.request(&method, &path).header(name, value);
            let form = request.header("content-type", "application/x-www-form-urlencoded").body("name=x");
            service.send(form).await.assert_problem(403, "cross_site");
            refused += 1;
        }
    }
    assert!(refused >= 40, "{refused}");
    let mine =
        service.request("POST", "/api/v1/datasets").header("origin", own).header("sec-fetch-site", "same-origin");
    service.send(mine.json(&json!({}))).await.ok(201);
}

#[tokio::test(flavor = "multi_thread")]
async fn only_listed_sites_may_read() {
    let listed = "https://survey.example";
    let service =
        Service::start_in(tempfile::tempdir().unwrap(), |c| c.access.cors_origins = vec![listed.to_owned()]).await;
    let ask = async |origin: &str, method: &str, preflight: bool| {
        let request = service.request(method, "/api/v1/uploads").header("origin", origin);
        let request = if preflight { request.header("access-control-request-method", "PATCH") } else { request };
        request.send().await.unwrap()
    };
    for (origin, may) in [(listed, true), ("https://evil.example", false), ("https://survey.example.evil", false)] {
        for (method, preflight) in [("OPTIONS", true), ("OPTIONS", false), ("POST", false)] {
            let answer = ask(origin, method, preflight).await;
            let allowed = answer.headers().get("access-control-allow-origin").map(|value| value.to_str().unwrap());
            assert_eq!(allowed, may.then_some(origin), "{method}");
            assert!(answer.headers()["vary"].to_str().unwrap().contains("origin"));
            assert!(answer.headers().get("access-control-allow-credentials").is_none());
            if may && preflight {
                let headers = answer.headers()["access-control-allow-headers"].to_str().unwrap();
                assert!(headers.contains("upload-offset") && headers.contains("tus-resumable"));
                assert!(answer.headers()["access-control-allow-methods"].to_str().unwrap().contains("PATCH"));
            }
            if may && !preflight {
                let exposed = answer.headers()["access-control-expose-headers"].to_str().unwrap();
                for name in ["location", "upload-offset", "upload-length", "upload-expires", "tus-resumable"] {
                    assert!(exposed.contains(name), "{name}");
                }
            }
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn every_answer_is_fenced() {
    let service = Service::start().await;
    for (method, path) in addresses(&service, NOTHING, NOTHING, NOTHING) {
        let answer = service.send(service.request(&method, &path)).await;
        let policy = answer.header("content-security-policy");
        assert!(policy.contains("default-src 'none'") || policy.contains("default-src 'self'"), "{path}: {policy}");
        assert_eq!(answer.header("x-frame-options"), "DENY");
        assert_eq!(answer.header("referrer-policy"), "no-referrer");
    }
}
