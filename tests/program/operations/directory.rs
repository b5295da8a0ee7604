//! `multistage doctor` and `multistage backup`.

use std::path::Path;
use std::process::Command;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};

use multistage::store::{DataDir, Db, examine};
use serde_json::json;

use crate::service::{Service, files_below, photographs};

/// Runs a command on a data directory; its exit status and what it printed.
fn run(command: &str, data_dir: &Path, arguments: &[&str]) -> (i32, String) {
    let mut multistage = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let output = multistage.arg(command).arg("--data-dir").arg(data_dir).args(arguments).output().unwrap();
    let said = [output.stdout, output.stderr].concat();
    (output.status.code().unwrap(), String::from_utf8(said).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn the_doctor_finds_what_is_missing_damaged_or_nobodys_and_deletes_nothing() {
    let service = Service::start().await;
    let job = service.job("quick").await;
    service.wait_state(&job, "succeeded").await;
    let (status, said) = run("doctor", service.data_dir(), &["--bytes"]);
    assert_eq!((status, said.as_str()), (0, "all is well\n"), "while the service runs");
    assert_eq!(run("doctor", service.data_dir(), &["--quarantine"]).0, 1, "the service runs");

    let folder = service.stop().await;
    let images = folder.path().join("datasets").join(job["dataset_id"].as_str().unwrap()).join("images");
    let out = folder.path().join("jobs").join(job["id"].as_str().unwrap()).join("out");
    std::fs::remove_file(images.join("a.jpg")).unwrap();
    std::fs::write(images.join("b.jpg"), b"B.jpg").unwrap();
    std::fs::write(out.join("report.html"), b"x").unwrap();
    std::fs::write(images.join("sub/stray.jpg"), b"stray").unwrap();
    let nobodys = folder.path().join("jobs/01999999-0000-7000-8000-000000000000/out");
    std::fs::create_dir_all(&nobodys).unwrap();
    std::fs::write(nobodys.join("model.ply"), b"precious").unwrap();

    let (status, said) = run("doctor", folder.path(), &[]);
    assert_eq!(status, 1);
    let found = |kind: &str, end: &str| {
        said.lines()
            .any(|line| line.split('\t').next() == Some(kind) && line.split('\t').nth(1).unwrap().ends_with(end))
    };
    assert!(found("missing", "images/a.jpg") && found("damaged", "out/report.html"), "{said}");
    assert!(found("orphan", "sub/stray.jpg") && found("orphan", "jobs/01999999-0000-7000-8000-000000000000"), "{said}");
    assert!(!said.contains("b.jpg"), "the length is right: {said}");
    let (_, said) = run("doctor", folder.path(), &["--bytes"]);
    assert!(said.contains("damaged") && said.contains("images/b.jpg"), "{said}");

    let before = files_below(folder.path()).len();
    run("doctor", folder.path(), &["--quarantine"]);
    let after = files_below(folder.path());
    assert_eq!(after.iter().filter(|path| path.starts_with("quarantine/")).count(), 2, "{after:?}");
    assert!(after.iter().any(|path| path.ends_with("out/model.ply")));
    assert_eq!(before, after.len());
    assert!(!run("doctor", folder.path(), &[]).1.contains("orphan"));
    // The service leaves it there for a week.
    let service = Service::start_in(folder, |_| {}).await;
    tokio::time::sleep(std::time::Duration::from_millis(300)).await;
    let folder = service.stop().await;
    let mut places: Vec<_> = std::fs::read_dir(folder.path().join("quarantine")).unwrap().map(|e| e.unwrap()).collect();
    assert_eq!(places.len(), 2);
    let old = places.pop().unwrap();
    let name = old.file_name().into_string().unwrap();
    let (since, rest) = name.split_once('-').unwrap();
    let since = since.parse::<i64>().unwrap() - 8 * 86_400_000;
    std::fs::rename(old.path(), old.path().with_file_name(format!("{since}-{rest}"))).unwrap();
    let service = Service::start_in(folder, |_| {}).await;
    let start = std::time::Instant::now();
    while std::fs::read_dir(service.data_dir().join("quarantine")).unwrap().count() > 1 {
        assert!(start.elapsed() < std::time::Duration::from_secs(10));
        tokio::time::sleep(std::time::Duration::from_millis(20)).await;
    }
}

/// Copies taken while clients upload, run jobs and delete are whole, and serve.
#[tokio::test(flavor = "multi_thread")]
async fn a_copy_of_a_live_service_is_whole_and_serves() {
    let service = Arc::new(Service::start().await);
    let kept = service.job("quick").await;
    service.wait_state(&kept, "succeeded").await;
    let etag = |outputs: &serde_json::Value| outputs["files"][0]["etag"].clone();
    let expected = etag(&service.get(kept["links"]["outputs"].as_str().unwrap()).await.ok(200));
    let stop = Arc::new(AtomicBool::new(false));
    let clients: Vec<_> = (0..3)
        .map(|_| {
            let (service, stop) = (Arc::clone(&service), Arc::clone(&stop));
            tokio::spawn(async move {
                let mut rounds = 0;
                while !stop.load(Ordering::SeqCst) {
                    let dataset = service.post_json("/api/v1/datasets", &json!({})).await.ok(201);
                    let link = dataset["links"]["self"].as_str().unwrap();
                    let names: Vec<String> = (0..40).map(|n| format!("{n}.jpg")).collect();
                    let form = photographs(names.iter().map(String::as_str));
                    service.post_form(dataset["links"]["images"].as_str().unwrap(), form).await.ok(200);
                    let job = service.post_json("/api/v1/jobs", &json!({"dataset_id": dataset["id"]})).await.ok(202);
                    service.wait_state(&job, "succeeded").await;
                    service.delete(job["links"]["self"].as_str().unwrap()).await.ok(204);
                    service.delete(link).await.ok(204);
                    rounds += 1;
                }
                rounds
            })
        })
        .collect();
    let copy = tempfile::tempdir().unwrap();
    for round in 0..8 {
        let target = copy.path().to_str().unwrap().to_owned();
        let data_dir = service.data_dir().to_path_buf();
        let (status, said) =
            tokio::task::spawn_blocking(move || run("backup", &data_dir, &["--to", &target])).await.unwrap();
        assert_eq!(status, 0, "round {round}: {said}");
        let db = Db::open(&DataDir::database_in(copy.path())).await.unwrap();
        let findings = examine(&db, copy.path(), true).await.unwrap();
        db.close().await;
        // Files of earlier copies stay where they are.
        let wrong: Vec<_> = findings.iter().filter(|finding| !format!("{finding:?}").starts_with("Orphan")).collect();
        assert!(wrong.is_empty(), "round {round}: {wrong:?}");
    }
    stop.store(true, Ordering::SeqCst);
    let mut rounds = 0;
    for client in clients {
        rounds += client.await.unwrap();
    }
    assert!(rounds > 3, "nothing went on meanwhile");
    let restored = Service::start_in(copy, |_| {}).await;
    let job = restored.get(kept["links"]["self"].as_str().unwrap()).await.ok(200);
    assert_eq!(job["state"], "succeeded");
    let outputs = restored.get(kept["links"]["outputs"].as_str().unwrap()).await.ok(200);
    assert_eq!(etag(&outputs), expected);
    let file = restored.get(outputs["files"][0]["links"]["self"].as_str().unwrap()).await;
    assert_eq!(file.body.len(), outputs["files"][0]["size_bytes"].as_u64().unwrap() as usize);
}
