//! `multistage demo`: photographs a synthetic temple, starts the service, has it reconstruct the pictures, and keeps serving.

use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use serde_json::Value;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio::signal::unix::{SignalKind, signal};

use super::{Failure, synthesize};
use crate::config::ServerConfig;
use crate::http::Server;
use crate::jobs::PipelineEngine;
use crate::synthetic::TempleOptions;

/// Arguments of `demo`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Address to listen on; port 0 takes a free one.
    #[arg(long, env = "MULTISTAGE_BIND", default_value = "127.0.0.1:8080")]
    bind: SocketAddr,
    /// Directory of the service; the photographs and their truth go to `demo-temple` in it.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data")]
    data_dir: PathBuf,
    /// Number of photographs.
    #[arg(long, default_value = "30")]
    images: usize,
    /// End when the model is made, instead of serving on.
    #[arg(long)]
    exit: bool,
}

/// Time between two questions for the progress.
const POLL: Duration = Duration::from_millis(500);
/// What separates the parts of the upload; random enough not to occur in a photograph.
const BOUNDARY: &str = "multistage-demo-5f1c9a7e3b2d4c68";

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    tracing_subscriber::fmt()
        .with_env_filter(
            tracing_subscriber::EnvFilter::try_from_default_env()
                .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("warn")),
        )
        .with_writer(std::io::stderr)
        .init();
    let options = TempleOptions { num_images: args.images, ..TempleOptions::default() };
    let mut errors = Vec::new();
    options.validate(&mut errors);
    if !errors.is_empty() {
        return Err(Failure::Input(errors.join("; ")));
    }
    let folder = args.data_dir.join("demo-temple");
    println!("Photographing a temple into {}", folder.display());
    let outside = |error: std::io::Error| Failure::Outside(error.to_string());
    let photographs = synthesize::write_temple(&options, &folder, |done| {
        if done % 5 == 0 || done == options.num_images {
            println!("  {done} of {} photographs", options.num_images);
        }
    })
    .map_err(outside)?;
    let runtime = tokio::runtime::Builder::new_multi_thread().enable_all().build().map_err(outside)?;
    let ended = runtime.block_on(demonstrate(args, &folder, &photographs));
    runtime.shutdown_timeout(Duration::from_secs(1));
    ended
}

async fn demonstrate(args: &Args, folder: &Path, photographs: &[PathBuf]) -> Result<(), Failure> {
    let outside = |error: std::io::Error| Failure::Outside(error.to_string());
    let mut interrupt = signal(SignalKind::interrupt()).map_err(outside)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(outside)?;
    let mut config = ServerConfig::new(&args.data_dir);
    config.bind = args.bind;
    let server =
        Server::start(config, Arc::new(PipelineEngine)).await.map_err(|error| Failure::Outside(error.to_string()))?;
    let address = server.address;
    println!("The service listens on http://{address}/");
    let shown = tokio::select! {
        shown = show(address, folder, photographs) => shown,
        _ = interrupt.recv() => Ok(false),
        _ = terminate.recv() => Ok(false),
    };
    if matches!(shown, Ok(true)) && !args.exit {
        println!("It keeps serving; Ctrl-C ends it.");
        tokio::select! {
            _ = interrupt.recv() => {}
            _ = terminate.recv() => {}
        }
    }
    server.stop().await;
    shown.map(|_| ())
}

/// Sends the photographs, shows the job's progress, and prints the result. True once the model is made.
async fn show(address: SocketAddr, folder: &Path, photographs: &[PathBuf]) -> Result<bool, Failure> {
    let body = form(photographs).await.map_err(|error| Failure::Outside(error.to_string()))?;
    let job = request(address, "POST", "/api/v1/jobs", &body).await?;
    let link = job["links"]["self"].as_str().ok_or_else(|| unexpected(&job))?.to_owned();
    println!("{} photographs sent: http://{address}{link}", photographs.len());
    let mut last = String::new();
    let job = loop {
        let job = request(address, "GET", &link, &[]).await?;
        let stage = progress_line(&job);
        if !stage.is_empty() && stage != last {
            println!("  {stage}");
            last = stage;
        }
        match job["state"].as_str().unwrap_or_default() {
            "queued" | "running" => tokio::time::sleep(POLL).await,
            _ => break job,
        }
    };
    if job["state"] != "succeeded" {
        let message = job["error"]["message"].as_str().unwrap_or("it was stopped");
        return Err(Failure::Outside(format!("the job made no model: {message}")));
    }
    print_result(address, folder, &job);
    Ok(true)
}

/// The running stage in tenths of its work, so that lines are few.
fn progress_line(job: &Value) -> String {
    let stage = &job["stage"];
    let Some(name) = stage["name"].as_str() else { return String::new() };
    let round = stage["iteration"].as_i64().map(|iteration| format!(", round {iteration}:")).unwrap_or_default();
    match (stage["done"].as_i64(), stage["total"].as_i64()) {
        (Some(done), Some(total)) if total > 0 => format!("{name}{round} {} %", 10 * (10 * done / total)),
        _ => format!("{name}{round}"),
    }
}

fn print_result(address: SocketAddr, folder: &Path, job: &Value) {
    let images = &job["images"];
    let models = job["models"].as_array().map_or(0, Vec::len);
    let models = if models == 1 { "one model".to_owned() } else { format!("{models} models") };
    println!("\nDone: {} of {} photographs placed, {models}", images["registered"], images["uploaded"]);
    if let Some(model) = job["models"].get(0) {
        println!(
            "  {} points, {} seen three times or more; mean reprojection error {:.2} px",
            model["points"],
            model["points_3plus"],
            model["mean_reprojection_error_px"].as_f64().unwrap_or(f64::NAN),
        );
    }
    let link = |value: &Value| format!("http://{address}{}", value.as_str().unwrap_or_default());
    println!("  page      http://{address}/#/jobs/{}", job["id"].as_str().unwrap_or_default());
    println!("  points    {}", link(&job["models"][0]["links"]["points"]));
    println!("  report    {}", link(&job["links"]["report"]));
    println!("  all files {}", link(&job["links"]["archive"]));
    println!("  truth     {}", folder.join("gt").display());
}

/// The photographs as a form.
async fn form(photographs: &[PathBuf]) -> std::io::Result<Vec<u8>> {
    let mut body = format!("--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"name\"\r\n\r\nSynthetic temple\r\n")
        .into_bytes();
    for path in photographs {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let head = format!(
            "--{BOUNDARY}\r\ncontent-disposition: form-data; name=\"images\"; filename=\"{name}\"\r\n\
             content-type: image/jpeg\r\n\r\n"
        );
        body.extend_from_slice(head.as_bytes());
        body.extend_from_slice(&tokio::fs::read(path).await?);
        body.extend_from_slice(b"\r\n");
    }
    body.extend_from_slice(format!("--{BOUNDARY}--\r\n").as_bytes());
    Ok(body)
}

fn unexpected(answer: &Value) -> Failure {
    Failure::Outside(format!("the service answered {answer}"))
}

/// One request over a connection of its own (HTTP/1.0, so that the answer ends with the connection), answered with JSON.
async fn request(address: SocketAddr, method: &str, path: &str, body: &[u8]) -> Result<Value, Failure> {
    let exchange = async {
        let mut stream = TcpStream::connect(address).await?;
        let head = format!(
            "{method} {path} HTTP/1.0\r\nhost: {address}\r\ncontent-type: multipart/form-data; boundary={BOUNDARY}\r\n\
             content-length: {}\r\n\r\n",
            body.len()
        );
        stream.write_all(head.as_bytes()).await?;
        stream.write_all(body).await?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await?;
        std::io::Result::Ok(answer)
    };
    let answer = exchange.await.map_err(|error| Failure::Outside(format!("{method} {path}: {error}")))?;
    let split = answer.windows(4).position(|window| window == b"\r\n\r\n").map_or(answer.len(), |at| at + 4);
    let (head, content) = answer.split_at(split);
    let json = serde_json::from_slice(content).unwrap_or(Value::Null);
    let succeeded = head.get(9..12).is_some_and(|status| status.starts_with(b"2"));
    if succeeded { Ok(json) } else { Err(unexpected(&json)) }
}
