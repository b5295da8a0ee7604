//! Every write, one after the other, fails once as on a full disk and once as on a broken one.

use std::fs::File;
use std::io::{BufRead, BufReader};
use std::os::unix::fs::FileExt;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::service::{file, jpeg};

/// Writes that are made to fail in an ordinary run: every so many up to the last of a round, as a rule.
const STEP: i64 = 17;
const LAST: i64 = 290;
const ENOSPC: i64 = 28;
const EIO: i64 = 5;
/// Calls that fail in a row.
const CALLS: i64 = 3;

/// The numbers that the preloaded library shares with this test.
struct Control(File);

impl Control {
    fn read(&self, at: u64) -> i64 {
        let mut bytes = [0; 8];
        self.0.read_exact_at(&mut bytes, 8 * at).unwrap();
        i64::from_ne_bytes(bytes)
    }

    fn write(&self, at: u64, value: i64) {
        self.0.write_all_at(&value.to_ne_bytes(), 8 * at).unwrap();
    }

    /// From now on the calls from the `n`th on fail, [`CALLS`] of them.
    fn fail_at(&self, n: i64, error: i64) {
        self.write(2, 0);
        let first = self.read(0) + n;
        self.write(3, error);
        self.write(1, first);
        self.write(2, first + CALLS);
    }

    fn heal(&self) {
        self.write(2, 0);
    }
}

struct Faulty {
    child: Child,
    base: String,
    control: Control,
    data: PathBuf,
    _folder: tempfile::TempDir,
}

impl Faulty {
    /// None where the library can't be built.
    fn start() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let (library, data) = (folder.path().join("faults.so"), folder.path().join("data"));
        std::fs::create_dir(&data).unwrap();
        let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/program/disk/faults.c");
        let built =
            Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library).arg(source).arg("-ldl").status();
        if !built.is_ok_and(|status| status.success()) {
            return None;
        }
        let control = folder.path().join("control");
        std::fs::write(&control, [0; 40]).unwrap();
        let mut child = Command::new(env!("CARGO_BIN_EXE_multistage"))
            .args(["serve", "--bind", "127.0.0.1:0", "--threads", "2", "--data-dir"])
            .arg(&data)
            .env("RUST_LOG", "off")
            .env("LD_PRELOAD", &library)
            .env("FAULT_CONTROL", &control)
            .env("FAULT_FOLDER", &data)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let base = line.trim().strip_prefix("listening on ").unwrap_or_else(|| panic!("{line:?}"));
        let control = Control(File::options().read(true).write(true).open(control).unwrap());
        Some(Self { base: base.trim_end_matches('/').to_owned(), child, control, data, _folder: folder })
    }

    async fn send(&self, request: reqwest::RequestBuilder) -> (u16, Value) {
        let response = request.send().await.unwrap();
        let status = response.status().as_u16();
        let body = response.bytes().await.unwrap();
        let body = serde_json::from_slice(&body).unwrap_or(Value::Null);
        if status >= 400 {
            let code = body["code"].as_str().unwrap_or("");
            assert!(status == 507 && ["disk_full", "disk_error"].contains(&code), "{status} {body}");
        }
        (status, body)
    }

    /// Sends a request until it is taken: whoever is told that the disk is full tries again later.
    async fn insist(&self, what: impl Fn() -> reqwest::RequestBuilder) -> Value {
        for _ in 0..2 * CALLS + 2 {
            let (status, body) = self.send(what()).await;
            if status < 400 {
                return body;
            }
        }
        panic!("refused although the disk is well again")
    }

    fn url(&self, path: &str) -> String {
        format!("{}{path}", self.base)
    }
}

impl Drop for Faulty {
    fn drop(&mut self) {
        // Fails only when it is gone.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn whichever_write_fails_nothing_acknowledged_is_lost_and_work_goes_on() {
    let Some(mut faulty) = Faulty::start() else {
        println!("SKIPPED: there is no C compiler to build the faults with");
        return;
    };
    let every = std::env::var("MULTISTAGE_FAULTS").ok().and_then(|n| n.parse().ok());
    let (last, step) = every.map_or((LAST, STEP as usize), |n: i64| (n, 1));
    let client = reqwest::Client::new();
    let photographs = [("a.jpg", jpeg(300, 200)), ("b.jpg", jpeg(320, 200))];
    let (mut failed, mut beyond, mut jobs_failed, mut writes) = (0, 0, 0, 0);
    for at in (1..=last).step_by(step) {
        for error in [ENOSPC, EIO] {
            faulty.control.write(4, 0);
            let before = faulty.control.read(0);
            faulty.control.fail_at(at, error);
            let dataset = faulty.insist(|| client.post(faulty.url("/api/v1/datasets")).json(&json!({}))).await;
            for (name, bytes) in &photographs {
                let form = || reqwest::multipart::Form::new().part("images", file(name, bytes));
                let link = faulty.url(dataset["links"]["images"].as_str().unwrap());
                faulty.insist(|| client.post(&link).multipart(form())).await;
            }
            let job = faulty
                .insist(|| client.post(faulty.url("/api/v1/jobs")).json(&json!({"dataset_id": dataset["id"]})))
                .await;
            let link = job["links"]["self"].as_str().unwrap();
            let start = Instant::now();
            let over = loop {
                let now = faulty.insist(|| client.get(faulty.url(link))).await;
                if now["finished_at"].is_string() {
                    break now;
                }
                assert!(start.elapsed() < Duration::from_secs(60), "stuck after call {at} failed: {now:#}");
                tokio::time::sleep(Duration::from_millis(10)).await;
            };
            // The end of its own accord, or the reason.
            let code = over["error"]["code"].as_str().unwrap_or("");
            assert!(["no_model", "disk_full", "disk_error"].contains(&code), "{over:#}");
            jobs_failed += usize::from(code != "no_model");
            // What was acknowledged is there, whole.
            let images = faulty.insist(|| client.get(faulty.url(dataset["links"]["images"].as_str().unwrap()))).await;
            assert_eq!(images["images"].as_array().unwrap().len(), photographs.len(), "{images}");
            let stored = faulty.data.join(format!("datasets/{}/images", dataset["id"].as_str().unwrap()));
            for (name, bytes) in &photographs {
                assert!(std::fs::read(stored.join(name)).unwrap() == *bytes, "{name} after call {at} failed");
            }
            // Deleting works while writes fail, sooner or later.
            for path in [link, dataset["links"]["self"].as_str().unwrap()] {
                faulty.insist(|| client.delete(faulty.url(path))).await;
            }
            failed += usize::from(faulty.control.read(4) > 0);
            beyond += usize::from(faulty.control.read(4) == 0);
            writes = writes.max(faulty.control.read(0) - before);
            faulty.control.heal();
            assert!(faulty.child.try_wait().unwrap().is_none(), "the process ended after call {at} failed");
        }
    }
    println!("of {writes} writes, {failed} failed ({jobs_failed} of them within a job, {beyond} rounds had fewer)");
    assert!(failed > 10);
    // Nothing is left of all that was deleted, and the database is whole.
    let left = faulty.insist(|| client.get(faulty.url("/api/v1/datasets"))).await;
    assert_eq!(left["datasets"], json!([]));
    let pool =
        sqlx::SqlitePool::connect(&format!("sqlite://{}", faulty.data.join("multistage.db").display())).await.unwrap();
    let verdict: String = sqlx::query_scalar("PRAGMA integrity_check").fetch_one(&pool).await.unwrap();
    assert_eq!(verdict, "ok");
}
