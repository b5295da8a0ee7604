//! Somebody sets the system's clock a day forward and back under the running program, and between two starts: nothing
//! expires early, and no duration is negative.

use std::fs::File;
use std::os::unix::fs::FileExt;
use std::path::Path;
use std::process::{Command, Stdio};
use std::time::{Duration, Instant};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use reqwest::Client;
use serde_json::{Value, json};

use crate::program::Program;
use crate::service::noise;

const DAY_S: i64 = 24 * 3600;

/// The program with a clock that [`set`] sets.
fn start(data_dir: &Path, library: &Path, clock: &Path) -> Program {
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    command.env("LD_PRELOAD", library).env("CLOCK_FILE", clock);
    Program::start_as(command, data_dir, &[], Stdio::inherit())
}

fn set(clock: &Path, offset_s: i64) {
    File::options().write(true).open(clock).unwrap().write_all_at(&offset_s.to_ne_bytes(), 0).unwrap();
}

/// No number is negative, and times are in their order.
fn check(job: &Value) {
    fn numbers(value: &Value, job: &Value) {
        match value {
            Value::Number(number) => assert!(number.as_f64().unwrap() >= 0.0, "{job:#}"),
            Value::Array(values) => values.iter().for_each(|value| numbers(value, job)),
            Value::Object(values) => values.values().for_each(|value| numbers(value, job)),
            _ => {}
        }
    }
    numbers(&without(job, "priority"), job);
    let times: Vec<&str> =
        ["created_at", "started_at", "finished_at"].iter().filter_map(|at| job[at].as_str()).collect();
    assert!(times.is_sorted(), "{job:#}");
}

fn without(job: &Value, name: &str) -> Value {
    let mut job = job.clone();
    job.as_object_mut().unwrap().remove(name);
    job
}

async fn get(base: &str, path: &str) -> Value {
    reqwest::get(format!("{base}{path}")).await.unwrap().json().await.unwrap()
}

async fn offset(http: &Client, base: &str, link: &str) -> String {
    let head = http.head(format!("{base}{link}")).header("tus-resumable", "1.0.0").send().await.unwrap();
    assert_eq!(head.status(), 200, "it must not have expired");
    head.headers()["upload-offset"].to_str().unwrap().to_owned()
}

/// Follows a job to its end, checked all the way; in the middle of it the clock is set.
async fn follow(base: &str, job: &str, mut set_clock: impl FnMut(usize)) -> Value {
    let start = Instant::now();
    for look in 0.. {
        let now = get(base, job).await;
        check(&now);
        if now["finished_at"].is_string() {
            return now;
        }
        if now["state"] == "running" {
            set_clock(look);
        }
        assert!(start.elapsed() < Duration::from_secs(60), "{now:#}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    unreachable!()
}

#[tokio::test(flavor = "multi_thread")]
async fn setting_the_clock_expires_nothing_and_turns_no_duration_negative() {
    let folder = tempfile::tempdir().unwrap();
    let (library, clock, data) =
        (folder.path().join("clock.so"), folder.path().join("clock"), folder.path().join("data"));
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/program/clock.c");
    let built =
        Command::new("cc").args(["-shared", "-fPIC", "-O1", "-o"]).arg(&library).arg(source).arg("-ldl").status();
    if !built.is_ok_and(|status| status.success()) {
        println!("SKIPPED: there is no C compiler to build the clock with");
        return;
    }
    std::fs::write(&clock, 0i64.to_ne_bytes()).unwrap();
    let program = start(&data, &library, &clock);
    let (http, base) = (Client::new(), program.base.clone());
    let made = http.post(format!("{base}/api/v1/datasets")).json(&json!({})).send().await.unwrap();
    let dataset = made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned();
    let mut form = reqwest::multipart::Form::new();
    for seed in 0..4 {
        let part = reqwest::multipart::Part::bytes(noise([1200, 900], seed)).file_name(format!("{seed}.jpg"));
        form = form.part("images", part);
    }
    let images = format!("{base}/api/v1/datasets/{dataset}/images");
    assert_eq!(http.post(images).multipart(form).send().await.unwrap().status(), 200);
    // Half an upload.
    let made = http.post(format!("{base}/api/v1/datasets")).json(&json!({})).send().await.unwrap();
    let other = made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned();
    let metadata = format!("dataset {},path {}", BASE64_STANDARD.encode(other), BASE64_STANDARD.encode("a.jpg"));
    let create = http.post(format!("{base}/api/v1/uploads")).header("tus-resumable", "1.0.0");
    let create = create.header("upload-length", 10).header("upload-metadata", metadata);
    let upload = create.header("content-type", "application/offset+octet-stream").body("12345").send().await.unwrap();
    let upload = upload.headers()["location"].to_str().unwrap().to_owned();
    // A day forward, and two back.
    for days in [1, -1] {
        set(&clock, days * DAY_S);
        assert_eq!(offset(&http, &base, &upload).await, "5");
    }
    let queue = async |base: &str| {
        let queued =
            http.post(format!("{base}/api/v1/jobs")).json(&json!({"dataset_id": dataset})).send().await.unwrap();
        assert_eq!(queued.status(), 202);
        queued.headers()["location"].to_str().unwrap().to_owned()
    };
    let job = queue(&base).await;
    let days = [0, 1, -1];
    let over = follow(&base, &job, |look| set(&clock, days[look % 3] * DAY_S)).await;
    assert!(over["stages"][0]["wall_s"].as_f64().unwrap() < 60.0, "{over:#}");
    // A job that waits while the machine's clock is set back, and the program starts again.
    set(&clock, DAY_S);
    let waiting = queue(&base).await;
    program.kill();
    set(&clock, -DAY_S);
    let program = start(&data, &library, &clock);
    follow(&program.base, &waiting, |_| {}).await;
    check(&get(&program.base, &job).await);
    assert_eq!(offset(&http, &program.base, &upload).await, "5");
    let metrics = reqwest::get(format!("{}/metrics", program.base)).await.unwrap().text().await.unwrap();
    let negative = metrics.lines().find(|line| !line.starts_with('#') && line.contains(" -"));
    assert_eq!(negative, None);
}
