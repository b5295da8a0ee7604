//! The real program on a disk of 96 MiB, which nobody else sees.

use std::io::{BufRead, BufReader};
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Child, Command, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::service::{file, jpeg};

const DISK: &str = "96m";

struct SmallDisk {
    child: Child,
    base: String,
    /// The disk as this process reaches it.
    root: PathBuf,
    _folder: tempfile::TempDir,
}

impl SmallDisk {
    /// None where such a disk can't be had.
    fn start() -> Option<Self> {
        let folder = tempfile::tempdir().unwrap();
        let at = folder.path().display();
        let program = env!("CARGO_BIN_EXE_multistage");
        let script = format!(
            "mount -t tmpfs -o size={DISK} tmpfs {at} && exec {program} serve --bind 127.0.0.1:0 --threads 2 --data-dir {at}/data"
        );
        let mut command = Command::new("unshare");
        command.args(["-Urm", "sh", "-c", &script]).env("RUST_LOG", "off").stdout(Stdio::piped()).process_group(0);
        let mut child = command.spawn().ok()?;
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let Some(base) = line.trim().strip_prefix("listening on ") else {
            child.wait().unwrap();
            return None;
        };
        let root = PathBuf::from(format!("/proc/{}/root{at}", child.id()));
        Some(Self { base: base.trim_end_matches('/').to_owned(), root, child, _folder: folder })
    }

    async fn send(&self, request: reqwest::RequestBuilder) -> (u16, Value) {
        let response = request.send().await.unwrap();
        let status = response.status().as_u16();
        let body = response.bytes().await.unwrap();
        (status, serde_json::from_slice(&body).unwrap_or(Value::Null))
    }

    async fn get(&self, path: &str) -> (u16, Value) {
        self.send(reqwest::Client::new().get(format!("{}{path}", self.base))).await
    }

    async fn upload(&self, link: &str, name: &str, bytes: &[u8]) -> (u16, Value) {
        let form = reqwest::multipart::Form::new().part("images", file(name, bytes));
        self.send(reqwest::Client::new().post(format!("{}{link}", self.base)).multipart(form)).await
    }

    async fn dataset(&self) -> (u16, Value) {
        self.send(reqwest::Client::new().post(format!("{}/api/v1/datasets", self.base)).json(&json!({}))).await
    }

    async fn delete(&self, link: &str) -> u16 {
        self.send(reqwest::Client::new().delete(format!("{}{link}", self.base))).await.0
    }
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        // Fails only when it is gone.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_full_disk_refuses_lets_delete_and_goes_on() {
    let Some(disk) = SmallDisk::start() else {
        println!("SKIPPED: no disk of a chosen size can be mounted here");
        return;
    };
    // An upload that is cut off where the disk ends keeps what it acknowledged, and nothing half.
    let (_, dataset) = disk.dataset().await;
    let link = dataset["links"]["images"].as_str().unwrap().to_owned();
    let mut stored = 0;
    let refused = loop {
        let bytes = [jpeg(64, 48), vec![stored as u8; 4 << 20]].concat();
        let (status, answer) = disk.upload(&link, &format!("{stored}.jpg"), &bytes).await;
        if status != 200 {
            break (status, answer);
        }
        stored += 1;
        assert!(stored < 100);
    };
    assert_eq!((refused.0, &refused.1["code"]), (507, &json!("disk_full")), "{}", refused.1);
    assert!(stored >= 5, "{stored}");
    let (_, now) = disk.get(dataset["links"]["self"].as_str().unwrap()).await;
    assert_eq!(now["images"], stored);

    // Another program takes the rest.
    let free = || {
        let space = rustix::fs::statvfs(&disk.root).unwrap();
        space.f_bavail * space.f_frsize
    };
    let filler = disk.root.join("filler");
    let mut file = std::fs::File::create(&filler).unwrap();
    while std::io::Write::write(&mut file, &[7; 4096]).is_ok() {}
    drop(file);
    assert_eq!(free(), 0);
    let (status, problem) = disk.get("/readyz").await;
    assert_eq!((status, &problem["code"]), (503, &json!("not_ready")), "{problem}");
    assert!(problem["detail"].as_str().unwrap().contains("disk is full"), "{problem}");
    let (status, problem) = disk.dataset().await;
    assert!(status == 201 || (status, &problem["code"]) == (507, &json!("disk_full")), "{status} {problem}");
    assert_eq!(disk.get("/healthz").await.0, 200);

    // Deleting works nevertheless, and makes room.
    assert_eq!(disk.delete(dataset["links"]["self"].as_str().unwrap()).await, 204);
    assert!(free() > 4 << 20, "{} bytes free after deleting", free());
    std::fs::remove_file(&filler).unwrap();
    let start = Instant::now();
    while disk.get("/readyz").await.0 != 200 {
        assert!(start.elapsed() < Duration::from_secs(10), "not ready although there is room");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }

    // A job that would not fit waits for room, says so, and goes on when there is.
    let (status, dataset) = disk.dataset().await;
    assert_eq!(status, 201, "{dataset}");
    let link = dataset["links"]["images"].as_str().unwrap().to_owned();
    for name in 0..3 {
        let photograph = jpeg(2400 + name, 1600);
        assert_eq!(disk.upload(&link, &format!("{name}.jpg"), &photograph).await.0, 200);
    }
    let room = free();
    std::fs::write(&filler, vec![0; usize::try_from(room).unwrap() - (48 << 20)]).unwrap();
    let body = json!({"dataset_id": dataset["id"]});
    let (status, job) = disk.send(reqwest::Client::new().post(format!("{}/api/v1/jobs", disk.base)).json(&body)).await;
    assert_eq!(status, 202, "{job}");
    let link = job["links"]["self"].as_str().unwrap().to_owned();
    let wait = async |what: &dyn Fn(&Value) -> bool| {
        let start = Instant::now();
        loop {
            let (_, now) = disk.get(&link).await;
            if what(&now) {
                return now;
            }
            assert!(start.elapsed() < Duration::from_secs(60), "{now:#}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    wait(&|job| job["queue"]["held"] == "disk_full").await;
    std::fs::remove_file(&filler).unwrap();
    // Pictures of nothing make no model; the run came to its end.
    let over = wait(&|job| job["finished_at"].is_string()).await;
    assert_eq!(over["error"]["code"], "no_model", "{over:#}");
}
