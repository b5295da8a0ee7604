//! Clients that others wrote upload through a line that breaks again and again.

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};
use std::time::Duration;

use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::{TcpListener, TcpStream};

use crate::service::Service;

/// Forwards connections to the service and cuts the first `cuts` of them after some bytes of the sender.
struct BadLine {
    base: String,
    cut: Arc<AtomicUsize>,
}

impl BadLine {
    async fn before(service: &Service, cuts: usize) -> Self {
        let target = service.server.as_ref().unwrap().address;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        let base = format!("http://{}", listener.local_addr().unwrap());
        let cut = Arc::new(AtomicUsize::new(0));
        let count = Arc::clone(&cut);
        tokio::spawn(async move {
            while let Ok((client, _)) = listener.accept().await {
                let upstream = TcpStream::connect(target).await.unwrap();
                let number = count.load(Ordering::SeqCst);
                let budget = if number < cuts { 20_000 + (number * 77_777) % 300_000 } else { usize::MAX };
                let count = Arc::clone(&count);
                tokio::spawn(async move {
                    if forward(client, upstream, budget).await {
                        count.fetch_add(1, Ordering::SeqCst);
                    }
                });
            }
        });
        Self { base, cut }
    }
}

/// Whether the line was cut.
async fn forward(mut client: TcpStream, mut server: TcpStream, mut budget: usize) -> bool {
    let (mut up, mut down) = (vec![0; 16 << 10], vec![0; 16 << 10]);
    loop {
        tokio::select! {
            read = client.read(&mut up) => match read {
                Ok(n) if n > 0 && server.write_all(&up[..n]).await.is_ok() => {
                    budget = budget.saturating_sub(n);
                    if budget == 0 {
                        return true;
                    }
                }
                _ => return false,
            },
            read = server.read(&mut down) => match read {
                Ok(n) if n > 0 && client.write_all(&down[..n]).await.is_ok() => {}
                _ => return false,
            },
        }
    }
}

/// Uploads with a client through the bad line; the photograph must be the file.
async fn upload_with(program: &str, arguments: &[&str], mode: Option<&str>, cuts: usize) {
    let service = Service::start().await;
    let dataset = service.post_json("/api/v1/datasets", &json!({})).await.ok(201)["id"].as_str().unwrap().to_owned();
    let line = BadLine::before(&service, cuts).await;
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("picture.jpg");
    let bytes: Vec<u8> = (0..3_000_000u64).map(|at| (at.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8).collect();
    std::fs::write(&file, &bytes).unwrap();
    let name = "sub/石 1.jpg";
    let mut command = tokio::process::Command::new(program);
    command.args(arguments).arg(format!("{}/api/v1/uploads", line.base)).args([&dataset, file.to_str().unwrap(), name]);
    let output = command.args(mode).kill_on_drop(true).output();
    let output =
        tokio::time::timeout(Duration::from_secs(60), output).await.expect("the client comes to an end").unwrap();
    let said = format!("{}{}", String::from_utf8_lossy(&output.stdout), String::from_utf8_lossy(&output.stderr));
    assert!(output.status.success(), "{said}");
    let stored = service.data_dir().join("datasets").join(&dataset).join("images").join(name);
    assert!(std::fs::read(stored).unwrap() == bytes, "the photograph is not the file: {said}");
    let cut = line.cut.load(Ordering::SeqCst);
    assert!(cut >= cuts, "the line was cut {cut} times only: {said}");
    println!("{mode:?}: the line was cut {cut} times; {said}");
}

#[tokio::test(flavor = "multi_thread")]
async fn tus_js_client_goes_on_where_its_line_broke() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/page/tus-upload.mjs");
    if !Path::new(concat!(env!("CARGO_MANIFEST_DIR"), "/tests/page/node_modules/tus-js-client")).is_dir() {
        return println!("skipped: tus-js-client is not installed");
    }
    for mode in ["plain", "chunks", "parallel"] {
        upload_with("node", &[script], Some(mode), 12).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn tuspy_goes_on_where_its_line_broke() {
    let script = concat!(env!("CARGO_MANIFEST_DIR"), "/tests/clients/tus_upload.py");
    let Ok(python) = std::env::var("MULTISTAGE_PYTHON") else {
        return println!("skipped: MULTISTAGE_PYTHON names no python with tuspy");
    };
    upload_with(&python, &[script], None, 6).await;
}
