//! A job that is asked to stop stops within five seconds, in whatever stage it is, and goes on from there when it is resumed.

use std::path::PathBuf;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::program::Program;

/// From the answer to the cancel to the state `cancelled`.
const STOPPED: Duration = Duration::from_secs(5);
const STAGES: [&str; 7] = ["features", "coarse_match", "coarse_model", "add_cameras", "add_points", "refine", "export"];

async fn job(base: &str, link: &str) -> Value {
    reqwest::get(format!("{base}{link}")).await.unwrap().json().await.unwrap()
}

async fn post(base: &str, link: &str) -> u16 {
    reqwest::Client::new().post(format!("{base}{link}")).send().await.unwrap().status().as_u16()
}

fn is_over(job: &Value) -> bool {
    ["succeeded", "failed", "cancelled"].iter().any(|state| job["state"] == *state)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancelled_job_stops_within_five_seconds_in_every_stage() {
    let _alone = crate::alone().await;
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets/strecha-fountain-p11/images");
    let Ok(entries) = std::fs::read_dir(folder) else {
        println!("SKIPPED: the photographs in ../shared/datasets are not there");
        return;
    };
    let data = tempfile::tempdir().unwrap();
    let program = Program::start(data.path());
    let mut form = reqwest::multipart::Form::new();
    for entry in entries {
        let path = entry.unwrap().path();
        if path.extension().is_some_and(|extension| extension == "jpg") {
            let name = path.file_name().unwrap().to_str().unwrap().to_owned();
            let part = reqwest::multipart::Part::bytes(std::fs::read(&path).unwrap()).file_name(name);
            form = form.part("images", part);
        }
    }
    let request = reqwest::Client::new().post(format!("{}/api/v1/jobs", program.base)).multipart(form);
    let link = request.send().await.unwrap().headers()["location"].to_str().unwrap().to_owned();

    let (mut told, mut longest, mut stopped) = (String::new(), Duration::ZERO, 0);
    for stage in STAGES {
        let now = loop {
            let now = job(&program.base, &link).await;
            let reached = STAGES.iter().position(|name| now["stage"]["name"] == *name);
            // Short stages go by unseen.
            if is_over(&now) || reached >= STAGES.iter().position(|name| *name == stage) {
                break now;
            }
            tokio::time::sleep(Duration::from_millis(20)).await;
        };
        if is_over(&now) {
            assert_eq!(now["state"], "succeeded", "{now:#}");
            break;
        }
        let stage = now["stage"]["name"].as_str().unwrap();
        let asked = Instant::now();
        assert_eq!(post(&program.base, &format!("{link}/cancel")).await, 202);
        let over = loop {
            let now = job(&program.base, &link).await;
            if is_over(&now) {
                break now;
            }
            assert!(asked.elapsed() < STOPPED, "still running {:?} after it was asked in {stage}", asked.elapsed());
            tokio::time::sleep(Duration::from_millis(5)).await;
        };
        if over["state"] == "succeeded" {
            break;
        }
        let took = asked.elapsed();
        longest = longest.max(took);
        told += &format!(" {stage} {took:.2?}");
        stopped += 1;
        assert_eq!(over["state"], "cancelled", "{over:#}");
        assert_eq!(post(&program.base, &format!("{link}/resume")).await, 202);
    }
    println!("stopped after:{told}; at most {longest:.2?}");
    assert!(stopped >= 4, "the stages went by too quickly to be cancelled: {told}");
    let done = loop {
        let now = job(&program.base, &link).await;
        if is_over(&now) {
            break now;
        }
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    assert_eq!(done["state"], "succeeded", "{done:#}");
    // What was finished before is not done again.
    assert_eq!(done["stages"][1]["counts"]["images_reused"], 11.0, "{done:#}");
    assert_eq!(done["stages"][2]["state"], "reused", "{done:#}");
}
