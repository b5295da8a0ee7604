//! Holds the running program to `openapi.yaml` by programs of others: schemathesis makes requests of the document, good
//! and bad, and checks every answer; a client that is generated from it reconstructs.
//!
//! `MULTISTAGE_EXAMPLES=500 cargo test --locked --test program contract -- --nocapture` tries 500 requests of every
//! kind per operation.

use std::path::{Path, PathBuf};
use std::process::{Command, Output};
use std::time::Duration;

use multistage::store::{DataDir, Db, Scope, create_token};
use reqwest::multipart::{Form, Part};
use serde_json::Value;

use crate::program::Program;

/// Examples per operation of an ordinary test run.
const EXAMPLES: &str = "15";

const CONTRACT: &str = concat!(env!("CARGO_MANIFEST_DIR"), "/openapi.yaml");

/// The folder of the Python programs; none where they are not installed.
fn programs() -> Option<PathBuf> {
    let python = PathBuf::from(std::env::var("MULTISTAGE_PYTHON").ok()?);
    Some(python.parent()?.to_path_buf())
}

/// Photographs of the synthetic temple.
fn photographs(folder: &Path) -> Vec<PathBuf> {
    let spec = folder.join("spec.json");
    let options = serde_json::json!({"scene": "temple", "num_images": 8, "arc_deg": 110, "width": 400, "height": 300});
    std::fs::write(&spec, options.to_string()).unwrap();
    let mut render = Command::new(env!("CARGO_BIN_EXE_multistage"));
    assert!(
        render.args(["synthesize", spec.to_str().unwrap(), "--out"]).arg(folder).output().unwrap().status.success()
    );
    let mut found: Vec<_> =
        std::fs::read_dir(folder.join("images")).unwrap().map(|entry| entry.unwrap().path()).collect();
    found.sort();
    found
}

/// The program, which wants a token, and one of those.
async fn start(data_dir: &Path) -> (Program, String) {
    let limits = ["--requests-per-s", "100000", "--wrong-tokens-per-min", "1000000"];
    let program = Program::start_with(data_dir, &[&["--require-token"], &limits[..]].concat());
    let db = Db::open(&DataDir::database_in(data_dir)).await.unwrap();
    let token = create_token(&db, "contract", &[Scope::Read, Scope::Submit]).await.unwrap();
    db.close().await;
    (program, token)
}

fn said(output: &Output) -> String {
    format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr))
}

#[tokio::test(flavor = "multi_thread")]
async fn schemathesis_finds_nothing() {
    let Some(programs) = programs() else {
        return println!("skipped: MULTISTAGE_PYTHON names no python with schemathesis");
    };
    let folder = tempfile::tempdir().unwrap();
    let (program, token) = start(&folder.path().join("data")).await;
    // A job that is over, for what is to be looked at.
    let http = reqwest::Client::new();
    let mut form = Form::new();
    for photograph in photographs(folder.path()) {
        let name = photograph.file_name().unwrap().to_str().unwrap().to_owned();
        form = form.part("images", Part::bytes(std::fs::read(photograph).unwrap()).file_name(name));
    }
    let request = http.post(format!("{}/api/v1/jobs", program.base)).bearer_auth(&token).multipart(form);
    let mut job: Value = request.send().await.unwrap().json().await.unwrap();
    while job["finished_at"].is_null() {
        tokio::time::sleep(Duration::from_millis(50)).await;
        let link = format!("{}{}", program.base, job["links"]["self"].as_str().unwrap());
        job = http.get(link).bearer_auth(&token).send().await.unwrap().json().await.unwrap();
    }
    // This service wants a token everywhere, so the document says so: without that, requests without one would go untested.
    let document = std::fs::read_to_string(CONTRACT).unwrap();
    let strict = document.replace("security: [{ bearer: [] }, { basic: [] }, {}]", "security: [{ bearer: [] }]");
    assert_ne!(strict, document);
    let contract = folder.path().join("openapi.yaml");
    std::fs::write(&contract, strict).unwrap();
    let settings = include_str!("contract/schemathesis.toml")
        .replace("${HOOKS}", concat!(env!("CARGO_MANIFEST_DIR"), "/tests/program/contract/hooks.py"))
        .replace("${TOKEN}", &token)
        .replace("${JOB}", job["id"].as_str().unwrap())
        .replace("${DATASET}", job["dataset_id"].as_str().unwrap());
    std::fs::write(folder.path().join("schemathesis.toml"), settings).unwrap();
    let examples = std::env::var("MULTISTAGE_EXAMPLES").unwrap_or_else(|_| EXAMPLES.to_owned());
    let mut command = Command::new(programs.join("schemathesis"));
    command
        .args(["--config-file", "schemathesis.toml", "run", contract.to_str().unwrap()])
        .args(["--url", &program.base, "--checks", "all", "--max-examples", &examples])
        .args(["--suppress-health-check", "all", "--no-color"])
        .current_dir(folder.path());
    let output = tokio::task::spawn_blocking(move || command.output()).await.unwrap().unwrap();
    let said = said(&output);
    assert!(output.status.success(), "{said}");
    println!("{}", said.split("= SUMMARY =").last().unwrap());
    // And it still works.
    let answer = http.get(format!("{}/api/v1/jobs", program.base)).bearer_auth(&token).send().await.unwrap();
    assert!(answer.status().is_success());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_generated_client_reconstructs() {
    let Some(programs) = programs() else {
        return println!("skipped: MULTISTAGE_PYTHON names no python with openapi-python-client");
    };
    let folder = tempfile::tempdir().unwrap();
    let (program, token) = start(&folder.path().join("data")).await;
    let path = format!("{}:{}", programs.display(), std::env::var("PATH").unwrap_or_default());
    let generated = Command::new(programs.join("openapi-python-client"))
        .args(["generate", "--path", CONTRACT, "--meta", "none", "--output-path", "client"])
        .args(["--config", concat!(env!("CARGO_MANIFEST_DIR"), "/tests/program/contract/generator.yaml")])
        .env("PATH", path)
        .current_dir(folder.path())
        .output()
        .unwrap();
    assert!(generated.status.success(), "{}", said(&generated));
    assert!(!said(&generated).contains("WARNING"), "{}", said(&generated));
    let mut command = Command::new(programs.join("python"));
    command
        .arg(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/program/contract/generated_client.py"))
        .args([&program.base, &token])
        .args(photographs(folder.path()))
        .env("PYTHONPATH", folder.path());
    let output = tokio::task::spawn_blocking(move || command.output()).await.unwrap().unwrap();
    assert!(output.status.success(), "{}", said(&output));
    println!("{}", said(&output));
}
