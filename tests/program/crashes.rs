//! Jobs outlive the process: what start-up finds after a crash, and the real program killed again and again.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::program::Program;
use crate::service::{FakeEngine, Service, file, files_below, photographs};

/// The data directory as a crash at this moment would leave it.
fn crash_image(service: &Service) -> tempfile::TempDir {
    fn copy(from: &Path, to: &Path) {
        std::fs::create_dir_all(to).unwrap();
        for entry in std::fs::read_dir(from).unwrap() {
            let entry = entry.unwrap();
            let target = to.join(entry.file_name());
            if entry.path().is_dir() {
                copy(&entry.path(), &target)
            } else {
                assert!(std::fs::copy(entry.path(), target).is_ok())
            }
        }
    }
    let image = tempfile::tempdir().unwrap();
    copy(service.data_dir(), image.path());
    image
}

/// The service started on such an image, once this statement has changed its database.
async fn started_after(image: tempfile::TempDir, change: &'static str) -> Service {
    let url = format!("sqlite://{}", image.path().join("multistage.db").display());
    let pool = sqlx::SqlitePool::connect(&url).await.unwrap();
    sqlx::query(change).execute(&pool).await.unwrap();
    pool.close().await;
    Service::start_in(image, |_| {}).await
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_ran_goes_on_from_its_last_finished_stage() {
    let service = Service::start().await;
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let queued = service.job("quick").await;
    let after = Service::start_in(crash_image(&service), |_| {}).await;
    let done = after.wait_state(&job, "succeeded").await;
    let states: Vec<_> = done["stages"].as_array().unwrap().iter().map(|stage| &stage["state"]).collect();
    assert_eq!(states, ["reused", "done", "done"]);
    assert_eq!(after.wait_state(&queued, "succeeded").await["images"]["registered"], 3);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_cancel_that_was_acknowledged_holds_after_a_crash() {
    let service = Service::start().await;
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let image = crash_image(&service);
    // The crash came between the answer to the cancel and the end of the run.
    let after = started_after(image, "UPDATE jobs SET cancel_requested = 1").await;
    let cancelled = after.get(job["links"]["self"].as_str().unwrap()).await.ok(200);
    assert_eq!((&cancelled["state"], &cancelled["cancel_requested"]), (&json!("cancelled"), &json!(false)));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_kills_the_process_again_and_again_is_given_up() {
    let service = Service::start().await;
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let image = crash_image(&service);
    let after = started_after(image, "UPDATE jobs SET interruptions = 9, stages_finished = 1").await;
    let failed = after.get(job["links"]["self"].as_str().unwrap()).await.ok(200);
    assert_eq!((&failed["error"]["code"], &failed["error"]["stage"]), (&json!("interrupted"), &json!("coarse_match")));
    // Somebody may still want to try.
    after.post(job["links"]["resume"].as_str().unwrap()).await.ok(202);
    after.wait_state(&job, "succeeded").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn an_upload_that_was_never_acknowledged_leaves_nothing_after_a_crash() {
    use tokio::io::AsyncWriteExt;
    let service = Service::start().await;
    let mut sender = tokio::net::TcpStream::connect(service.server.as_ref().unwrap().address).await.unwrap();
    let mut body = String::from(
        "POST /api/v1/jobs HTTP/1.1\r\nhost: x\r\ncontent-type: multipart/form-data; boundary=x\r\ncontent-length: 9999999\r\n\r\n",
    );
    for i in 0..100 {
        body += &format!("--x\r\ncontent-disposition: form-data; name=\"images\"; filename=\"{i}.jpg\"\r\n\r\n{i}\r\n");
    }
    sender.write_all(body.as_bytes()).await.unwrap();
    let start = Instant::now();
    while files_below(&service.data_dir().join("datasets")).len() < 32 {
        assert!(start.elapsed() < Duration::from_secs(10));
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let after = Service::start_in(crash_image(&service), |_| {}).await;
    assert_eq!(after.get("/api/v1/datasets").await.ok(200)["datasets"], json!([]));
    for folder in ["datasets", "incoming"] {
        assert_eq!(files_below(&after.data_dir().join(folder)), [""; 0]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_data_directory_serves_one_process_at_a_time() {
    use std::sync::Arc;

    use multistage::config::ServerConfig;
    use multistage::http::Server;
    let service = Service::start().await;
    let config = ServerConfig::for_testing(service.data_dir());
    let second = Server::start(config, Arc::new(FakeEngine::default())).await;
    assert!(second.err().unwrap().to_string().contains("in use"));
    let form = photographs(["a.jpg"]);
    service.post_form("/api/v1/jobs", form).await.ok(202);
}

impl Program {
    async fn get(&self, path: &str) -> Value {
        let text = reqwest::get(format!("{}{path}", self.base)).await.unwrap().text().await.unwrap();
        serde_json::from_str(&text).unwrap_or_else(|error| panic!("{path}: {error}: {text}"))
    }

    /// Waits until the job fulfils a condition or is over.
    async fn wait(&self, link: &str, what: impl Fn(&Value) -> bool) -> Value {
        let start = Instant::now();
        loop {
            let job = self.get(link).await;
            let over = ["succeeded", "failed", "cancelled"].iter().any(|state| job["state"] == *state);
            if over || what(&job) {
                return job;
            }
            assert!(start.elapsed() < Duration::from_secs(600), "{job:#}");
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    }

    /// What the job made, with entity tags; the reports speak of times and are left out.
    async fn models(&self, link: &str) -> Vec<(String, String)> {
        let list = self.get(&format!("{link}/outputs")).await;
        let files = list["files"].as_array().unwrap().iter();
        let files =
            files.map(|file| (file["path"].as_str().unwrap().to_owned(), file["etag"].as_str().unwrap().to_owned()));
        files.filter(|(path, _)| !path.starts_with("report.")).collect()
    }
}

fn real_photographs() -> Option<Vec<(String, Vec<u8>)>> {
    let folder = PathBuf::from(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets/strecha-fountain-p11/images");
    let mut found: Vec<_> = std::fs::read_dir(&folder)
        .ok()?
        .map(|entry| entry.unwrap().path())
        .filter(|path| path.extension().is_some_and(|extension| extension == "jpg"))
        .map(|path| (path.file_name().unwrap().to_str().unwrap().to_owned(), std::fs::read(&path).unwrap()))
        .collect();
    found.sort();
    (found.len() >= 5).then_some(found)
}

async fn submit(program: &Program, photographs: &[(String, Vec<u8>)]) -> String {
    let options = json!({"intake": {"max_long_side_px": 3200}}).to_string();
    let form =
        photographs.iter().fold(reqwest::multipart::Form::new().text("options", options), |form, (name, bytes)| {
            form.part("images", file(name, bytes))
        });
    let request = reqwest::Client::new().post(format!("{}/api/v1/jobs", program.base)).multipart(form);
    let response = request.send().await.unwrap();
    assert_eq!(response.status().as_u16(), 202);
    response.headers()["location"].to_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn the_program_killed_again_and_again_makes_the_same_model() {
    let Some(photographs) = real_photographs() else {
        println!("SKIPPED: the photographs in ../shared/datasets are not there");
        return;
    };
    let undisturbed = tempfile::tempdir().unwrap();
    let program = Program::start(undisturbed.path());
    let link = submit(&program, &photographs).await;
    let job = program.wait(&link, |_| false).await;
    assert_eq!(job["state"], "succeeded", "{job:#}");
    let expected = program.models(&link).await;
    assert!(expected.iter().any(|(path, _)| path == "ply/0/points.ply"), "{expected:?}");
    drop(program);

    let folder = tempfile::tempdir().unwrap();
    let program = Program::start(folder.path());
    let link = submit(&program, &photographs).await;
    // Right after the acknowledgement.
    program.kill();
    let mut kills = 1;
    let stages = ["features", "coarse_match", "coarse_model", "add_cameras", "add_points", "refine", "export"];
    for at in 0..stages.len() {
        let start = Instant::now();
        let program = Program::start(folder.path());
        let ready = reqwest::get(format!("{}/readyz", program.base)).await.unwrap();
        assert!(ready.status().is_success() && start.elapsed() < Duration::from_secs(5), "{:?}", start.elapsed());
        // A short stage may be over before anybody looks; the next one does as well.
        let job = program.wait(&link, |job| stages[at..].iter().any(|stage| job["stage"]["name"] == *stage)).await;
        if job["state"] == "running" {
            kills += 1;
        }
        program.kill();
    }
    let program = Program::start(folder.path());
    let job = program.wait(&link, |_| false).await;
    assert_eq!(job["state"], "succeeded", "{job:#}");
    assert_eq!(program.models(&link).await, expected, "after {kills} kills");
    assert!(kills >= 3, "the stages went by too quickly to be interrupted");
    println!("killed {kills} times; ended with {}", job["stages"]);
    drop(program);
    let pool = sqlx::SqlitePool::connect(&format!("sqlite://{}", folder.path().join("multistage.db").display()))
        .await
        .unwrap();
    let verdict: String = sqlx::query_scalar("PRAGMA integrity_check").fetch_one(&pool).await.unwrap();
    assert_eq!(verdict, "ok");
}
