//! Many clients at once on the real program: uploads beside listeners on events, and thousands of photographs through tus.
//!
//! An ordinary run is short. Long ones, as for the README:
//! `MULTISTAGE_LOAD_S=60 MULTISTAGE_LOAD_FILES=500 cargo test --locked --test load -- --nocapture --test-threads=1`; 10,000 photographs of 4 MiB
//! need 40 GiB, `MULTISTAGE_LOAD_FILE_BYTES` makes them smaller.

#![allow(clippy::unwrap_used)]

mod program;

use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use program::Program;
use reqwest::{Client, Method, Response};
use serde_json::{Value, json};
use tokio::sync::watch;

/// Clients that upload, and clients that listen.
const SENDERS: usize = 50;
const LISTENERS: usize = 200;
/// Connections that bring the many photographs.
const CONNECTIONS: usize = 8;
/// Of each of the many photographs, unless `MULTISTAGE_LOAD_FILE_BYTES` says otherwise.
const FILE_BYTES: usize = 4 << 20;
/// Folders that they go to.
const FOLDERS: usize = 100;
/// Files that one thread writes, for comparison.
const ONE_BY_ONE: usize = 500;
/// Share of what the disk gives that uploads must reach. A short run tells little, so it only has to be in reach.
const SHARE_OF_DISK: f64 = 0.7;
const SHARE_OF_DISK_SHORT: f64 = 0.2;
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
    let request = http.post(format!("{base}/api/v1/uploads")).header("tus-resumable", "1.0.0");
    let request = request.header("upload-length", bytes.len()).header("upload-metadata", metadata(dataset, path));
    expect(request.header("content-type", "application/offset+octet-stream").body(bytes), 201).await;
}

/// The resident memory of a process.
fn memory_bytes(process: u32) -> u64 {
    let status = std::fs::read_to_string(format!("/proc/{process}/status")).unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() * 1024
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
async fn jobs(base: String, told: watch::Sender<String>, tally: Arc<Tally>) -> usize {
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
    let time = Duration::from_secs(number("MULTISTAGE_LOAD_S").unwrap_or(6) as u64);
    let folder = tempfile::tempdir().unwrap();
    let log = folder.path().join("log");
    let program = Program::start_logging(&folder.path().join("data"), &[], std::fs::File::create(&log).unwrap());
    let (tally, base) = (Arc::new(Tally::default()), program.base.clone());
    let (told, heard) = watch::channel(String::new());
    let jobs = tokio::spawn(jobs(base.clone(), told, Arc::clone(&tally)));
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
    println!(
        "{SENDERS} senders, {LISTENERS} listeners, {} s: {} uploads, 99 of 100 within {p99:?}; {jobs} jobs, {} streams, {} \
         events; memory {} MiB in the middle third, {} MiB in the last; 0 errors, 0 SQLITE_BUSY",
        time.as_secs(),
        tally.uploads.load(Ordering::Relaxed),
        tally.streams.load(Ordering::Relaxed),
        tally.events.load(Ordering::Relaxed),
        middle >> 20,
        end >> 20,
    );
}

/// Where the `number`th of the many photographs goes.
fn place(number: usize) -> String {
    format!("{}/{number}.jpg", number % FOLDERS)
}

/// The time that the disk takes for whole files of so many threads, each synced, renamed and its folder synced.
fn disk_time(folder: &Path, files: usize, size: usize, threads: usize) -> Duration {
    let bytes = content(0, size);
    let raw = tempfile::tempdir_in(folder).unwrap();
    for folder in 0..FOLDERS {
        std::fs::create_dir(raw.path().join(folder.to_string())).unwrap();
    }
    let start = Instant::now();
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let (bytes, raw) = (&bytes, raw.path());
            scope.spawn(move || {
                for file in (thread..files).step_by(threads) {
                    let (part, path) = (raw.join(format!("{file}.part")), raw.join(place(file)));
                    let mut written = std::fs::File::create(&part).unwrap();
                    written.write_all(bytes).unwrap();
                    written.sync_all().unwrap();
                    std::fs::rename(&part, &path).unwrap();
                    std::fs::File::open(path.parent().unwrap()).unwrap().sync_all().unwrap();
                }
            });
        }
    });
    start.elapsed()
}

#[tokio::test(flavor = "multi_thread")]
async fn many_photographs_through_tus() {
    let wanted = number("MULTISTAGE_LOAD_FILES");
    let files = wanted.unwrap_or(48);
    let size = number("MULTISTAGE_LOAD_FILE_BYTES").unwrap_or(FILE_BYTES);
    let folder = tempfile::tempdir().unwrap();
    // Half of the files before and half after, because the disk is not the same all the time.
    let mut disk = disk_time(folder.path(), files / 2, size, CONNECTIONS);
    let program = Program::start_with(&folder.path().join("data"), &[]);
    let base = program.base.clone();
    let id = dataset(&Client::new(), &base).await;
    let before = memory_bytes(program.id());
    let start = Instant::now();
    let next = Arc::new(AtomicUsize::new(0));
    let senders: Vec<_> = (0..CONNECTIONS)
        .map(|_| {
            let (base, id, next) = (base.clone(), id.clone(), Arc::clone(&next));
            tokio::spawn(async move {
                let (http, bytes) = (Client::new(), content(0, size));
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= files {
                        return;
                    }
                    let mut bytes = bytes.clone();
                    bytes[..8].copy_from_slice(&number.to_le_bytes());
                    upload(&http, &base, &id, &place(number), bytes).await;
                }
            })
        })
        .collect();
    let mut highest = before;
    while next.load(Ordering::Relaxed) < files {
        tokio::time::sleep(Duration::from_millis(100)).await;
        highest = highest.max(memory_bytes(program.id()));
    }
    for sender in senders {
        sender.await.unwrap();
    }
    let rate = (files * size) as f64 / start.elapsed().as_secs_f64();
    let link = format!("{base}/api/v1/datasets/{id}");
    let shown: Value = expect(Client::new().request(Method::GET, link), 200).await.json().await.unwrap();
    assert_eq!(shown["images"], files);
    assert!(highest < 200 << 20, "{highest} bytes of memory");
    drop(program);
    std::fs::remove_dir_all(folder.path().join("data")).unwrap();
    disk += disk_time(folder.path(), files - files / 2, size, CONNECTIONS);
    let one_by_one =
        (files.min(ONE_BY_ONE) * size) as f64 / disk_time(folder.path(), files.min(ONE_BY_ONE), size, 1).as_secs_f64();
    let disk = (files * size) as f64 / disk.as_secs_f64();
    let share = rate / disk;
    let least = if wanted.is_some() { SHARE_OF_DISK } else { SHARE_OF_DISK_SHORT };
    let mb = |rate: f64| rate / 1e6;
    let memory = highest >> 20;
    let said = format!(
        "{files} photographs of {} KiB over {CONNECTIONS} connections: {:.0} MB/s, {share:.2} of the disk's {:.0} MB/s \
         with as many threads ({:.0} MB/s with one); memory {} to {memory} MiB",
        size >> 10,
        mb(rate),
        mb(disk),
        mb(one_by_one),
        before >> 20
    );
    assert!(share >= least, "{said}");
    println!("{said}");
}
