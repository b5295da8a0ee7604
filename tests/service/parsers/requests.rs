//! Readers of what comes within requests: forms, and the headers of resumable uploads. They are reached as senders
//! reach them, through the router of a service whose directory lies in memory; an answer of its own fault (5xx) is a
//! failure.

use std::path::Path;
use std::sync::atomic::{AtomicU32, Ordering};
use std::sync::{Arc, OnceLock};

use axum::Router;
use axum::body::Body;
use axum::http::{HeaderValue, Request, Response, StatusCode};
use multistage::config::ServerConfig;
use multistage::http::{AppState, router};
use multistage::jobs::{Hub, Jobs, PipelineEngine};
use multistage::store::Store;
use multistage::store::db::{datasets, now_ms};
use tokio::runtime::Runtime;
use tower::ServiceExt;
use uuid::Uuid;

/// The dataset that everything is sent to.
const DATASET: Uuid = Uuid::from_u128(1);
/// After so many requests that stored something, it is emptied.
const KEPT: u32 = 50;
/// The headers that lines of the input are values of, in this order; the rest is the body.
const TUS_HEADERS: [&str; 6] =
    ["upload-length", "upload-metadata", "upload-concat", "upload-defer-length", "upload-checksum", "upload-offset"];

struct Service {
    runtime: Runtime,
    router: Router,
    store: Arc<Store>,
    stored: AtomicU32,
    /// Kept as long as the process.
    _folder: tempfile::TempDir,
}

fn service() -> &'static Service {
    static SERVICE: OnceLock<Service> = OnceLock::new();
    SERVICE.get_or_init(|| {
        let memory = Path::new("/dev/shm");
        let folder = if memory.is_dir() { tempfile::tempdir_in(memory) } else { tempfile::tempdir() };
        let folder = folder.expect("a folder can be made");
        let runtime = Runtime::new().expect("a runtime starts");
        let mut config = ServerConfig::for_testing(folder.path());
        config.access.requests_per_s = u32::MAX;
        let store = Arc::new(runtime.block_on(Store::open(folder.path())).expect("the store opens"));
        let hub = Arc::new(Hub::default());
        let jobs = Jobs { store: Arc::clone(&store), hub, engine: Arc::new(PipelineEngine), figures: Arc::default() };
        let router = router(AppState::new(jobs, config, tokio_util::sync::CancellationToken::new()));
        let service = Service { runtime, router, store, stored: AtomicU32::new(0), _folder: folder };
        service.runtime.block_on(service.make_dataset());
        service
    })
}

impl Service {
    async fn make_dataset(&self) {
        let mut tx = self.store.db.write().await.expect("the database is writable");
        datasets::insert(&mut tx, DATASET, "fuzz", now_ms(), None, None).await.expect("a dataset can be made");
        tx.commit().await.expect("the database is writable");
    }

    async fn send(&self, request: Request<Body>) -> Response<Body> {
        let asked = format!("{} {}", request.method(), request.uri());
        let answer = self.router.clone().oneshot(request).await.expect("the router answers");
        assert!(!answer.status().is_server_error(), "{} to {asked}", answer.status());
        answer
    }

    /// Empties the dataset now and then, so that nothing grows.
    async fn tidy(&self) {
        if self.stored.fetch_add(1, Ordering::Relaxed) % KEPT != KEPT - 1 {
            return;
        }
        let delete = Request::delete(format!("/api/v1/datasets/{DATASET}")).body(Body::empty());
        self.send(delete.expect("a request")).await;
        self.make_dataset().await;
    }
}

/// The body of a form of photographs, with the boundary `X`.
pub fn form(bytes: &[u8]) {
    let service = service();
    service.runtime.block_on(async {
        let request = Request::post(format!("/api/v1/datasets/{DATASET}/images"))
            .header("content-type", "multipart/form-data; boundary=X")
            .body(Body::from(bytes.to_vec()));
        if service.send(request.expect("a request")).await.status().is_success() {
            service.tidy().await;
        }
    });
}

/// The headers of a new upload and of the first bytes for it, and these bytes.
pub fn tus_headers(bytes: &[u8]) {
    let mut lines = bytes.splitn(TUS_HEADERS.len() + 1, |byte| *byte == b'\n');
    let mut headers = vec![("tus-resumable", HeaderValue::from_static("1.0.0"))];
    for (name, line) in TUS_HEADERS.into_iter().zip(&mut lines) {
        // What no header can hold never comes this far.
        if let (false, Ok(value)) = (line.is_empty(), HeaderValue::from_bytes(line)) {
            headers.push((name, value));
        }
    }
    let body = lines.next().unwrap_or_default().to_vec();
    let request = |method: &str, path: &str, body: Vec<u8>| {
        let start = Request::builder().method(method).uri(path);
        let start = start.header("content-type", "application/offset+octet-stream");
        let whole = headers.iter().fold(start, |request, (name, value)| request.header(*name, value));
        whole.body(Body::from(body)).expect("a request")
    };
    let service = service();
    service.runtime.block_on(async {
        let made = service.send(request("POST", "/api/v1/uploads", Vec::new())).await;
        let Some(location) = made.headers().get("location").filter(|_| made.status() == StatusCode::CREATED) else {
            return;
        };
        let location = location.to_str().expect("an address").to_owned();
        service.send(request("PATCH", &location, body)).await;
        service.send(request("HEAD", &location, Vec::new())).await;
        service.send(request("DELETE", &location, Vec::new())).await;
        service.tidy().await;
    });
}
