//! The real program, killed with SIGKILL at random moments while a client uploads, queues, waits, downloads and
//! deletes. What was acknowledged must be there after every start, no job may be lost, doubled or stuck, and the models
//! must be, byte for byte, those of a run that nobody disturbed.
//!
//! `MULTISTAGE_KILLS=300 cargo test --locked --test program kills -- --nocapture` kills 300 times.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use multistage::math::Rng;
use reqwest::{Response, StatusCode};
use serde_json::{Value, json};
use sha2::Digest;
use tokio::sync::watch;

use crate::program::Program;

/// Kills of an ordinary test run.
const KILLS: usize = 40;
/// After a start the service must be ready within this time.
const READY: Duration = Duration::from_secs(5);
/// The shortest and the longest first life of a process; every further kill within one job makes the next life longer, so that
/// stages whose length the test can't know come to their end.
const LIFE: [Duration; 2] = [Duration::from_millis(30), Duration::from_millis(1500)];
const LONGER: f64 = 1.25;
/// Every other life ends in one of these, in turn, so that the short ones are hit too, and within this time of its begin.
const TARGETS: [&str; 8] =
    ["outputs", "delete", "export", "add_points", "refine", "coarse_match", "add_cameras", "coarse_model"];
const WITHIN: Duration = Duration::from_millis(40);

/// Starts the program, which must be ready in time.
async fn start(data_dir: &Path) -> Program {
    let start = Instant::now();
    let program = Program::start(data_dir);
    let ready = reqwest::get(format!("{}/readyz", program.base)).await.unwrap();
    assert!(ready.status().is_success() && start.elapsed() < READY, "not ready after {:?}", start.elapsed());
    program
}

/// What the client was told, and what it therefore counts on.
#[derive(Default)]
struct Client {
    photographs: Vec<(String, Vec<u8>)>,
    dataset: Option<String>,
    /// Addresses of uploads, by photograph, with the offset that was acknowledged.
    uploads: BTreeMap<String, (String, usize)>,
    stored: BTreeSet<String>,
    job: Option<String>,
    /// Entity tags of what the job made, the reports left out: they speak of times.
    outputs: Option<BTreeMap<String, String>>,
    deleted: bool,
    /// Where it was, for the tally of kills.
    phase: watch::Sender<String>,
}

type Outcome<T> = Result<T, reqwest::Error>;

fn sha256(bytes: &[u8]) -> String {
    sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[track_caller]
fn expect(response: &Response, statuses: &[u16]) {
    assert!(statuses.contains(&response.status().as_u16()), "{} {}", response.url(), response.status());
}

async fn get(base: &str, path: &str) -> Outcome<Value> {
    let response = reqwest::get(format!("{base}{path}")).await?;
    expect(&response, &[200]);
    response.json().await
}

impl Client {
    fn new(photographs: &[(String, Vec<u8>)]) -> Self {
        Self { photographs: photographs.to_vec(), ..Self::default() }
    }

    /// Everything that was acknowledged is there.
    async fn check(&mut self, base: &str) -> Outcome<()> {
        let Some(dataset) = &self.dataset else { return Ok(()) };
        if self.deleted {
            let response = reqwest::get(format!("{base}{}", self.job.as_ref().unwrap())).await?;
            expect(&response, &[404]);
            return Ok(());
        }
        let images = get(base, &format!("/api/v1/datasets/{dataset}/images?limit=1000")).await?;
        let listed: BTreeMap<_, _> = images["images"]
            .as_array()
            .unwrap()
            .iter()
            .map(|image| (image["path"].as_str().unwrap().to_owned(), image["sha256"].as_str().unwrap().to_owned()))
            .collect();
        for (name, bytes) in &self.photographs {
            if self.stored.contains(name) {
                assert_eq!(listed.get(name), Some(&sha256(bytes)), "{name} was acknowledged");
            }
        }
        let http = reqwest::Client::new();
        for (name, (upload, acknowledged)) in &self.uploads {
            let answer = http.head(format!("{base}{upload}")).header("tus-resumable", "1.0.0").send().await?;
            expect(&answer, &[200]);
            let offset: usize = answer.headers()["upload-offset"].to_str().unwrap().parse().unwrap();
            assert!(offset >= *acknowledged, "{name}: {acknowledged} bytes were acknowledged, {offset} are there");
        }
        if let Some(job) = &self.job
            && *self.phase.borrow() != "delete"
        {
            let job = get(base, job).await?;
            assert!(job["state"] != "failed" && job["state"] != "cancelled", "{job:#}");
        }
        Ok(())
    }

    /// Goes on from where it stands; returns when everything is done, or with the error of a broken connection.
    async fn go_on(&mut self, base: &str) -> Outcome<()> {
        self.check(base).await?;
        let http = reqwest::Client::new();
        if self.dataset.is_none() {
            self.phase.send_replace("dataset".to_owned());
            let answer = http.post(format!("{base}/api/v1/datasets")).json(&json!({})).send().await?;
            expect(&answer, &[201]);
            self.dataset = Some(answer.json::<Value>().await?["id"].as_str().unwrap().to_owned());
        }
        let dataset = self.dataset.clone().unwrap();
        self.phase.send_replace("upload".to_owned());
        for (name, bytes) in self.photographs.clone() {
            if !self.stored.contains(&name) {
                self.upload(&http, base, &dataset, &name, &bytes).await?;
            }
        }
        if self.job.is_none() {
            self.phase.send_replace("queue".to_owned());
            // An answer may have been lost: the job is made once, by its name.
            let jobs = get(base, "/api/v1/jobs?limit=1000").await?;
            let mine: Vec<_> =
                jobs["jobs"].as_array().unwrap().iter().filter(|job| job["dataset_id"] == *dataset).collect();
            assert!(mine.len() <= 1, "a job was doubled");
            let link = match mine.first() {
                Some(job) => job["links"]["self"].as_str().unwrap().to_owned(),
                None => {
                    let body = json!({"dataset_id": dataset, "options": {"intake": {"max_long_side_px": 640}}});
                    let answer = http.post(format!("{base}/api/v1/jobs")).json(&body).send().await?;
                    expect(&answer, &[202]);
                    answer.headers()["location"].to_str().unwrap().to_owned()
                }
            };
            self.job = Some(link);
        }
        let link = self.job.clone().unwrap();
        if self.outputs.is_none() {
            loop {
                let job = get(base, &link).await?;
                match job["state"].as_str().unwrap() {
                    "succeeded" => break,
                    "queued" | "running" => {
                        self.phase.send_replace(job["stage"]["name"].as_str().unwrap_or("queued").to_owned());
                    }
                    _ => panic!("{job:#}"),
                }
                tokio::time::sleep(Duration::from_millis(5)).await;
            }
            self.phase.send_replace("outputs".to_owned());
            let list = get(base, &format!("{link}/outputs")).await?;
            let files = list["files"].as_array().unwrap().iter();
            let tags = files
                .map(|file| (file["path"].as_str().unwrap().to_owned(), file["etag"].as_str().unwrap().to_owned()));
            let tags: BTreeMap<_, _> = tags.filter(|(path, _)| !path.starts_with("report.")).collect();
            for path in tags.keys() {
                let answer = reqwest::get(format!("{base}{link}/outputs/{path}")).await?;
                expect(&answer, &[200]);
                answer.bytes().await?;
            }
            self.outputs = Some(tags);
        }
        if !self.deleted {
            self.phase.send_replace("delete".to_owned());
            let answer = http.delete(format!("{base}{link}")).send().await?;
            // Gone already when only the answer was lost.
            expect(&answer, &[204, 404]);
            self.deleted = true;
        }
        Ok(())
    }

    async fn upload(
        &mut self,
        http: &reqwest::Client,
        base: &str,
        dataset: &str,
        name: &str,
        bytes: &[u8],
    ) -> Outcome<()> {
        if !self.uploads.contains_key(name) {
            let metadata = format!("dataset {},path {}", BASE64_STANDARD.encode(dataset), BASE64_STANDARD.encode(name));
            let answer = http
                .post(format!("{base}/api/v1/uploads"))
                .header("tus-resumable", "1.0.0")
                .header("upload-length", bytes.len())
                .header("upload-metadata", metadata)
                .send()
                .await?;
            expect(&answer, &[201]);
            let upload = answer.headers()["location"].to_str().unwrap().to_owned();
            self.uploads.insert(name.to_owned(), (upload, 0));
        }
        let upload = self.uploads[name].0.clone();
        let head = http.head(format!("{base}{upload}")).header("tus-resumable", "1.0.0").send().await?;
        expect(&head, &[200]);
        let mut offset: usize = head.headers()["upload-offset"].to_str().unwrap().parse().unwrap();
        while offset < bytes.len() {
            let end = bytes.len().min(offset + (64 << 10));
            let answer = http
                .patch(format!("{base}{upload}"))
                .header("tus-resumable", "1.0.0")
                .header("content-type", "application/offset+octet-stream")
                .header("upload-offset", offset)
                .body(bytes[offset..end].to_vec())
                .send()
                .await?;
            assert_eq!(answer.status(), StatusCode::NO_CONTENT);
            offset = end;
            self.uploads.insert(name.to_owned(), (upload.clone(), offset));
        }
        self.stored.insert(name.to_owned());
        self.uploads.remove(name);
        Ok(())
    }
}

fn photographs() -> Option<Vec<(String, Vec<u8>)>> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets/bundler-et/images");
    let mut found: Vec<_> = std::fs::read_dir(&folder)
        .ok()?
        .map(|entry| entry.unwrap().path())
        .map(|path| (path.file_name().unwrap().to_str().unwrap().to_owned(), std::fs::read(&path).unwrap()))
        .collect();
    found.sort();
    (found.len() >= 5).then_some(found)
}

/// A generator of delays, seeded, so that a failure can be tried again.
async fn integrity(data_dir: &Path) {
    let url = format!("sqlite://{}", data_dir.join("multistage.db").display());
    let pool = sqlx::SqlitePool::connect(&url).await.unwrap();
    let verdict: String = sqlx::query_scalar("PRAGMA integrity_check").fetch_one(&pool).await.unwrap();
    assert_eq!(verdict, "ok");
    pool.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_acknowledged_is_lost_however_often_the_program_is_killed() {
    let Some(photographs) = photographs() else {
        println!("SKIPPED: the photographs in ../shared/datasets are not there");
        return;
    };
    let kills: usize = std::env::var("MULTISTAGE_KILLS").ok().and_then(|kills| kills.parse().ok()).unwrap_or(KILLS);
    let undisturbed = tempfile::tempdir().unwrap();
    let program = start(undisturbed.path()).await;
    let mut client = Client::new(&photographs);
    client.go_on(&program.base).await.unwrap();
    let expected = client.outputs.clone().unwrap();
    assert!(expected.contains_key("ply/0/points.ply"), "{expected:?}");
    drop(program);

    let folder = tempfile::tempdir().unwrap();
    let mut random = Rng::from_parts(&[7]);
    let (mut killed, mut rounds, mut lives) = (0, 0, 0);
    let mut tally: BTreeMap<String, usize> = BTreeMap::new();
    while killed < kills {
        let mut client = Client::new(&photographs);
        let mut stretch = 1.0;
        loop {
            let program = start(folder.path()).await;
            // Most moments are drawn from short lives: requests take milliseconds, stages seconds.
            let life = LIFE[0] + (LIFE[1] - LIFE[0]).mul_f64(random.uniform().powi(2) * stretch);
            let (base, mut phase) = (program.base.clone(), client.phase.subscribe());
            lives += 1;
            let target = (lives % 2 == 0).then_some(TARGETS[lives / 2 % TARGETS.len()]);
            let pause = WITHIN.mul_f64(random.uniform());
            let end = async {
                match target {
                    // The client holds the other end as long as this is waited for.
                    Some(target) => {
                        let _ = phase.wait_for(|phase| phase == target).await;
                        tokio::time::sleep(pause).await;
                    }
                    None => tokio::time::sleep(life).await,
                }
            };
            let done = tokio::select! {
                outcome = client.go_on(&base) => {
                    outcome.expect("nobody killed the service meanwhile");
                    true
                }
                () = end => false,
            };
            program.kill();
            if done {
                break;
            }
            killed += 1;
            stretch *= LONGER;
            *tally.entry(client.phase.borrow().clone()).or_insert(0) += 1;
        }
        rounds += 1;
        assert_eq!(client.outputs.as_ref(), Some(&expected), "round {rounds}: another model than undisturbed");
        integrity(folder.path()).await;
    }
    // What is left: no job, no file of one, no half upload; datasets that were made for themselves stay.
    let program = start(folder.path()).await;
    assert_eq!(get(&program.base, "/api/v1/jobs").await.unwrap()["jobs"], json!([]));
    for gone in ["jobs", "uploads", "incoming", "trash"] {
        assert_eq!(std::fs::read_dir(folder.path().join(gone)).unwrap().count(), 0, "{gone}");
    }
    println!("killed {killed} times in {rounds} rounds: {tally:?}");
}
