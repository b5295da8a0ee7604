//! Power cuts. The real program works under strace, which records every write, sync and rename; then the record is
//! played back to many moments, each time onto a disk that has what was synced and of the rest nothing, or any part.
//! The program starts on what is left, and whatever it had acknowledged until that moment must be there.
//!
//! `MULTISTAGE_POWER_CUTS=100 cargo test --locked --test program power_loss -- --nocapture` cuts 100 times. It needs strace.

mod record;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};
use std::time::Duration;

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use futures_util::StreamExt;
use multistage::math::Rng;
use record::{CALLS, Disk, Line, parse};
use reqwest::{Client, RequestBuilder, Response};
use serde_json::{Value, json};
use sha2::Digest;

use crate::program::Program;

/// Power cuts of an ordinary run.
const CUTS: usize = 10;

/// What an answer promised.
#[derive(Clone, Debug)]
enum Promise {
    /// A dataset.
    Dataset(String),
    /// A deleted one is not there any more.
    Gone(String),
    /// A photograph of a dataset: its path and its bytes.
    Photograph(String, String, Vec<u8>),
    /// An upload with so many bytes.
    Upload(String, u64),
    /// A job.
    Job(String),
    /// A job that has come to its end.
    Over(String),
}

/// Promises by the id of the request whose answer made them.
#[derive(Default)]
struct Promises(Vec<(String, Promise)>);

impl Promises {
    fn make(&mut self, response: &Response, status: u16, promise: Promise) {
        assert_eq!(response.status(), status, "{}", response.url());
        self.0.push((response.headers()["x-request-id"].to_str().unwrap().to_owned(), promise));
    }
}

/// Bytes that no two numbers share.
fn bytes(number: usize) -> Vec<u8> {
    (0..3000 + number * 37).map(|at| (at * (number + 3) % 251) as u8).collect()
}

fn tus(request: RequestBuilder) -> RequestBuilder {
    request.header("tus-resumable", "1.0.0")
}

fn patch(request: RequestBuilder, offset: usize, bytes: &[u8]) -> RequestBuilder {
    let request = tus(request).header("content-type", "application/offset+octet-stream");
    request.header("upload-offset", offset).body(bytes.to_vec())
}

async fn upload(base: &str, dataset: &str, number: usize) -> Promises {
    let (http, mut promises) = (Client::new(), Promises::default());
    let (path, bytes) = (format!("{}/{number}.jpg", number % 3), bytes(number));
    let metadata = format!("dataset {},path {}", BASE64_STANDARD.encode(dataset), BASE64_STANDARD.encode(&path));
    let create = tus(http.post(format!("{base}/api/v1/uploads")));
    let create = create.header("upload-length", bytes.len()).header("upload-metadata", metadata);
    let stored = Promise::Photograph(dataset.to_owned(), path.clone(), bytes.clone());
    if number.is_multiple_of(2) {
        let create = create.header("content-type", "application/offset+octet-stream").body(bytes);
        promises.make(&create.send().await.unwrap(), 201, stored);
        return promises;
    }
    let created = create.send().await.unwrap();
    let link = created.headers()["location"].to_str().unwrap().to_owned();
    promises.make(&created, 201, Promise::Upload(link.clone(), 0));
    let half = bytes.len() / 2;
    let first = patch(http.patch(format!("{base}{link}")), 0, &bytes[..half]).send().await.unwrap();
    promises.make(&first, 204, Promise::Upload(link.clone(), half as u64));
    let second = patch(http.patch(format!("{base}{link}")), half, &bytes[half..]).send().await.unwrap();
    promises.make(&second, 204, stored);
    promises
}

/// Everything that makes something durable, some of it at once; what the answers promised.
async fn work(base: &str) -> Promises {
    let (http, mut promises) = (Client::new(), Promises::default());
    let mut datasets = Vec::new();
    for _ in 0..3 {
        let made = http.post(format!("{base}/api/v1/datasets")).json(&json!({})).send().await.unwrap();
        let id = made.headers()["location"].to_str().unwrap().rsplit('/').next().unwrap().to_owned();
        promises.make(&made, 201, Promise::Dataset(id.clone()));
        datasets.push(id);
    }
    let uploads = futures_util::stream::iter(0..12).map(|number| upload(base, &datasets[number % 2], number));
    for done in uploads.buffer_unordered(4).collect::<Vec<_>>().await {
        promises.0.extend(done.0);
    }
    for numbers in [20..24, 24..27] {
        let mut form = reqwest::multipart::Form::new();
        for number in numbers.clone() {
            let part = reqwest::multipart::Part::bytes(bytes(number)).file_name(format!("sub/{number}.jpg"));
            form = form.part("images", part);
        }
        let link = format!("{base}/api/v1/datasets/{}/images", datasets[0]);
        let stored = http.post(link).multipart(form).send().await.unwrap();
        for number in numbers {
            let promise = Promise::Photograph(datasets[0].clone(), format!("sub/{number}.jpg"), bytes(number));
            promises.make(&stored, 200, promise);
        }
    }
    let queued = http.post(format!("{base}/api/v1/jobs")).json(&json!({"dataset_id": datasets[0]}));
    let queued = queued.send().await.unwrap();
    let job = queued.headers()["location"].to_str().unwrap().to_owned();
    promises.make(&queued, 202, Promise::Job(job.clone()));
    loop {
        let seen = http.get(format!("{base}{job}")).send().await.unwrap();
        let id = seen.headers()["x-request-id"].to_str().unwrap().to_owned();
        if seen.json::<Value>().await.unwrap()["finished_at"].is_string() {
            promises.0.push((id, Promise::Over(job.clone())));
            break;
        }
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    let deleted = http.delete(format!("{base}/api/v1/datasets/{}", datasets[2])).send().await.unwrap();
    promises.make(&deleted, 204, Promise::Gone(datasets[2].clone()));
    promises
}

/// What is missing of a promise.
async fn broken(base: &str, data_dir: &Path, promise: &Promise) -> Option<String> {
    let http = Client::new();
    let status = async |path: &str| tus(http.get(format!("{base}{path}"))).send().await.unwrap().status().as_u16();
    let whole = match promise {
        Promise::Dataset(id) => status(&format!("/api/v1/datasets/{id}")).await == 200,
        Promise::Gone(id) => status(&format!("/api/v1/datasets/{id}")).await == 404,
        Promise::Job(link) => status(link).await == 200,
        Promise::Over(link) => {
            let job: Value = http.get(format!("{base}{link}")).send().await.unwrap().json().await.unwrap();
            job["finished_at"].is_string()
        }
        Promise::Upload(link, offset) => {
            let found = tus(http.head(format!("{base}{link}"))).send().await.unwrap();
            let there =
                found.headers().get("upload-offset").map(|there| there.to_str().unwrap().parse::<u64>().unwrap());
            there.is_some_and(|there| there >= *offset)
        }
        Promise::Photograph(dataset, path, bytes) => {
            let link = format!("{base}/api/v1/datasets/{dataset}/images?limit=1000");
            let listed: Value = http.get(link).send().await.unwrap().json().await.unwrap();
            let sha256: String = sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect();
            let images = listed["images"].as_array().into_iter().flatten();
            let is_listed = images.into_iter().any(|image| image["path"] == **path && image["sha256"] == *sha256);
            let file = data_dir.join("datasets").join(dataset).join("images").join(path);
            is_listed && std::fs::read(file).is_ok_and(|there| there == *bytes)
        }
    };
    (!whole).then(|| match promise {
        Promise::Photograph(dataset, path, _) => format!("photograph {dataset}/{path}"),
        other => format!("{other:?}"),
    })
}

/// The program's work, recorded.
struct Recorded {
    root: PathBuf,
    lines: Vec<Line>,
    /// The line that began to send the answer to a request.
    sent: BTreeMap<String, usize>,
    promises: Promises,
}

/// None without strace.
async fn record() -> Option<Recorded> {
    let strace = Command::new("strace").arg("-V").stdout(Stdio::null()).status();
    if !strace.is_ok_and(|status| status.success()) {
        return None;
    }
    let folder = tempfile::tempdir().unwrap();
    let (root, record) = (folder.path().canonicalize().unwrap().join("data"), folder.path().join("record"));
    std::fs::create_dir(&root).unwrap();
    let mut traced = Command::new("strace");
    traced.args(["-f", "-q", "-xx", "-s", "4000000", "-e", &format!("trace={CALLS}"), "-o"]);
    traced.arg(&record).arg(env!("CARGO_BIN_EXE_multistage"));
    let mut program = Program::start_as(traced, &root, &[], Stdio::inherit());
    let promises = work(&program.base).await;
    // strace ends with the program, which it would let go on if it were killed itself.
    let strace = program.id();
    let children = std::fs::read_to_string(format!("/proc/{strace}/task/{strace}/children")).unwrap();
    assert!(Command::new("kill").arg("-9").args(children.split_whitespace()).status().unwrap().success());
    program.wait_for_end();
    let lines = parse(&String::from_utf8_lossy(&std::fs::read(record).unwrap()));
    let mut sent = BTreeMap::new();
    for (at, line) in lines.iter().enumerate().filter(|(_, line)| line.begins_to_send()) {
        let bytes = line.bytes();
        let text = String::from_utf8_lossy(&bytes);
        for id in text.split("x-request-id: ").skip(1).filter_map(|rest| rest.get(..36)) {
            sent.entry(id.to_owned()).or_insert(at);
        }
    }
    Some(Recorded { root, lines, sent, promises })
}

impl Recorded {
    /// Cuts the power after a line, starts the program on what is left, and gives what is missing and how much was promised.
    async fn cut(&self, after: usize, folders_sync: bool, keeps: &mut dyn FnMut() -> bool) -> (Vec<String>, usize) {
        let mut disk = Disk::new(&self.root, folders_sync);
        self.lines[..=after].iter().for_each(|line| disk.take(line));
        let folder = tempfile::tempdir().unwrap();
        disk.restore(folder.path(), keeps);
        // The last word on each thing: what was deleted since need not be there.
        let kept: Vec<&Promise> =
            self.promises.0.iter().filter(|(id, _)| self.sent[id] <= after).map(|(_, p)| p).collect();
        let gone = |promise: &Promise| {
            kept.iter()
                .any(|other| matches!((promise, other), (Promise::Dataset(id), Promise::Gone(gone)) if id == gone))
        };
        // Work that was under way may delete a dataset before it says so.
        let maybe_gone = |promise: &Promise| {
            let deleted = self.promises.0.iter().find_map(|(_, other)| match other {
                Promise::Gone(id) => Some(id),
                _ => None,
            });
            matches!(promise, Promise::Dataset(id) if Some(id) == deleted)
        };
        let program = Program::start(folder.path());
        let mut missing = Vec::new();
        for promise in kept.iter().filter(|promise| !gone(promise) && !maybe_gone(promise)) {
            missing.extend(broken(&program.base, folder.path(), promise).await);
        }
        program.kill();
        let mut doctor = Command::new(env!("CARGO_BIN_EXE_multistage"));
        let doctor = doctor.args(["doctor", "--bytes", "--data-dir"]).arg(folder.path()).output().unwrap();
        let said = String::from_utf8_lossy(&doctor.stdout);
        // Files that nobody was told of may be left.
        missing.extend(
            said.lines().filter(|line| *line != "all is well" && !line.starts_with("orphan")).map(str::to_owned),
        );
        (missing, kept.len())
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_was_acknowledged_survives_power_cuts() {
    let Some(recorded) = record().await else {
        println!("SKIPPED: there is no strace to record what the program does to files");
        return;
    };
    let cuts = std::env::var("MULTISTAGE_POWER_CUTS").ok().and_then(|cuts| cuts.parse().ok()).unwrap_or(CUTS);
    let answers: Vec<usize> = recorded.promises.0.iter().map(|(id, _)| recorded.sent[id]).collect();
    let mut random = Rng::from_parts(&[11]);
    let mut most = 0;
    for cut in 0..cuts {
        // Right after an answer, or anywhere; and what was not synced is lost, or half of it.
        let after =
            if cut % 2 == 0 { answers[random.below(answers.len())] } else { random.below(recorded.lines.len()) };
        let nothing = cut % 4 < 2;
        let (missing, promised) = recorded.cut(after, true, &mut || !nothing && random.below(2) == 0).await;
        assert!(missing.is_empty(), "cut {cut} after line {after} of {}: {missing:#?}", recorded.lines.len());
        most = most.max(promised);
    }
    // The test can fail: without the syncs of folders the last answer's promises do not hold.
    let (missing, promised) = recorded.cut(recorded.lines.len() - 1, false, &mut || false).await;
    assert!(!missing.is_empty() && promised == recorded.promises.0.len());
    println!(
        "{cuts} power cuts within {} calls, up to {most} of {promised} promises: all kept; without syncs of folders {} missing",
        recorded.lines.len(),
        missing.len()
    );
}
