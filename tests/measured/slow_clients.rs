//! Clients that are slow on purpose: heads and bodies that trickle in, answers that nobody reads, more connections than places.
//! They must be cut in the stated time, and everybody else must not notice.
//!
//! `MULTISTAGE_SLOW_CLIENTS=full cargo test --locked --test measured slow_clients -- --nocapture` does it at full size,
//! with the limits of the program: 1000 heads of one byte per 10 seconds and 200 bodies of one byte a second.

use std::net::SocketAddr;
use std::time::{Duration, Instant};

use multistage::config::ConnectionLimits;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::service::{Service, photographs};

/// What the attack may cost, its own end in the same process included.
const RSS_GROWTH_BYTES: u64 = 100 << 20;
/// After the time-out, for the timers and the closing of many connections on a busy machine.
const SLACK: Duration = Duration::from_secs(5);

struct Attack {
    heads: usize,
    head_pause: Duration,
    bodies: usize,
    body_pause: Duration,
    limits: ConnectionLimits,
    /// Answers of everybody else must come within this time, 99 of 100. In the suite, where other tests take their share of two
    /// cores, it tells starving alone.
    healthy_p99: Duration,
}

impl Attack {
    fn chosen() -> Self {
        if std::env::var("MULTISTAGE_SLOW_CLIENTS").is_ok_and(|size| size == "full") {
            let pause = Duration::from_secs(1);
            let limits = ConnectionLimits::default();
            let healthy_p99 = Duration::from_millis(250);
            return Self { heads: 1000, head_pause: 10 * pause, bodies: 200, body_pause: pause, limits, healthy_p99 };
        }
        let (pause, limit) = (Duration::from_millis(100), Duration::from_millis(1500));
        let limits =
            ConnectionLimits { header_timeout: limit, body_window: limit, write_stall: limit, ..Default::default() };
        let healthy_p99 = Duration::from_secs(2);
        Self { heads: 300, head_pause: pause, bodies: 100, body_pause: pause, limits, healthy_p99 }
    }
}

async fn start(limits: ConnectionLimits) -> (Service, SocketAddr) {
    let service = Service::start_in(tempfile::tempdir().unwrap(), |config| config.connections = limits).await;
    let address = service.server.as_ref().unwrap().address;
    (service, address)
}

/// Sends `start`, then a byte every `pause` until the connection is closed; how long it lived.
async fn trickle(address: SocketAddr, start: String, pause: Duration) -> Duration {
    let since = Instant::now();
    let (mut from, mut to) = TcpStream::connect(address).await.unwrap().into_split();
    let closed = tokio::spawn(async move {
        let mut answer = Vec::new();
        // A reset is as good as a close.
        let _ = from.read_to_end(&mut answer).await;
        since.elapsed()
    });
    let mut sent = to.write_all(start.as_bytes()).await;
    while sent.is_ok() && !closed.is_finished() {
        tokio::time::sleep(pause).await;
        sent = to.write_all(b"x").await;
    }
    closed.await.unwrap()
}

fn rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmRSS:")).unwrap();
    1024 * line.trim().trim_end_matches("kB").trim().parse::<u64>().unwrap()
}

/// The service answers others as ever while `trickles` last, and ends each in time.
#[tokio::test(flavor = "multi_thread")]
async fn slow_heads_and_bodies_are_cut_and_others_do_not_notice() {
    let _alone = crate::alone().await;
    let attack = Attack::chosen();
    let (service, address) = start(attack.limits).await;
    let dataset = service.post_json("/api/v1/datasets", &serde_json::json!({})).await.ok(201);
    let images = dataset["links"]["images"].as_str().unwrap();
    let client = reqwest::Client::new();
    let health = format!("{}/healthz", service.base);
    client.get(&health).send().await.unwrap();
    let rss_before = rss_bytes();

    // A body may trickle into any route that takes one.
    let bodies = [
        format!("POST {images} HTTP/1.1\r\nhost: x\r\ncontent-type: multipart/form-data; boundary=x\r\ncontent-length: 99999\r\n\r\n--x\r\n"),
        "POST /api/v1/jobs HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\ncontent-length: 9999\r\n\r\n{".to_owned(),
        "POST /api/v1/datasets HTTP/1.1\r\nhost: x\r\ncontent-type: application/json\r\ntransfer-encoding: chunked\r\n\r\n1".to_owned(),
    ];
    let head = "GET / HTTP/1.1\r\nhost: ";
    let heads = (0..attack.heads).map(|_| tokio::spawn(trickle(address, head.to_owned(), attack.head_pause)));
    let bodies = (0..attack.bodies)
        .map(|at| tokio::spawn(trickle(address, bodies[at % bodies.len()].clone(), attack.body_pause)));
    let trickles: Vec<_> = heads.chain(bodies).collect();
    let (mut answers, mut rss) = (Vec::new(), 0);
    while !trickles.iter().all(tokio::task::JoinHandle::is_finished) {
        // On a connection of its own, as another client would come.
        let start = Instant::now();
        let answer = reqwest::Client::new().get(&health).send().await.unwrap();
        assert!(answer.status().is_success());
        answers.push(start.elapsed());
        rss = rss.max(rss_bytes());
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    answers.sort();
    let p99 = answers[answers.len() * 99 / 100];
    let mut longest = Duration::ZERO;
    for lived in trickles {
        longest = longest.max(lived.await.unwrap());
    }
    let growth = rss.saturating_sub(rss_before);
    println!(
        "{} slow heads and {} slow bodies: all cut after {longest:.1?} at most; p99 of {} health checks {p99:.1?}; memory +{} MiB",
        attack.heads,
        attack.bodies,
        answers.len(),
        growth >> 20
    );
    let limit = attack.limits.header_timeout.max(attack.limits.body_window);
    assert!(longest < limit + SLACK, "cut after {longest:?}");
    assert!(p99 < attack.healthy_p99, "{p99:?}");
    assert!(growth < RSS_GROWTH_BYTES, "{growth} bytes");
}

#[tokio::test(flavor = "multi_thread")]
async fn idle_connections_go_and_event_streams_stay() {
    let _alone = crate::alone().await;
    let limits = ConnectionLimits { header_timeout: Duration::from_millis(500), ..Attack::chosen().limits };
    let (service, address) = start(limits).await;
    // New ones that never say a word, and old ones between two requests.
    for first in ["", "GET /healthz HTTP/1.1\r\nhost: x\r\n\r\n"] {
        let mut idle = TcpStream::connect(address).await.unwrap();
        idle.write_all(first.as_bytes()).await.unwrap();
        let since = Instant::now();
        let mut answer = Vec::new();
        idle.read_to_end(&mut answer).await.unwrap();
        assert_eq!(answer.starts_with(b"HTTP/1.1 200"), !first.is_empty());
        assert!((Duration::from_millis(400)..Duration::from_secs(8)).contains(&since.elapsed()));
    }
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let mut events =
        reqwest::get(format!("{}{}", service.base, job["links"]["events"].as_str().unwrap())).await.unwrap();
    let since = Instant::now();
    while since.elapsed() < 4 * limits.write_stall.max(limits.header_timeout) {
        assert!(events.chunk().await.unwrap().is_some(), "cut after {:?}", since.elapsed());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reader_that_takes_nothing_is_given_up() {
    let _alone = crate::alone().await;
    let (service, address) =
        start(ConnectionLimits { write_stall: Duration::from_millis(500), ..Default::default() }).await;
    let form = photographs(["a.jpg"]);
    let job = service.post_form("/api/v1/jobs", form).await.ok(202);
    let job = service.wait_state(&job, "succeeded").await;
    let path = format!("{}/ply/0/points.ply", job["links"]["outputs"].as_str().unwrap());
    // The answers fill every buffer on the way; nobody reads them.
    let mut sender = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nhost: x\r\n\r\n");
    let since = Instant::now();
    let refused = loop {
        match tokio::time::timeout(Duration::from_secs(10), sender.write_all(request.as_bytes())).await {
            Ok(Ok(())) => {}
            Ok(Err(_)) => break true,
            Err(_) => break false,
        }
    };
    assert!(refused, "still open after {:?}", since.elapsed());
}

#[tokio::test(flavor = "multi_thread")]
async fn when_all_places_are_taken_idle_connections_make_room() {
    let _alone = crate::alone().await;
    let limits = ConnectionLimits { max_connections: 20, ..Default::default() };
    let (service, address) = start(limits).await;
    let job = service.job("hang").await;
    service.wait_hanging(&job).await;
    let mut events =
        reqwest::get(format!("{}{}", service.base, job["links"]["events"].as_str().unwrap())).await.unwrap();
    let mut idle = Vec::new();
    for _ in 0..100 {
        idle.push(TcpStream::connect(address).await.unwrap());
    }
    let since = Instant::now();
    let answer = reqwest::Client::new().get(format!("{}/healthz", service.base)).send().await.unwrap();
    assert!(answer.status().is_success() && since.elapsed() < Attack::chosen().healthy_p99, "{:?}", since.elapsed());
    let mut closed = 0;
    for connection in &mut idle {
        let read = tokio::time::timeout(Duration::from_millis(20), connection.read(&mut [0; 8])).await;
        closed += usize::from(read.is_ok());
    }
    assert!((80..=90).contains(&closed), "{closed} of 100 made room");
    assert!(events.chunk().await.unwrap().is_some(), "a connection with a request stays");
}
