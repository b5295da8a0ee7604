//! The service as its tests see it: the real program on a free port with a directory of its own, a quick engine instead of the
//! pipeline, and a client that holds every answer to `openapi.yaml`.
#![allow(dead_code, reason = "every test binary uses its own part")]

pub mod contract;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::atomic::{AtomicUsize, Ordering};
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use contract::Contract;
use multistage::config::ServerConfig;
use multistage::formats::report::{ImageReport, ImageState, InputSummary, ModelReport, Report, Software, StageReport};
use multistage::http::Server;
use multistage::jobs::Engine;
use multistage::pipeline::{Context, Needs, PipelineError, ProgressEvent, RunPaths, Stage, StageKey};
use reqwest::multipart::{Form, Part};
use reqwest::{Method, RequestBuilder, StatusCode};
use serde_json::{Value, json};

/// Stands for the pipeline. Its options say what happens:
/// `{"mode": "quick" | "hang" | "panic" | "no_model" | "disk_error" | "disk_full"}`; `hang` waits in `coarse_match` until it is
/// cancelled, unless an artifact says that it hung before; `disk_full` finds the disk full so many times as `full` says. Names with
/// `bad` are rejected, names with `lone` stay unregistered, and one with `large` makes a large model.
#[derive(Default)]
pub struct FakeEngine {
    pub runs: AtomicUsize,
    pub full: AtomicUsize,
    pub needs: Mutex<Needs>,
}

impl Engine for FakeEngine {
    fn validate(&self, options: &Value) -> Result<(), Vec<String>> {
        let known = ["quick", "hang", "panic", "no_model", "disk_error", "disk_full"];
        let mut errors = Vec::new();
        for (name, value) in options.as_object().into_iter().flatten() {
            match name.as_str() {
                "mode" if value.as_str().is_some_and(|mode| known.contains(&mode)) => {}
                "mode" => errors.push(format!("mode {value} is unknown")),
                "intake" | "iterations" => {}
                other => errors.push(format!("unknown option {other}")),
            }
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }

    fn needs(&self, _: &[PathBuf], _: &Value) -> Result<Needs, PipelineError> {
        Ok(*self.needs.lock().expect("no test panics with it"))
    }

    fn run(&self, paths: &RunPaths, options: &Value, context: &Context) -> Result<Report, PipelineError> {
        self.runs.fetch_add(1, Ordering::SeqCst);
        let mode = options["mode"].as_str().unwrap_or("quick");
        let key = |stage| StageKey { stage, iteration: None };
        let tell = |event| context.progress.report(event);
        let stages = [Stage::Intake, Stage::CoarseMatch, Stage::Export];
        tell(ProgressEvent::Plan(stages.map(key).to_vec()));
        for stage in stages {
            let (stage, marker) = (key(stage), paths.work_dir.join(stage.name()));
            tell(ProgressEvent::StageStarted { stage, total: 4 });
            let reused = marker.exists();
            tell(ProgressEvent::StageProgress { stage, done: 2, total: 4 });
            match (mode, stage.stage) {
                ("panic", Stage::CoarseMatch) => panic!("the fake engine was told to"),
                ("disk_error", Stage::CoarseMatch) => {
                    let source = std::io::Error::from_raw_os_error(5);
                    return Err(PipelineError::Io { stage: stage.stage, path: "x".into(), source });
                }
                ("disk_full", Stage::CoarseMatch) if self.full.load(Ordering::SeqCst) > 0 => {
                    self.full.fetch_sub(1, Ordering::SeqCst);
                    let source = std::io::Error::from(std::io::ErrorKind::StorageFull);
                    return Err(PipelineError::Io { stage: stage.stage, path: "x".into(), source });
                }
                ("hang", Stage::CoarseMatch) if !paths.work_dir.join("hung").exists() => {
                    std::fs::write(paths.work_dir.join("hung"), b"").expect("the work folder can be written");
                    loop {
                        context.check_cancelled()?;
                        std::thread::sleep(Duration::from_millis(5));
                    }
                }
                _ => {}
            }
            context.check_cancelled()?;
            std::fs::write(marker, b"").expect("the work folder can be written");
            let counts = [("things".to_owned(), 3.0)].into();
            tell(ProgressEvent::StageFinished { stage, reused, wall_s: 0.5, cpu_s: 0.25, counts });
        }
        Ok(self.write_outputs(paths, mode))
    }
}

impl FakeEngine {
    fn write_outputs(&self, paths: &RunPaths, mode: &str) -> Report {
        let mut names = Vec::new();
        collect(&paths.images_dir, "", &mut names);
        names.sort();
        let with_model = mode != "no_model";
        let images: Vec<_> = names.iter().map(|name| verdict(name, with_model)).collect();
        let registered = images.iter().filter(|image| image.state == ImageState::Registered).count();
        let model = ModelReport {
            id: 0,
            images: registered,
            points: 1000,
            points_3plus: 700,
            observations: 3500,
            mean_track_length: Some(3.5),
            mean_reprojection_error_px: Some(0.6),
            median_reprojection_error_px: None,
            stages: Vec::new(),
        };
        let report = Report {
            software: Software { name: "fake".into(), version: "0".into() },
            seed: 0,
            threads: 1,
            options: json!({}),
            input: InputSummary { images: images.len(), megapixels: 1.0 },
            wall_s: 1.0,
            cpu_s: 1.0,
            peak_rss_bytes: None,
            stages: vec![StageReport {
                name: "intake".into(),
                iteration: None,
                wall_s: 0.5,
                cpu_s: 0.25,
                reused: false,
                counts: BTreeMap::new(),
            }],
            models: if with_model { vec![model] } else { Vec::new() },
            images,
            look_alikes: Vec::new(),
            notes: Vec::new(),
        };
        let mut files = BTreeMap::from([
            ("report.json", serde_json::to_vec(&report).expect("a report is JSON")),
            ("report.html", b"<!doctype html><title>report</title>".to_vec()),
        ]);
        if with_model {
            let size = if names.iter().any(|name| name.contains("large")) { 9_000_000 } else { 100_000 };
            files.insert("ply/0/points.ply", (0..size).flat_map(u32::to_le_bytes).collect());
            files.insert("sparse/0/images.txt", b"# names: \xe7\x9f\xb3\n".to_vec());
        }
        for (path, bytes) in files {
            let path = paths.out_dir.join(path);
            std::fs::create_dir_all(path.parent().expect("below the folder")).expect("the folder can be made");
            std::fs::write(path, bytes).expect("the output can be written");
        }
        report
    }
}

fn collect(folder: &Path, prefix: &str, names: &mut Vec<String>) {
    for entry in std::fs::read_dir(folder).expect("the images can be listed") {
        let entry = entry.expect("an entry");
        let name = format!("{prefix}{}", entry.file_name().into_string().expect("UTF-8"));
        if entry.path().is_dir() { collect(&entry.path(), &format!("{name}/"), names) } else { names.push(name) }
    }
}

fn verdict(name: &str, with_model: bool) -> ImageReport {
    let state = match name {
        _ if name.contains("bad") => ImageState::Rejected,
        _ if name.contains("lone") || !with_model => ImageState::Unregistered,
        _ => ImageState::Registered,
    };
    let registered = state == ImageState::Registered;
    ImageReport {
        name: name.to_owned(),
        sha256: None,
        width: Some(64),
        height: Some(48),
        state,
        model: registered.then_some(0),
        features: Some(500),
        registered_in: registered.then(|| "coarse_model".to_owned()),
        inliers: registered.then_some(200),
        mean_reprojection_error_px: registered.then_some(0.5),
        focal_px: registered.then_some(70.0),
        reason: (!registered).then(|| "too_few_matches".to_owned()),
        advice: (!registered).then(|| "Take more photographs around this one.".to_owned()),
    }
}

/// A running service with a client.
pub struct Service {
    pub folder: Option<tempfile::TempDir>,
    pub server: Option<Server>,
    pub engine: Arc<FakeEngine>,
    pub base: String,
    pub contract: Arc<Contract>,
    http: reqwest::Client,
}

/// An answer that passed the contract.
pub struct Answer {
    pub status: StatusCode,
    pub headers: reqwest::header::HeaderMap,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn json(&self) -> Value {
        serde_json::from_slice(&self.body).unwrap_or_else(|error| panic!("{error}: {}", self.text()))
    }

    pub fn text(&self) -> String {
        String::from_utf8_lossy(&self.body).into_owned()
    }

    pub fn header(&self, name: &str) -> &str {
        self.headers.get(name).unwrap_or_else(|| panic!("no {name}")).to_str().expect("text")
    }

    /// Panics unless this is the problem with a code.
    #[track_caller]
    pub fn assert_problem(&self, status: u16, code: &str) {
        assert_eq!(self.status.as_u16(), status, "{}", self.text());
        assert_eq!(self.header("content-type"), "application/problem+json");
        let problem = self.json();
        assert_eq!(problem["code"], code, "{problem}");
        assert_eq!(problem["request_id"], self.header("x-request-id"));
    }

    #[track_caller]
    pub fn ok(self, status: u16) -> Value {
        assert_eq!(self.status.as_u16(), status, "{}", self.text());
        if self.body.is_empty() { Value::Null } else { self.json() }
    }
}

impl Service {
    pub async fn start() -> Self {
        Self::start_in(tempfile::tempdir().expect("a temporary folder"), |_| {}).await
    }

    pub async fn start_in(folder: tempfile::TempDir, change: impl FnOnce(&mut ServerConfig)) -> Self {
        let engine = Arc::new(FakeEngine::default());
        let mut config = ServerConfig::for_testing(folder.path());
        change(&mut config);
        let server = Server::start(config, Arc::<FakeEngine>::clone(&engine)).await.expect("the service starts");
        let base = format!("http://{}", server.address);
        let contract = Arc::new(Contract::load());
        Self { folder: Some(folder), server: Some(server), engine, base, contract, http: reqwest::Client::new() }
    }

    /// Where clients of NodeODM are served, with `nodeodm_bind` in the settings.
    pub fn nodeodm(&self) -> String {
        format!("http://{}", self.server.as_ref().expect("it runs").nodeodm_address.expect("it was asked for"))
    }

    pub fn data_dir(&self) -> &Path {
        self.folder.as_ref().expect("a folder").path()
    }

    /// Stops the service and gives its folder back, to start again in.
    pub async fn stop(mut self) -> tempfile::TempDir {
        self.server.take().expect("it runs").stop().await;
        self.folder.take().expect("a folder")
    }

    pub fn request(&self, method: &str, path: &str) -> RequestBuilder {
        self.http.request(method.parse::<Method>().expect("a method"), format!("{}{path}", self.base))
    }

    /// Sends a request and holds the answer to the contract.
    pub async fn send(&self, request: RequestBuilder) -> Answer {
        let request = request.build().expect("a request");
        let (method, path) = (request.method().clone(), request.url().path().to_owned());
        let response = self.http.execute(request).await.expect("an answer");
        let (status, headers) = (response.status(), response.headers().clone());
        let body = response.bytes().await.expect("a body").to_vec();
        assert!(headers.contains_key("x-request-id"), "{method} {path}");
        assert_eq!(headers["x-content-type-options"], "nosniff", "{method} {path}");
        if let Some(operation) = self.contract.operation(method.as_str(), &path)
            && method != Method::HEAD
        {
            let media_type = headers.get("content-type").and_then(|value| value.to_str().ok());
            self.contract.check(&operation, status.as_u16(), media_type, &body);
        } else if status.is_client_error() && method != Method::HEAD {
            self.contract.check_named("Problem", &serde_json::from_slice(&body).expect("a problem"));
        }
        Answer { status, headers, body }
    }

    pub async fn get(&self, path: &str) -> Answer {
        self.send(self.request("GET", path)).await
    }

    pub async fn post(&self, path: &str) -> Answer {
        self.send(self.request("POST", path)).await
    }

    pub async fn post_json(&self, path: &str, body: &Value) -> Answer {
        self.send(self.request("POST", path).json(body)).await
    }

    pub async fn delete(&self, path: &str) -> Answer {
        self.send(self.request("DELETE", path)).await
    }

    pub async fn post_form(&self, path: &str, form: Form) -> Answer {
        self.send(self.request("POST", path).multipart(form)).await
    }

    /// Queues a job on three photographs.
    pub async fn job(&self, mode: &str) -> Value {
        let form = photographs(["a.jpg", "b.jpg", "sub/c.jpg"]).text("options", json!({ "mode": mode }).to_string());
        self.post_form("/api/v1/jobs", form).await.ok(202)
    }

    /// Waits until a job fulfils a condition.
    pub async fn wait(&self, job: &Value, what: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let now = self.get(job["links"]["self"].as_str().expect("a link")).await.ok(200);
            if what(&now) {
                return now;
            }
            assert!(start.elapsed() < Duration::from_secs(20), "waited too long: {now:#}");
            tokio::time::sleep(Duration::from_millis(20)).await;
        }
    }

    /// Waits until a job is in a state.
    pub async fn wait_state(&self, job: &Value, state: &str) -> Value {
        self.wait(job, |job| job["state"] == state).await
    }

    /// Waits until the fake engine hangs in `coarse_match`.
    pub async fn wait_hanging(&self, job: &Value) -> Value {
        self.wait(job, |job| job["stage"]["name"] == "coarse_match" && job["stage"]["done"] == 2).await
    }
}

/// A form with photographs of these names, each with bytes of its own.
pub fn photographs<'a>(names: impl IntoIterator<Item = &'a str>) -> Form {
    names.into_iter().fold(Form::new(), |form, name| form.part("images", file(name, name.as_bytes())))
}

/// A file part.
pub fn file(name: &str, bytes: &[u8]) -> Part {
    Part::bytes(bytes.to_vec()).file_name(name.to_owned())
}

/// A photograph of this width and height that shows noise, so features everywhere; by its seed another.
pub fn noise([width, height]: [u32; 2], seed: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    let image = image::RgbImage::from_fn(width, height, |x, y| {
        let noise = (x / 3).wrapping_mul(2_654_435_761) ^ (y / 3).wrapping_mul(40_503).wrapping_add(seed * 77);
        image::Rgb([(noise >> 9) as u8, (noise >> 13) as u8, (noise >> 17) as u8])
    });
    image.write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg).unwrap();
    bytes
}

/// A small JPEG, twice as wide as high, with this orientation tag.
pub fn jpeg(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    let image = image::RgbImage::from_fn(width, height, |x, y| image::Rgb([x as u8, y as u8, 128]));
    image.write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg).expect("a JPEG");
    bytes
}

/// Every file below a folder, relative.
pub fn files_below(folder: &Path) -> Vec<String> {
    let mut names = Vec::new();
    if folder.is_dir() {
        collect(folder, "", &mut names);
    }
    names.sort();
    names
}
