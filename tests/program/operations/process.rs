//! The real program: stopped by a signal in the middle of a job, its log, and the figures of the service.

use std::path::Path;
use std::time::{Duration, Instant};

use serde_json::Value;

use crate::program::Program;
use crate::service::{Service, file, photographs};

/// After SIGTERM the process is gone within this time.
const STOPPED: Duration = Duration::from_secs(10);

fn serve(data_dir: &Path, log: std::fs::File) -> Program {
    Program::start_logging_at("info", data_dir, &["--threads", "1", "--log-format", "json"], log)
}

/// A photograph of noise, which has features everywhere and takes its time.
fn noise(seed: u32) -> Vec<u8> {
    let mut state = seed.wrapping_mul(2_654_435_761) | 1;
    let image = image::RgbImage::from_fn(1600, 1200, |_, _| {
        state ^= state << 13;
        state ^= state >> 17;
        state ^= state << 5;
        image::Rgb([state as u8; 3])
    });
    let mut bytes = Vec::new();
    image.write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg).unwrap();
    bytes
}

#[tokio::test(flavor = "multi_thread")]
async fn a_signal_stops_the_program_in_time_and_its_job_goes_on_after() {
    let folder = tempfile::tempdir().unwrap();
    let (data, log) = (folder.path().join("data"), folder.path().join("log"));
    let mut program = serve(&data, std::fs::File::create(&log).unwrap());
    let base = program.base.clone();
    let form = (0..6)
        .fold(reqwest::multipart::Form::new(), |form, n| form.part("images", file(&format!("{n}.jpg"), &noise(n + 1))));
    let sent = reqwest::Client::new().post(format!("{base}/api/v1/jobs")).multipart(form).send().await.unwrap();
    let request_id = sent.headers()["x-request-id"].to_str().unwrap().to_owned();
    let link = sent.headers()["location"].to_str().unwrap().to_owned();
    let job =
        async |base: &str| -> Value { reqwest::get(format!("{base}{link}")).await.unwrap().json().await.unwrap() };
    let start = Instant::now();
    while {
        let now = job(&base).await;
        now["stage"]["name"] != "features" || now["stage"]["done"].as_u64() < Some(2)
    } {
        assert!(start.elapsed() < Duration::from_secs(60));
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    // Somebody listens, too; that must not hold it up.
    let mut events = reqwest::get(format!("{base}{link}/events")).await.unwrap();
    assert!(events.chunk().await.unwrap().is_some());
    let asked = Instant::now();
    let pid = rustix::process::Pid::from_raw(program.id() as i32).unwrap();
    rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
    let status = loop {
        if let Some(status) = program.ended() {
            break status;
        }
        assert!(asked.elapsed() < STOPPED, "still there after {:?}", asked.elapsed());
        tokio::time::sleep(Duration::from_millis(5)).await;
    };
    println!("stopped after {:.2?}", asked.elapsed());
    assert!(status.success(), "{status}");

    let text = std::fs::read_to_string(&log).unwrap();
    let lines: Vec<Value> = text.lines().map(|line| serde_json::from_str(line).unwrap()).collect();
    let answered = lines.iter().find(|line| line["span"]["request_id"] == request_id.as_str()).unwrap();
    assert_eq!((&answered["span"]["method"], &answered["fields"]["status"]), (&"POST".into(), &202.into()));
    let id = link.rsplit('/').next().unwrap();
    assert!(lines.iter().any(|line| line["span"]["id"] == id && line["span"]["name"] == "job"), "{text}");

    let program = serve(&data, std::fs::File::create(&log).unwrap());
    let over = loop {
        let now = job(&program.base).await;
        if now["finished_at"].is_string() {
            break now;
        }
        assert!(start.elapsed() < Duration::from_secs(120), "{now:#}");
        tokio::time::sleep(Duration::from_millis(50)).await;
    };
    program.kill();
    let reused = over["stages"][1]["counts"]["images_reused"].as_f64().unwrap();
    assert!(reused >= 2.0, "what was done before the signal is not done again: {over:#}");
    assert_eq!(over["error"]["code"], "no_model", "noise makes no model");
}

#[tokio::test(flavor = "multi_thread")]
async fn the_figures_count_jobs_stages_bytes_and_problems() {
    let service = Service::start().await;
    let done = service.job("quick").await;
    service.wait_state(&done, "succeeded").await;
    let failed = service.job("panic").await;
    service.wait_state(&failed, "failed").await;
    let hanging = service.job("hang").await;
    service.wait_hanging(&hanging).await;
    service.post_form("/api/v1/jobs", photographs(["a.jpg"])).await.ok(202);
    service.get("/api/v1/jobs/nothing").await.assert_problem(404, "job_not_found");
    tokio::time::sleep(Duration::from_millis(20)).await;
    let text = service.get("/metrics").await.text();
    let value = |name: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(name)?.strip_prefix(' '));
        line.unwrap_or_else(|| panic!("no {name} in\n{text}")).parse::<f64>().unwrap()
    };
    assert_eq!(value("multistage_jobs{state=\"queued\"}"), 1.0);
    assert_eq!(value("multistage_jobs{state=\"running\"}"), 1.0);
    assert_eq!(value("multistage_job_runs_total{state=\"succeeded\"}"), 1.0);
    assert_eq!(value("multistage_job_errors_total{code=\"panic\"}"), 1.0);
    assert_eq!(value("multistage_job_images_total"), 3.0);
    assert_eq!(value("multistage_job_images_per_second"), 3.0);
    assert_eq!(value("multistage_http_problems_total{code=\"job_not_found\"}"), 1.0);
    assert_eq!(value("multistage_upload_images_total"), 10.0);
    assert!(value("multistage_queue_oldest_wait_seconds") > 0.0);
    assert!(value("multistage_disk_free_bytes") > 0.0);
    let writes = value("multistage_store_write_seconds_count");
    assert!(writes > 10.0 && value("multistage_store_write_seconds_bucket{le=\"+Inf\"}") == writes);
    assert!(value("multistage_store_write_seconds_bucket{le=\"0.001\"}") <= writes);
    assert!(value("multistage_store_sync_seconds_total") > 0.0);
    assert_eq!(value("multistage_stage_wall_seconds_total{stage=\"intake\"}"), 0.5);
    // Every family has its help and its type, once.
    for line in text.lines().filter(|line| !line.starts_with('#')) {
        let name = line.split(['{', ' ']).next().unwrap();
        // A histogram is one family of several names.
        let name = ["_bucket", "_sum", "_count"].iter().find_map(|end| name.strip_suffix(end)).unwrap_or(name);
        for word in ["HELP", "TYPE"] {
            assert_eq!(text.matches(&format!("# {word} {name} ")).count(), 1, "{name}");
        }
    }
}
