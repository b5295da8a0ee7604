//! Thousands of photographs through tus, as fast as the disk lets them.

use std::io::Write;
use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::{Duration, Instant};

use reqwest::Client;
use serde_json::Value;
use tokio::sync::watch;

use crate::program::Program;
use crate::{content, dataset, expect, memory_bytes, number, upload};

/// Connections that bring them.
const CONNECTIONS: usize = 8;
/// Of each, unless `MULTISTAGE_LOAD_FILE_BYTES` says otherwise.
const FILE_BYTES: usize = 4 << 20;
/// Folders that they go to.
const FOLDERS: usize = 100;
/// Files that one thread writes, for comparison.
const ONE_BY_ONE: usize = 500;
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

/// Empties every file below a folder, which gives its bytes back. Deleted files would hold up whoever makes files next: ext4 hands out
/// none of their inodes for a while and searches for others.
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

/// The time that the disk takes for whole files of so many threads, each synced, renamed and its folder synced. Their names stay below
/// `folder`.
fn disk_time(folder: &Path, files: usize, size: usize, threads: usize) -> Duration {
    let bytes = content(0, size);
    let raw = tempfile::tempdir_in(folder).unwrap().keep();
    for folder in 0..FOLDERS {
        std::fs::create_dir(raw.join(folder.to_string())).unwrap();
    }
    let start = Instant::now();
    std::thread::scope(|scope| {
        for thread in 0..threads {
            let (bytes, raw) = (&bytes, &raw);
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
    let time = start.elapsed();
    empty_files(&raw);
    time
}

/// What the run of all senders took.
struct Run {
    /// From the first request to the last answer.
    time: Duration,
    service_cpu_s: f64,
    clients_cpu_s: f64,
    /// Of the service, before and at its highest.
    memory_bytes: (u64, u64),
}

/// Sends all photographs to a dataset.
async fn send(program: &Program, dataset: &str, files: usize, size: usize) -> Run {
    let (service, clients) = (program.id(), std::process::id());
    let (base, dataset): (Arc<str>, Arc<str>) = (program.base.as_str().into(), dataset.into());
    let (memory_before, cpu_before) = (memory_bytes(service), (cpu_s(service), cpu_s(clients)));
    let (over, mut sent) = watch::channel(());
    let watching = tokio::spawn(async move {
        let mut highest = memory_before;
        while tokio::time::timeout(Duration::from_millis(100), sent.changed()).await.is_err() {
            highest = highest.max(memory_bytes(service));
        }
        highest
    });
    let next = Arc::new(AtomicUsize::new(0));
    let start = Instant::now();
    let senders: Vec<_> = (0..CONNECTIONS)
        .map(|_| {
            let (base, dataset, next) = (Arc::clone(&base), Arc::clone(&dataset), Arc::clone(&next));
            tokio::spawn(async move {
                let (http, bytes) = (Client::new(), content(0, size));
                loop {
                    let number = next.fetch_add(1, Ordering::Relaxed);
                    if number >= files {
                        return;
                    }
                    let mut bytes = bytes.clone();
                    bytes[..8].copy_from_slice(&number.to_le_bytes());
                    upload(&http, &base, &dataset, &place(number), bytes).await;
                }
            })
        })
        .collect();
    for sender in senders {
        sender.await.unwrap();
    }
    let time = start.elapsed();
    let (service_cpu_s, clients_cpu_s) = (cpu_s(service) - cpu_before.0, cpu_s(clients) - cpu_before.1);
    over.send_replace(());
    Run { time, service_cpu_s, clients_cpu_s, memory_bytes: (memory_before, watching.await.unwrap()) }
}

#[tokio::test(flavor = "multi_thread")]
async fn many_photographs_through_tus() {
    let wanted = number("MULTISTAGE_LOAD_FILES");
    let files = wanted.unwrap_or(48);
    let size = number("MULTISTAGE_LOAD_FILE_BYTES").unwrap_or(FILE_BYTES);
    let folder = tempfile::tempdir().unwrap();
    // Half of the files before and half after, because the disk is not the same all the time.
    let mut disk = disk_time(folder.path(), files / 2, size, CONNECTIONS);
    let data = folder.path().join("data");
    let program = Program::start_with(&data, &[]);
    let id = dataset(&Client::new(), &program.base).await;
    let run = send(&program, &id, files, size).await;
    let link = format!("{}/api/v1/datasets/{id}", program.base);
    let shown: Value = expect(Client::new().get(link), 200).await.json().await.unwrap();
    assert_eq!(shown["images"], files);
    drop(program);
    empty_files(&data);
    disk += disk_time(folder.path(), files - files / 2, size, CONNECTIONS);
    let few = files.min(ONE_BY_ONE);
    let rate = |files: usize, time: Duration| (files * size) as f64 / time.as_secs_f64() / 1e6;
    let one_by_one = rate(few, disk_time(folder.path(), few, size, 1));
    let (rate, disk) = (rate(files, run.time), rate(files, disk));
    let share = rate / disk;
    let least = if wanted.is_some() { SHARE_OF_DISK } else { SHARE_OF_DISK_SHORT };
    let ms_a_file = |cpu_s: f64| cpu_s * 1000.0 / files as f64;
    let (before, highest) = run.memory_bytes;
    let said = format!(
        "{files} photographs of {} KiB over {CONNECTIONS} connections: {rate:.0} MB/s, {share:.2} of the disk's {disk:.0} MB/s with as \
         many threads ({one_by_one:.0} MB/s with one); CPU a photograph: {:.2} ms of the service, {:.2} ms of the clients; memory {} to \
         {} MiB",
        size >> 10,
        ms_a_file(run.service_cpu_s),
        ms_a_file(run.clients_cpu_s),
        before >> 20,
        highest >> 20
    );
    assert!(highest < MOST_MEMORY_BYTES, "{said}");
    assert!(share >= least, "{said}");
    println!("{said}");
}
