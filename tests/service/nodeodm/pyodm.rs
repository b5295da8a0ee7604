//! PyODM drives the interface from the photographs to the archive.

use std::io::BufRead;
use std::path::Path;
use std::time::Duration;

use multistage::store::{DataDir, Db, Scope, create_token};
use serde_json::json;

use super::start_in;
use crate::program::Program;

/// The script that does by PyODM all that a client does.
async fn pyodm(url: &str, folder: &Path, arguments: &[&str]) {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/clients/nodeodm_tasks.py");
    let Ok(python) = std::env::var("MULTISTAGE_PYTHON") else {
        return println!("skipped: MULTISTAGE_PYTHON names no python with pyodm");
    };
    let mut command = tokio::process::Command::new(python);
    let output = command.args([script, url, folder.to_str().unwrap()]).args(arguments).kill_on_drop(true).output();
    let output = tokio::time::timeout(Duration::from_secs(240), output).await.expect("it comes to an end").unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}");
    println!("{said}");
}

/// On the real program and rendered photographs.
#[tokio::test(flavor = "multi_thread")]
async fn pyodm_reconstructs() {
    let folder = tempfile::tempdir().unwrap();
    let spec = folder.path().join("spec.json");
    let options = json!({"scene": "temple", "num_images": 10, "arc_deg": 140, "width": 480, "height": 360});
    std::fs::write(&spec, options.to_string()).unwrap();
    let mut render = tokio::process::Command::new(env!("CARGO_BIN_EXE_multistage"));
    let rendered = render.args(["synthesize", spec.to_str().unwrap(), "--out"]).arg(folder.path()).output();
    assert!(rendered.await.unwrap().status.success());
    let data = tempfile::tempdir().unwrap();
    let mut program = Program::start_with(data.path(), &["--nodeodm-bind", "127.0.0.1:0"]);
    let mut line = String::new();
    program.output.read_line(&mut line).unwrap();
    let url = line.trim().strip_prefix("NodeODM's interface at ").unwrap().trim_end_matches('/');
    pyodm(url, &folder.path().join("images"), &["100000", "busy"]).await;
}

/// An archive of 36 MB, which PyODM takes in parts of 10 MiB side by side; and with a token.
#[tokio::test(flavor = "multi_thread")]
async fn pyodm_downloads_in_parallel_and_brings_its_token() {
    let service = start_in(tempfile::tempdir().unwrap(), true).await;
    let db = Db::open(&DataDir::database_in(service.data_dir())).await.unwrap();
    let token = create_token(&db, "pyodm", &[Scope::Read, Scope::Submit]).await.unwrap();
    let folder = tempfile::tempdir().unwrap();
    for name in
        ["石 1.jpg", "石 2.JPG", "large.jpg"].map(str::to_owned).into_iter().chain((0..22).map(|n| format!("{n}.jpg")))
    {
        std::fs::write(folder.path().join(&name), name.as_bytes()).unwrap();
    }
    pyodm(&format!("{}/?token={token}", service.nodeodm()), folder.path(), &["36000000"]).await;
}
