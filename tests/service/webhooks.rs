//! `/api/v1/jobs/{job_id}/webhooks`, and what the service sends there.

use std::net::SocketAddr;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use axum::extract::State;
use axum::http::{HeaderMap, StatusCode};
use hmac::{Hmac, KeyInit, Mac};
use multistage::config::ServerConfig;
use serde_json::{Value, json};
use tokio::net::TcpListener;

use crate::service::{Service, photographs};

const SECRET: &str = "a secret of enough letters";

/// Listens where the service tells of changes, and fails the first requests.
#[derive(Clone)]
struct Hook {
    address: SocketAddr,
    heard: Arc<Mutex<Vec<(HeaderMap, String)>>>,
    failures: Arc<AtomicUsize>,
}

impl Hook {
    async fn start(address: &str, failures: usize) -> Self {
        let listener = TcpListener::bind(address).await.unwrap();
        let address = listener.local_addr().unwrap();
        let hook = Self { address, heard: Arc::default(), failures: Arc::new(failures.into()) };
        let app = axum::Router::new().fallback(hear).with_state(hook.clone());
        tokio::spawn(async move { axum::serve(listener, app).await });
        hook
    }

    fn body(&self) -> Value {
        json!({"url": format!("http://{}/hook?x=y", self.address), "secret": SECRET})
    }

    fn heard(&self) -> Vec<(HeaderMap, String)> {
        self.heard.lock().unwrap().clone()
    }
}

async fn hear(State(hook): State<Hook>, headers: HeaderMap, body: String) -> StatusCode {
    if hook.failures.fetch_update(Ordering::SeqCst, Ordering::SeqCst, |left| left.checked_sub(1)).is_ok() {
        return StatusCode::INTERNAL_SERVER_ERROR;
    }
    hook.heard.lock().unwrap().push((headers, body));
    StatusCode::NO_CONTENT
}

fn allowing(config: &mut ServerConfig) {
    config.webhooks.allowed = vec!["127.0.0.1".parse().unwrap()];
}

async fn start() -> Service {
    Service::start_in(tempfile::tempdir().unwrap(), allowing).await
}

/// The deliveries of a job's only webhook, once they are as wanted.
async fn deliveries(service: &Service, job: &Value, wanted: impl Fn(&[Value]) -> bool) -> Vec<Value> {
    let start = Instant::now();
    loop {
        let list = service.get(job["links"]["webhooks"].as_str().unwrap()).await.ok(200);
        let found = list["webhooks"][0]["deliveries"].as_array().unwrap().clone();
        if wanted(&found) {
            return found;
        }
        assert!(start.elapsed() < Duration::from_secs(20), "waited too long: {list:#}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn all_delivered(deliveries: &[Value]) -> bool {
    deliveries.len() == 3 && deliveries.iter().all(|delivery| delivery["state"] == "delivered")
}

async fn job_with(service: &Service, webhook: &Value, mode: &str) -> Value {
    let form = photographs(["a.jpg", "b.jpg"]).text("webhook", webhook.to_string());
    let form = form.text("options", json!({ "mode": mode }).to_string());
    service.post_form("/api/v1/jobs", form).await.ok(202)
}

#[tokio::test(flavor = "multi_thread")]
async fn every_change_is_told_in_order_and_signed_also_to_who_fails_first() {
    let (service, hook) = (start().await, Hook::start("127.0.0.1:0", 2).await);
    let job = job_with(&service, &hook.body(), "panic").await;
    let told = deliveries(&service, &job, all_delivered).await;
    assert_eq!((&told[0]["attempts"], &told[1]["attempts"]), (&json!(3), &json!(1)));
    assert_eq!((&told[2]["last_status"], &told[2]["last_error"]), (&json!(204), &Value::Null));
    let heard = hook.heard();
    let states: Vec<_> = heard
        .iter()
        .map(|(headers, body)| {
            let signature = headers["x-multistage-signature"].to_str().unwrap();
            let (time, code) = signature.strip_prefix("t=").unwrap().split_once(",v1=").unwrap();
            let mut mac = Hmac::<sha2::Sha256>::new_from_slice(SECRET.as_bytes()).unwrap();
            mac.update(format!("{time}.{body}").as_bytes());
            let expected: String = mac.finalize().into_bytes().iter().map(|byte| format!("{byte:02x}")).collect();
            assert_eq!(code, expected);
            assert!((jiff::Timestamp::now().as_second() - time.parse::<i64>().unwrap()).abs() < 60);
            assert_eq!(headers["host"], hook.address.to_string());
            let event: Value = serde_json::from_str(body).unwrap();
            service.contract.check_named("WebhookEvent", &event);
            let delivery = format!("{}/{}", event["webhook_id"].as_str().unwrap(), event["event_id"]);
            assert_eq!(headers["x-multistage-delivery"], delivery);
            assert_eq!(event["job_id"], job["id"]);
            event
        })
        .collect();
    let named: Vec<_> = states.iter().map(|event| event["state"].as_str().unwrap()).collect();
    assert_eq!(named, ["queued", "running", "failed"]);
    assert_eq!(states[2]["error"]["code"], "panic");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_not_heard_is_told_after_a_restart() {
    let service = start().await;
    // Nobody listens there yet.
    let free = TcpListener::bind("127.0.0.1:0").await.unwrap();
    let address = free.local_addr().unwrap();
    drop(free);
    let job = job_with(&service, &json!({"url": format!("http://{address}/"), "secret": SECRET}), "quick").await;
    service.wait_state(&job, "succeeded").await;
    deliveries(&service, &job, |found| found[0]["attempts"].as_i64() > Some(1)).await;
    let service = Service::start_in(service.stop().await, allowing).await;
    let hook = Hook::start(&address.to_string(), 0).await;
    deliveries(&service, &job, all_delivered).await;
    let heard: Vec<Value> = hook.heard().iter().map(|(_, body)| serde_json::from_str(body).unwrap()).collect();
    assert_eq!(heard.iter().map(|event| &event["state"]).collect::<Vec<_>>(), ["queued", "running", "succeeded"]);
}

#[tokio::test(flavor = "multi_thread")]
async fn webhooks_are_added_listed_removed_and_given_up() {
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
        allowing(config);
        config.webhooks.max_attempts = 3;
    })
    .await;
    let hook = Hook::start("127.0.0.1:0", usize::MAX).await;
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let link = job["links"]["webhooks"].as_str().unwrap();
    let made = service.post_json(link, &hook.body()).await.ok(201);
    assert!(!made.to_string().contains(SECRET));
    for _ in 0..9 {
        service.post_json(link, &hook.body()).await.ok(201);
    }
    service.post_json(link, &hook.body()).await.assert_problem(422, "invalid_webhook");
    let list = service.get(link).await.ok(200);
    assert_eq!(list["webhooks"].as_array().unwrap().len(), 10);
    assert!(!list.to_string().contains(SECRET));
    for other in &list["webhooks"].as_array().unwrap()[1..] {
        service.delete(other["links"]["self"].as_str().unwrap()).await.ok(204);
    }
    service
        .delete(list["webhooks"][1]["links"]["self"].as_str().unwrap())
        .await
        .assert_problem(404, "webhook_not_found");
    service.post(job["links"]["cancel"].as_str().unwrap()).await.ok(202);
    let end = |found: &[Value]| found.first().is_some_and(|delivery| delivery["state"] == "given_up");
    let told = deliveries(&service, &job, end).await;
    assert_eq!((told.len(), &told[0]["attempts"], &told[0]["last_status"]), (1, &json!(3), &json!(500)));
    assert_eq!(told[0]["next_attempt_at"], Value::Null);
    for (body, code) in [
        (json!({"url": "http://[::1", "secret": SECRET}), "invalid_webhook"),
        (json!({"url": "https://example.com/", "secret": "short"}), "invalid_webhook"),
        (json!({"url": "https://example.com/".repeat(200), "secret": SECRET}), "invalid_webhook"),
        (json!({"url": "https://example.com/"}), "invalid_json"),
    ] {
        let answer = service.post_json(link, &body).await;
        assert_eq!(answer.json()["code"], code, "{body}");
        let dataset = job["dataset_id"].as_str().unwrap();
        let new = json!({"dataset_id": dataset, "options": {"mode": "quick"}, "webhook": body});
        assert_eq!(service.post_json("/api/v1/jobs", &new).await.json()["code"], code);
    }
    service.delete(job["links"]["self"].as_str().unwrap()).await.ok(204);
    service.get(link).await.assert_problem(404, "job_not_found");
}

/// Addresses that lead, in one way of writing or another, into the service's own network. `PORT` is the canary's.
const WITHIN: [&str; 48] = [
    "http://127.0.0.1:PORT/",
    "http://localhost:PORT/",
    "http://LOCALHOST:PORT/",
    "http://localhost.:PORT/",
    "http://127.1:PORT/",
    "http://127.0.1:PORT/",
    "http://127.0.0.1.:PORT/",
    "http://2130706433:PORT/",
    "http://0x7f000001:PORT/",
    "http://0x7f.0.0.1:PORT/",
    "http://0x7F.1:PORT/",
    "http://017700000001:PORT/",
    "http://0177.0.0.1:PORT/",
    "http://0177.0.0.01:PORT/",
    "http://127.000.000.001:PORT/",
    "http://0:PORT/",
    "http://0.0.0.0:PORT/",
    "http://127.127.127.127:PORT/",
    "http://[::1]:PORT/",
    "http://[0:0:0:0:0:0:0:1]:PORT/",
    "http://[::]:PORT/",
    "http://[::ffff:127.0.0.1]:PORT/",
    "http://[::ffff:7f00:1]:PORT/",
    "http://[::127.0.0.1]:PORT/",
    "http://[64:ff9b::7f00:1]:PORT/",
    "http://[2002:7f00:1::]:PORT/",
    "http://１２７.０.０.１:PORT/",
    "http://127。0。0。1:PORT/",
    "http://ⓛⓞⓒⓐⓛⓗⓞⓢⓣ:PORT/",
    "http://%31%32%37.0.0.1:PORT/",
    "http://127.0.0.1%2f@example.com:PORT/",
    "http://user:password@127.0.0.1:PORT/",
    "http://example.com@127.0.0.1:PORT/",
    "http://example.com#@127.0.0.1:PORT/",
    "http:\\\\127.0.0.1:PORT\\",
    "http:127.0.0.1:PORT/",
    " http://127.0.0.1:PORT/",
    "http://127.0.0.1:PORT\t/",
    "HTTP://127.0.0.1:PORT/",
    "https://127.0.0.1:PORT/",
    "http://169.254.169.254/latest/meta-data/",
    "http://[fd00:ec2::254]/latest/meta-data/",
    "http://10.0.0.1/",
    "http://192.168.0.1/",
    "http://[fe80::1]/",
    "ftp://127.0.0.1:PORT/",
    "file:///etc/passwd",
    "gopher://127.0.0.1:PORT/_x",
];

#[tokio::test(flavor = "multi_thread")]
async fn no_address_leads_into_the_own_network() {
    let canary = TcpListener::bind("0.0.0.0:0").await.unwrap();
    let port = canary.local_addr().unwrap().port();
    let canary_v6 = TcpListener::bind(("::1", port)).await.ok();
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| config.webhooks.max_attempts = 2).await;
    let dataset = service.post_json("/api/v1/datasets", &json!({})).await.ok(201)["id"].clone();
    let images = format!("/api/v1/datasets/{}/images", dataset.as_str().unwrap());
    service.post_form(&images, photographs(["a.jpg"])).await.ok(200);
    let (mut refused, mut accepted) = (0, Vec::new());
    for form in WITHIN {
        let url = form.replace("PORT", &port.to_string());
        let webhook = json!({"url": url, "secret": SECRET});
        let new = json!({"dataset_id": dataset, "options": {"mode": "quick"}, "webhook": webhook});
        let answer = service.post_json("/api/v1/jobs", &new).await;
        match answer.status.as_u16() {
            202 => accepted.push((form, answer.json())),
            _ => {
                answer.assert_problem(422, "invalid_webhook");
                refused += 1;
            }
        }
    }
    for (form, job) in &accepted {
        let tried = |found: &[Value]| found.iter().any(|delivery| delivery["attempts"].as_i64() > Some(0));
        let told = deliveries(&service, job, tried).await;
        let error = told[0]["last_error"].as_str().unwrap_or_else(|| panic!("{form} was reached"));
        assert!(error.contains("not a public address") || error.contains("no address"), "{form}: {error}");
        assert_eq!(told[0]["last_status"], Value::Null, "{form}");
    }
    for listener in [Some(canary), canary_v6].into_iter().flatten() {
        let hit = tokio::time::timeout(Duration::from_millis(200), listener.accept()).await;
        assert!(hit.is_err(), "the canary was reached: {hit:?}");
    }
    assert!(refused > 35 && refused + accepted.len() == WITHIN.len(), "{accepted:?}");
}
