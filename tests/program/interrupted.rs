//! A job that ends the process each time it runs, as one that is killed for its memory, must not do so for ever: the
//! real program is killed whenever the job is at the same stage, until it gives the job up, and then serves others.

use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::program::Program;
use crate::service::noise;

/// More lives than a job may take.
const TOO_MANY: usize = 15;

async fn get(base: &str, path: &str) -> Value {
    reqwest::get(format!("{base}{path}")).await.unwrap().json().await.unwrap()
}

async fn dataset(base: &str, photographs: u32) -> String {
    let http = reqwest::Client::new();
    let made = http.post(format!("{base}/api/v1/datasets")).json(&json!({})).send().await.unwrap();
    let dataset = made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned();
    let mut form = reqwest::multipart::Form::new();
    for seed in 0..photographs {
        let part = reqwest::multipart::Part::bytes(noise([2400, 1800], seed)).file_name(format!("{seed}.jpg"));
        form = form.part("images", part);
    }
    let images = format!("{base}/api/v1/datasets/{dataset}/images");
    assert_eq!(http.post(images).multipart(form).send().await.unwrap().status(), 200);
    dataset
}

async fn queue(base: &str, dataset: &str) -> String {
    let queued = reqwest::Client::new().post(format!("{base}/api/v1/jobs")).json(&json!({ "dataset_id": dataset }));
    let queued = queued.send().await.unwrap();
    assert_eq!(queued.status(), 202);
    queued.headers()["location"].to_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_under_which_the_process_dies_each_time_is_given_up_with_its_cause() {
    let folder = tempfile::tempdir().unwrap();
    let mut program = Program::start(folder.path());
    let long = dataset(&program.base, 30).await;
    let deadly = queue(&program.base, &long).await;
    let mut lives = 0;
    let failed = loop {
        let start = Instant::now();
        let now = loop {
            let now = get(&program.base, &deadly).await;
            let at_it = now["state"] == "running" && now["stage"]["name"] == "features";
            if at_it || now["finished_at"].is_string() {
                break now;
            }
            assert!(start.elapsed() < Duration::from_secs(20), "{now:#}");
            tokio::time::sleep(Duration::from_millis(2)).await;
        };
        if now["finished_at"].is_string() {
            break now;
        }
        lives += 1;
        assert!(lives < TOO_MANY, "the job goes on killing the process");
        program.kill();
        program = Program::start(folder.path());
    };
    let (code, stage) = (&failed["error"]["code"], &failed["error"]["stage"]);
    assert_eq!((&failed["state"], code, stage), (&json!("failed"), &json!("interrupted"), &json!("features")));
    assert!(failed["error"]["message"].as_str().unwrap().contains("memory"), "{failed:#}");
    // Others are served.
    let short = dataset(&program.base, 2).await;
    let other = queue(&program.base, &short).await;
    let start = Instant::now();
    while get(&program.base, &other).await["finished_at"].is_null() {
        assert!(start.elapsed() < Duration::from_secs(30));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    println!("given up after {lives} lives: {}", failed["error"]["message"]);
}
