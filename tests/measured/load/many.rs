//! Thousands of photographs through tus, beside as many files that threads write without a service.

use std::convert::Infallible;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::atomic::{AtomicU64, AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use bytes::Bytes;
use reqwest::{Body, Client};
use serde_json::{Value, json};
use tokio::task::JoinHandle;

use super::{content, dataset, expect, memory_bytes, number, upload_body};
use crate::program::Program;

/// Connections that bring them.
const CONNECTIONS: usize = 8;
/// Of each, unless `MULTISTAGE_LOAD_FILE_BYTES` says otherwise.
const FILE_BYTES: usize = 4 << 20;
/// Folders that they go to.
const FOLDERS: usize = 100;
/// Disk and service take turns, so many bytes each: disks are not the same all the time, nor is memory. A virtual
/// machine gives back to its host what was free for a few seconds, and whoever gets it again pays for that more than
/// for the writing. So what was written is emptied after every round, and both find the same.
const ROUND_BYTES: usize = 512 << 20;
/// Share of what the disk gives that uploads must reach. A short run tells little, so it only has to be in reach.
const SHARE_OF_DISK: f64 = 0.7;
const SHARE_OF_DISK_SHORT: f64 = 0.2;
/// Memory that the service may take.
const MOST_MEMORY_BYTES: u64 = 200 << 20;
/// The system counts the time of processes in hundredths of a second.
const TICKS_PER_S: f64 = 100.0;

/// Where the `number`th of the many photographs goes.
fn place(number: usize) -> String {
    format!("{}/{number}.jpg", number % FOLDERS)
}

/// Seconds of processors that a process has taken.
fn cpu_s(process: u32) -> f64 {
    let stat = std::fs::read_to_string(format!("/proc/{process}/stat")).unwrap();
    // The second field, a name in brackets, may hold anything; the fourteenth and fifteenth are the times.
    let fields: Vec<&str> = stat.rsplit_once(')').unwrap().1.split_whitespace().collect();
    let ticks = |field: usize| fields[field - 3].parse::<f64>().unwrap();
    (ticks(14) + ticks(15)) / TICKS_PER_S
}

/// Empties every file below a folder, which gives its bytes back. Deleted files would hold up whoever makes files next:
/// ext4 hands out none of their inodes for a while and searches for others.
fn empty_files(folder: &Path) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let entry = entry.unwrap();
        if entry.file_type().unwrap().is_dir() {
            empty_files(&entry.path());
        } else {
            std::fs::File::create(entry.path()).unwrap();
        }
    }
}

/// What threads get done that write whole files: each synced, renamed and its folder synced.
struct Disk {
    folder: PathBuf,
    bytes: Vec<u8>,
    threads: usize,
    files: usize,
    time: Duration,
}

impl Disk {
    fn new(folder: PathBuf, size: usize, threads: usize) -> Self {
        for number in 0..FOLDERS {
            std::fs::create_dir_all(folder.join(number.to_string())).unwrap();
        }
        Self { folder, bytes: content(0, size), threads, files: 0, time: Duration::ZERO }
    }

    /// So many files more, which are emptied again.
    fn write(&mut self, files: usize) {
        let Self { folder, bytes, threads, files: before, .. } = &*self;
        let start = Instant::now();
        std::thread::scope(|scope| {
            for thread in 0..*threads {
                scope.spawn(move || {
                    for file in (before + thread..before + files).step_by(*threads) {
                        let (part, path) = (folder.join(format!("{file}.part")), folder.join(place(file)));
                        let mut written = std::fs::File::create(&part).unwrap();
                        written.write_all(bytes).unwrap();
                        written.sync_all().unwrap();
                        std::fs::rename(&part, &path).unwrap();
                        std::fs::File::open(path.parent().unwrap()).unwrap().sync_all().unwrap();
                    }
                });
            }
        });
        self.time += start.elapsed();
        self.files += files;
        empty_files(&self.folder);
    }

    fn rate(&self) -> f64 {
        rate(self.files, self.bytes.len(), self.time)
    }
}

/// In MB/s.
fn rate(files: usize, size: usize, time: Duration) -> f64 {
    (files * size) as f64 / time.as_secs_f64() / 1e6
}

/// Clients that send photographs to a dataset, each over a connection of its own.
struct Clients {
    base: String,
    dataset: String,
    /// Of every photograph, behind its number.
    rest: Bytes,
    http: Vec<Client>,
    next: AtomicUsize,
}

impl Clients {
    /// Sends photographs up to this number, and returns with the last answer.
    async fn send(self: &Arc<Self>, end: usize) {
        let senders = (0..self.http.len()).map(|connection| {
            let clients = Arc::clone(self);
            tokio::spawn(async move {
                let Clients { base, dataset, rest, http, next } = &*clients;
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= end {
                        return;
                    }
                    // None begins as another does; the rest is shared, so that clients take little of the processors.
                    let head = Bytes::copy_from_slice(&number.to_le_bytes());
                    let body = futures_util::stream::iter([head, rest.clone()].map(Ok::<_, Infallible>));
                    let size = rest.len() + size_of_val(&number);
                    upload_body(&http[connection], base, dataset, &place(number), size, Body::wrap_stream(body)).await;
                }
            })
        });
        for sender in senders.collect::<Vec<_>>() {
            sender.await.unwrap();
        }
        self.next.store(end, Ordering::Relaxed);
    }
}

/// The most memory that a process has while this is not dropped.
struct MemoryWatch {
    highest: Arc<AtomicU64>,
    watching: JoinHandle<()>,
}

impl MemoryWatch {
    fn start(process: u32) -> Self {
        let highest = Arc::new(AtomicU64::new(0));
        let noted = Arc::clone(&highest);
        let watching = tokio::spawn(async move {
            loop {
                noted.fetch_max(memory_bytes(process), Ordering::Relaxed);
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
        });
        Self { highest, watching }
    }

    fn end(self) -> u64 {
        self.watching.abort();
        self.highest.load(Ordering::Relaxed)
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn many_photographs_through_tus() {
    let _alone = crate::alone().await;
    let wanted = number("MULTISTAGE_LOAD_FILES");
    let files = wanted.unwrap_or(48);
    let size = number("MULTISTAGE_LOAD_FILE_BYTES").unwrap_or(FILE_BYTES);
    let folder = tempfile::tempdir().unwrap();
    let data = folder.path().join("data");
    let program = Program::start_with(&data, &[]);
    let (service, own) = (program.id(), std::process::id());
    let id = dataset(&Client::new(), &program.base).await;
    let images = data.join("datasets").join(&id).join("images");
    let clients = Arc::new(Clients {
        base: program.base.clone(),
        dataset: id.clone(),
        rest: content(0, size).split_off(size_of::<usize>()).into(),
        http: (0..CONNECTIONS).map(|_| Client::new()).collect(),
        next: AtomicUsize::new(0),
    });
    let mut disk = Disk::new(folder.path().join("raw"), size, CONNECTIONS);
    let (before, memory) = (memory_bytes(service), MemoryWatch::start(service));
    let (mut time, mut service_cpu_s, mut clients_cpu_s) = (Duration::ZERO, 0.0, 0.0);
    let a_round = (ROUND_BYTES / size).max(CONNECTIONS);
    let mut sent = 0;
    while sent < files {
        let end = files.min(sent + a_round);
        disk.write(end - sent);
        let (service_before_s, own_before_s) = (cpu_s(service), cpu_s(own));
        let start = Instant::now();
        clients.send(end).await;
        time += start.elapsed();
        service_cpu_s += cpu_s(service) - service_before_s;
        clients_cpu_s += cpu_s(own) - own_before_s;
        // Nobody reads them any more.
        empty_files(&images);
        sent = end;
    }
    let highest = memory.end();
    let shown: Value =
        expect(Client::new().get(format!("{}/api/v1/datasets/{id}", program.base)), 200).await.json().await.unwrap();
    assert_eq!((&shown["images"], &shown["size_bytes"]), (&json!(files), &json!(files * size)));
    drop(program);
    let mut one_by_one = Disk::new(folder.path().join("one"), size, 1);
    one_by_one.write(files.min(a_round));
    let (rate, disk) = (rate(files, size, time), disk.rate());
    let share = rate / disk;
    let least = if wanted.is_some() { SHARE_OF_DISK } else { SHARE_OF_DISK_SHORT };
    let ms_a_file = |cpu_s: f64| cpu_s * 1000.0 / files as f64;
    let said = format!(
        "{files} photographs of {} KiB over {CONNECTIONS} connections: {rate:.0} MB/s, {share:.2} of the disk's {disk:.0} MB/s with as \
         many threads ({:.0} MB/s with one); CPU a photograph: {:.2} ms of the service, {:.2} ms of the clients; memory {} to {} MiB",
        size >> 10,
        one_by_one.rate(),
        ms_a_file(service_cpu_s),
        ms_a_file(clients_cpu_s),
        before >> 20,
        highest >> 20
    );
    assert!(highest < MOST_MEMORY_BYTES, "{said}");
    assert!(share >= least, "{said}");
    println!("{said}");
}
