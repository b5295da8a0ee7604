//! `/api/v1/jobs/{job_id}/events`

use std::time::Duration;

use serde_json::Value;

use crate::service::Service;

/// An event as it came over the line.
#[derive(Debug)]
struct Event {
    id: Option<i64>,
    kind: String,
    data: Value,
}

/// Reads a stream to its end and holds every event to the contract.
async fn read(service: &Service, link: &str, last: Option<i64>) -> Vec<Event> {
    let mut request = service.request("GET", link);
    if let Some(last) = last {
        request = request.header("last-event-id", last.to_string());
    }
    let response = tokio::time::timeout(Duration::from_secs(20), service.send(request)).await.expect("the stream ends");
    assert_eq!(response.header("content-type"), "text/event-stream");
    let mut events = Vec::new();
    for block in response.text().split("\n\n").filter(|block| !block.is_empty()) {
        let field = |name: &str| block.lines().find_map(|line| line.strip_prefix(name)).map(str::trim);
        let Some(kind) = field("event:") else {
            assert!(block.starts_with(':'), "{block}");
            continue;
        };
        let data: Value = serde_json::from_str(field("data:").expect("data")).expect("JSON");
        let schema = match kind {
            "state" => "StateEvent",
            "stage" => "StageProgress",
            "progress" => "ProgressEvent",
            other => panic!("unknown event {other}"),
        };
        service.contract.check_named(schema, &data);
        events.push(Event { id: field("id:").map(|id| id.parse().expect("a number")), kind: kind.to_owned(), data });
    }
    events
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_tells_everything_and_ends_with_the_job() {
    let service = Service::start().await;
    let job = service.job("hang").await;
    let link = job["links"]["events"].as_str().unwrap();
    let (events, ()) = tokio::join!(read(&service, link, None), async {
        service.wait_hanging(&job).await;
        // Long enough for a keep-alive comment.
        tokio::time::sleep(Duration::from_millis(500)).await;
        service.post(job["links"]["cancel"].as_str().unwrap()).await.ok(202);
    });
    let states: Vec<_> = events
        .iter()
        .filter(|event| event.kind == "state")
        .map(|event| event.data["state"].as_str().unwrap())
        .collect();
    assert_eq!(states, ["queued", "running", "cancelled"]);
    assert_eq!(events.last().unwrap().data["state"], "cancelled");
    assert!(events.iter().any(|event| event.kind == "progress" && event.data["stage"]["name"] == "coarse_match"));
    let ids: Vec<_> = events.iter().filter_map(|event| event.id).collect();
    assert_eq!(ids, (1..=ids.len() as i64).collect::<Vec<_>>());
    assert!(events.iter().all(|event| event.id.is_some() == (event.kind != "progress")));

    // Whoever comes back is told what is new, and stopped when nothing is.
    let last = *ids.last().unwrap();
    let replayed = read(&service, link, Some(2)).await;
    assert_eq!(replayed.iter().filter_map(|event| event.id).collect::<Vec<_>>(), (3..=last).collect::<Vec<_>>());
    let request = service.request("GET", link).header("last-event-id", last.to_string());
    service.send(request).await.ok(204);
    service.post(job["links"]["resume"].as_str().unwrap()).await.ok(202);
    service.wait_state(&job, "succeeded").await;
    let more = read(&service, link, Some(last)).await;
    assert_eq!((more[0].id, &more[0].data["state"]), (Some(last + 1), &Value::from("queued")));
    assert!(more.iter().any(|event| event.kind == "stage" && event.data["state"] == "reused"));
    assert_eq!(more.last().unwrap().data["state"], "succeeded");
}

#[tokio::test(flavor = "multi_thread")]
async fn streams_end_when_the_service_stops_or_the_job_goes() {
    let service = Service::start().await;
    let running = service.job("hang").await;
    service.wait_hanging(&running).await;
    let queued = service.job("quick").await;
    let link = |job: &Value, name: &str| job["links"][name].as_str().unwrap().to_owned();
    let events = link(&queued, "events");
    let (events, ()) = tokio::join!(read(&service, &events, None), async {
        tokio::time::sleep(Duration::from_millis(200)).await;
        service.delete(&link(&queued, "self")).await.ok(204);
    });
    assert_eq!(events.len(), 1);
    let stream = service.request("GET", &link(&running, "events")).send().await.unwrap();
    let folder = service.stop().await;
    assert!(stream.text().await.unwrap().contains("event: state"));

    // Stopped in good order, the job waits in the queue and goes on after the next start.
    let service = Service::start_in(folder, |_| {}).await;
    let done = service.wait_state(&running, "succeeded").await;
    assert_eq!(done["stages"][0]["state"], "reused");
    service.get("/api/v1/jobs/00000000-0000-7000-8000-000000000000/events").await.assert_problem(404, "job_not_found");
}
