//! Jobs that do not fit into memory or, as far as was foreseen, onto the disk.

use std::sync::atomic::Ordering;

use multistage::pipeline::Needs;
use serde_json::{Value, json};

use crate::service::Service;

const MB: u64 = 1_000_000;

async fn start(needs: Needs, memory_bytes: u64) -> Service {
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
        config.memory_bytes = Some(memory_bytes);
        config.threads = 4;
    })
    .await;
    *service.engine.needs.lock().unwrap() = needs;
    service
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_gets_as_many_threads_as_memory_allows_and_says_so() {
    let needs = Needs { images: 3, disk_bytes: 5, shared_memory_bytes: 40 * MB, thread_memory_bytes: 20 * MB };
    let service = start(needs, 90 * MB).await;
    let job = service.job("quick").await;
    assert_eq!(job["resources"], Value::Null);
    let job = service.wait_state(&job, "succeeded").await;
    let given = &job["resources"];
    assert_eq!((&given["threads"], &given["memory_bytes"]), (&json!(2), &json!(80 * MB)), "{given}");
    assert_eq!(given["disk_bytes"], 5);
    assert!(given["note"].as_str().unwrap().starts_with("2 of 4 threads"), "{given}");

    *service.engine.needs.lock().unwrap() = Needs { shared_memory_bytes: 80 * MB, ..needs };
    let job = service.job("quick").await;
    let job = service.wait_state(&job, "failed").await;
    assert_eq!(job["error"]["code"], "not_enough_memory");
    assert!(job["error"]["message"].as_str().unwrap().contains("100 MB"), "{}", job["error"]);
    assert_eq!(service.engine.runs.load(Ordering::SeqCst), 1, "it was never started");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_waits_for_room_that_others_have_or_that_is_not_there() {
    let needs = Needs { images: 3, disk_bytes: 5, shared_memory_bytes: 60 * MB, thread_memory_bytes: MB };
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| {
        config.memory_bytes = Some(100 * MB);
        config.parallel_jobs = 2;
    })
    .await;
    *service.engine.needs.lock().unwrap() = needs;
    let first = service.job("hang").await;
    service.wait_hanging(&first).await;
    let second = service.job("quick").await;
    let held = service.wait(&second, |job| job["queue"]["held"] == "memory").await;
    assert_eq!((&held["state"], &held["queue"]["starts_in_s"]), (&json!("queued"), &Value::Null));
    service.post(first["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&second, "succeeded").await;

    // More than any disk has; smaller jobs behind it need not wait.
    *service.engine.needs.lock().unwrap() = Needs { disk_bytes: 1 << 60, ..needs };
    let large = service.job("quick").await;
    service.wait(&large, |job| job["queue"]["held"] == "disk_full").await;
    *service.engine.needs.lock().unwrap() = needs;
    let small = service.job("quick").await;
    service.wait_state(&small, "succeeded").await;
    assert_eq!(service.get(large["links"]["self"].as_str().unwrap()).await.ok(200)["state"], "queued");
    service.post(large["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&large, "cancelled").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_that_found_the_disk_full_goes_on_by_itself_or_fails_for_that_reason() {
    let service = Service::start().await;
    service.engine.full.store(2, Ordering::SeqCst);
    let job = service.job("disk_full").await;
    service.wait(&job, |job| job["queue"]["held"] == "disk_full").await;
    let job = service.wait_state(&job, "succeeded").await;
    assert_eq!(job["stages"][0]["state"], "reused", "{job:#}");
    assert_eq!(service.engine.runs.load(Ordering::SeqCst), 3);
    service.engine.full.store(100, Ordering::SeqCst);
    let job = service.job("disk_full").await;
    let job = service.wait_state(&job, "failed").await;
    assert_eq!((&job["error"]["code"], &job["error"]["stage"]), (&json!("disk_full"), &json!("coarse_match")));
}
