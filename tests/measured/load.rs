//! Many clients at once on the real program: uploads beside listeners on events, and thousands of photographs through tus.
//!
//! An ordinary run is short. Long ones, as for the README:
//! `MULTISTAGE_LOAD_S=60 MULTISTAGE_LOAD_FILES=500 cargo test --locked --test measured load -- --nocapture`. Of the
//! many photographs, 4 MiB each or `MULTISTAGE_LOAD_FILE_BYTES`, few are on the disk at a time. `MULTISTAGE_LOAD_ARCHIVE_BYTES` is the size of a
//! job's outputs, which are sparse files.

mod many;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use multistage::store::db::datasets;
use multistage::store::db::job_outputs::{self, JobOutputRow};
use multistage::store::db::jobs::{self, NewJobRow};
use multistage::store::{DataDir, Db};
use reqwest::{Body, Client, Response};
use serde_json::{Value, json};
use tokio::sync::watch;

use crate::program::Program;

/// Clients that upload, and clients that listen.
const SENDERS: usize = 50;
const LISTENERS: usize = 200;
/// Seconds within which 99 of 100 writes to the database must be done, in their queue too, without the disk's syncs.
const WRITE_LIMIT_S: f64 = 0.05;
/// Between the middle and the end of a run memory may grow by so much: what allocators keep.
const MEMORY_SLACK_BYTES: u64 = 48 << 20;

fn number(name: &str) -> Option<usize> {
    std::env::var(name).ok()?.parse().ok()
}

/// Bytes that begin differently, so that none is stored already.
fn content(number: usize, size: usize) -> Vec<u8> {
    let mut bytes: Vec<u8> = (0..size).map(|at| (at.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    bytes[..8].copy_from_slice(&number.to_le_bytes());
    bytes
}

fn metadata(dataset: &str, path: &str) -> String {
    format!("dataset {},path {}", BASE64_STANDARD.encode(dataset), BASE64_STANDARD.encode(path))
}

async fn expect(request: reqwest::RequestBuilder, status: u16) -> Response {
    let response = request.send().await.unwrap();
    let (url, found) = (response.url().clone(), response.status());
    if found.as_u16() != status {
        panic!("{url}: {found}: {}", response.text().await.unwrap_or_default());
    }
    response
}

async fn dataset(http: &Client, base: &str) -> String {
    let made = expect(http.post(format!("{base}/api/v1/datasets")).json(&json!({})), 201).await;
    made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned()
}

/// One photograph in one request of tus.
async fn upload(http: &Client, base: &str, dataset: &str, path: &str, bytes: Vec<u8>) {
    let size = bytes.len();
    upload_body(http, base, dataset, path, size, bytes.into()).await;
}

async fn upload_body(http: &Client, base: &str, dataset: &str, path: &str, size: usize, body: Body) {
    let request = http.post(format!("{base}/api/v1/uploads")).header("tus-resumable", "1.0.0");
    let request = request.header("upload-length", size).header("upload-metadata", metadata(dataset, path));
    let request = request.header("content-type", "application/offset+octet-stream").header("content-length", size);
    expect(request.body(body), 201).await;
}

/// The resident memory of a process.
fn memory_bytes(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
}

/// Of the service's figures: the end of the class, in seconds, that 99 of 100 writes lie within, their number, and the time of syncs.
fn writes(figures: &str) -> (f64, u64, f64) {
    let values = |name: &str| -> Vec<(String, f64)> {
        let lines = figures.lines().filter_map(|line| line.strip_prefix(name)?.rsplit_once(' '));
        lines.map(|(labels, value)| (labels.to_owned(), value.parse().unwrap())).collect()
    };
    let count = values("multistage_store_write_seconds_count")[0].1;
    let classes = values("multistage_store_write_seconds_bucket");
    let (labels, _) = classes.iter().find(|(_, up_to)| *up_to >= count * 0.99).unwrap();
    let end = labels.split('"').nth(1).unwrap();
    let syncs_s = values("multistage_store_sync_seconds_total")[0].1;
    (end.parse().unwrap_or(f64::INFINITY), count as u64, syncs_s)
}

#[derive(Default)]
struct Tally {
    uploads: AtomicUsize,
    events: AtomicUsize,
    streams: AtomicUsize,
    over: AtomicBool,
}

/// Uploads for itself, looks at what it has, and now and then deletes all of it.
async fn sender(number: usize, base: String, tally: Arc<Tally>) -> Vec<Duration> {
    let http = Client::new();
    let mut times = Vec::new();
    let mut round = 0;
    while !tally.over.load(Ordering::Relaxed) {
        let dataset = dataset(&http, &base).await;
        for file in 0..10 {
            let start = Instant::now();
            let unique = (number * 1_000_000) + round * 10 + file;
            upload(&http, &base, &dataset, &format!("{file}.jpg"), content(unique, 100_000)).await;
            times.push(start.elapsed());
            tally.uploads.fetch_add(1, Ordering::Relaxed);
        }
        let link = format!("{base}/api/v1/datasets/{dataset}");
        let shown: Value = expect(http.get(&link), 200).await.json().await.unwrap();
        assert_eq!(shown["images"], 10);
        expect(http.delete(&link), 204).await;
        round += 1;
    }
    times
}

/// Listens to one job after the other, to the end of each.
async fn listener(base: String, mut jobs: watch::Receiver<String>, tally: Arc<Tally>) {
    let http = Client::new();
    while !tally.over.load(Ordering::Relaxed) {
        let job = jobs.borrow_and_update().clone();
        let mut stream = http.get(format!("{base}{job}/events")).send().await.unwrap();
        assert!(stream.status().is_success(), "{}", stream.status());
        tally.streams.fetch_add(1, Ordering::Relaxed);
        let mut last = String::new();
        while let Some(chunk) = stream.chunk().await.unwrap() {
            last.push_str(&String::from_utf8_lossy(&chunk));
            tally.events.fetch_add(last.matches("\n\n").count(), Ordering::Relaxed);
            last.drain(..last.rfind("\n\n").map_or(0, |end| end + 2));
        }
        // Until there is another one.
        if jobs.changed().await.is_err() {
            return;
        }
    }
}

/// Queues jobs, one after the other, for the listeners.
async fn queue_jobs(base: String, told: watch::Sender<String>, tally: Arc<Tally>) -> usize {
    let http = Client::new();
    let dataset = dataset(&http, &base).await;
    for file in 0..3 {
        upload(&http, &base, &dataset, &format!("{file}.jpg"), content(file, 1000)).await;
    }
    let mut count = 0;
    while !tally.over.load(Ordering::Relaxed) {
        let made = http.post(format!("{base}/api/v1/jobs")).json(&json!({ "dataset_id": dataset }));
        let job: Value = expect(made, 202).await.json().await.unwrap();
        let link = job["links"]["self"].as_str().unwrap().to_owned();
        told.send_replace(link.clone());
        count += 1;
        loop {
            let now: Value = expect(http.get(format!("{base}{link}")), 200).await.json().await.unwrap();
            if !now["finished_at"].is_null() {
                break;
            }
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
        tokio::time::sleep(Duration::from_millis(200)).await;
    }
    count
}

#[tokio::test(flavor = "multi_thread")]
async fn senders_and_listeners_at_once() {
    let _alone = crate::alone().await;
    let time = Duration::from_secs(number("MULTISTAGE_LOAD_S").unwrap_or(6) as u64);
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let program = Program::start_logging(&folder.path().join("data"), &[], std::fs::File::create(&log).unwrap());
    let (tally, base) = (Arc::new(Tally::default()), program.base.clone());
    let (told, heard) = watch::channel(String::new());
    let jobs = tokio::spawn(queue_jobs(base.clone(), told, Arc::clone(&tally)));
    heard.clone().changed().await.unwrap();
    let senders: Vec<_> =
        (0..SENDERS).map(|number| tokio::spawn(sender(number, base.clone(), Arc::clone(&tally)))).collect();
    let listeners: Vec<_> =
        (0..LISTENERS).map(|_| tokio::spawn(listener(base.clone(), heard.clone(), Arc::clone(&tally)))).collect();
    let start = Instant::now();
    let mut memory = Vec::new();
    while start.elapsed() < time {
        tokio::time::sleep(Duration::from_millis(250)).await;
        memory.push(memory_bytes(program.id()));
    }
    let figures = expect(Client::new().get(format!("{base}/metrics")), 200).await.text().await.unwrap();
    let (writes_within_s, writes, syncs_s) = writes(&figures);
    tally.over.store(true, Ordering::Relaxed);
    let mut times = Vec::new();
    for sender in senders {
        times.extend(sender.await.expect("no client met an error"));
    }
    let jobs = jobs.await.expect("every job was taken");
    for listener in listeners {
        listener.await.expect("no listener met an error");
    }
    times.sort_unstable();
    let p99 = times[times.len() * 99 / 100];
    let said = std::fs::read_to_string(&log).unwrap();
    let busy = said.lines().filter(|line| line.contains("database is locked") || line.contains("SQLITE_BUSY")).count();
    assert_eq!(busy, 0, "{said}");
    assert!(!said.contains("ERROR"), "{said}");
    let highest = |part: &[u64]| part.iter().copied().max().unwrap();
    let (middle, end) =
        (highest(&memory[memory.len() / 3..memory.len() * 2 / 3]), highest(&memory[memory.len() * 2 / 3..]));
    assert!(end < middle + MEMORY_SLACK_BYTES, "memory grew from {middle} to {end} bytes");
    // Many more clients than cores keep the machine busy whatever is asked of it, so a short run allows for it.
    let limit_s = if time >= Duration::from_secs(60) { WRITE_LIMIT_S } else { 10.0 * WRITE_LIMIT_S };
    assert!(writes_within_s <= limit_s, "99 of 100 of {writes} writes within {writes_within_s} s");
    println!(
        "{SENDERS} senders, {LISTENERS} listeners, {} s: {writes} writes, 99 of 100 within {writes_within_s} s without syncs, which took \
         {syncs_s} s; {} uploads, 99 of 100 within {p99:?}; {jobs} jobs, {} streams, {} \
         events; memory {} MiB in the middle third, {} MiB in the last; 0 errors, 0 SQLITE_BUSY",
        time.as_secs(),
        tally.uploads.load(Ordering::Relaxed),
        tally.streams.load(Ordering::Relaxed),
        tally.events.load(Ordering::Relaxed),
        middle >> 20,
        end >> 20,
    );
}

/// Of the outputs of a job, in an ordinary run.
const ARCHIVE_BYTES: u64 = 512 << 20;
/// That a download may add.
const ARCHIVE_MEMORY_BYTES: u64 = 100 << 20;
const WINDOW_BYTES: usize = 64 << 10;

/// CRC-32 of so many zeros.
fn crc32_of_zeros(mut count: u64) -> u32 {
    let (mut sum, mut block) = (crc32fast::Hasher::new(), crc32fast::Hasher::new());
    block.update(&[0]);
    while count > 0 {
        if count & 1 == 1 {
            sum.combine(&block);
        }
        let half = block.clone();
        block.combine(&half);
        count >>= 1;
    }
    sum.finalize()
}

/// A data directory with a finished job whose outputs are sparse files; its link.
async fn large_job(data_dir: &Path, bytes: u64) -> String {
    let (job, dataset) = (uuid::Uuid::now_v7(), uuid::Uuid::now_v7());
    drop(Program::start(data_dir));
    let db = Db::open(&DataDir::database_in(data_dir)).await.unwrap();
    let mut tx = db.write().await.unwrap();
    datasets::insert(&mut tx, dataset, "", 1, None, None).await.unwrap();
    let row = NewJobRow {
        id: job,
        name: "large".to_owned(),
        created_ms: 1,
        dataset,
        options: "{}".to_owned(),
        ignored: None,
        priority: 0,
        owner_token: None,
    };
    jobs::insert(&mut tx, &row).await.unwrap();
    let mut row = jobs::find(&mut *tx, job).await.unwrap().unwrap();
    row.state = "succeeded".to_owned();
    (row.started_ms, row.finished_ms) = (Some(2), Some(3));
    jobs::update_state(&mut tx, &row).await.unwrap();
    let mut outputs = Vec::new();
    for (path, size) in [("ply/0/points.ply", bytes / 2), ("report.json", 1000), ("sparse/0/points3D.bin", bytes / 2)] {
        let file = data_dir.join("jobs").join(job.to_string()).join("out").join(path);
        std::fs::create_dir_all(file.parent().unwrap()).unwrap();
        std::fs::File::create(file).unwrap().set_len(size).unwrap();
        let crc32 = Some(crc32_of_zeros(size));
        outputs.push(JobOutputRow { path: path.to_owned(), size_bytes: size as i64, blake3: "00".repeat(16), crc32 });
    }
    job_outputs::replace(&mut tx, job, &outputs).await.unwrap();
    tx.commit().await.unwrap();
    db.close().await;
    format!("/api/v1/jobs/{job}/outputs.zip")
}

/// All outputs of a job as one archive: streamed in fixed memory, and any part of it is the part of the whole.
#[tokio::test(flavor = "multi_thread")]
async fn a_large_archive_streams_in_little_memory_and_in_parts() {
    let _alone = crate::alone().await;
    let bytes = number("MULTISTAGE_LOAD_ARCHIVE_BYTES").map_or(ARCHIVE_BYTES, |bytes| bytes as u64);
    let folder = tempfile::tempdir().unwrap();
    let link = large_job(folder.path(), bytes).await;
    let program = Program::start(folder.path());
    let (http, url) = (Client::new(), format!("{}{link}", program.base));
    let mut whole = expect(http.get(&url), 200).await;
    assert_eq!(whole.headers()["accept-ranges"], "bytes");
    let size = whole.content_length().unwrap();
    // Windows at both ends, about where the middle files meet, and elsewhere.
    let window = WINDOW_BYTES as u64;
    let starts = [0, size / 3, bytes / 2 - window / 2, bytes / 2 + window / 4, size - window];
    let mut windows = vec![Vec::new(); starts.len()];
    let (mut at, mut highest) = (0u64, 0);
    let (before, start) = (memory_bytes(program.id()), Instant::now());
    let mut looked = Instant::now();
    while let Some(chunk) = whole.chunk().await.unwrap() {
        for (start, found) in starts.iter().zip(&mut windows) {
            let (from, to) = ((*start).max(at), (start + window).min(at + chunk.len() as u64));
            if from < to {
                found.extend_from_slice(&chunk[(from - at) as usize..(to - at) as usize]);
            }
        }
        at += chunk.len() as u64;
        if looked.elapsed() > Duration::from_millis(50) {
            highest = highest.max(memory_bytes(program.id()));
            looked = Instant::now();
        }
    }
    let time_s = start.elapsed().as_secs_f64();
    assert_eq!(at, size);
    for (start, expected) in starts.iter().zip(&windows) {
        let part = http.get(&url).header("range", format!("bytes={start}-{}", start + window - 1));
        let part = expect(part, 206).await;
        assert_eq!(part.headers()["content-range"], format!("bytes {start}-{}/{size}", start + window - 1));
        assert!(part.bytes().await.unwrap() == *expected, "the part at {start}");
    }
    assert!(windows[0].starts_with(b"PK\x03\x04") && windows[4].windows(4).any(|word| word == b"PK\x05\x06"));
    assert!(windows[2].windows(4).any(|word| word == b"PK\x03\x04"), "the second file begins there");
    assert!(highest < ARCHIVE_MEMORY_BYTES, "{highest} bytes of memory");
    println!(
        "an archive of {:.2} GB in {time_s:.1} s; memory {} to {} MiB",
        size as f64 / 1e9,
        before >> 20,
        highest >> 20
    );
}
