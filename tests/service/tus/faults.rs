//! Connections that end, are reset or stall at a random byte: every byte that reached the server is kept, none is wrong.

use std::time::{Duration, Instant};

use multistage::math::Rng;
use tokio::io::AsyncWriteExt;

use super::client::{Tus, pattern, status_of};

/// Waits until the server has counted so many bytes, which the broken request sent.
async fn settled(tus: &Tus, upload: &str, sent: u64) -> u64 {
    let start = Instant::now();
    loop {
        let offset = tus.head(upload).await.offset();
        if offset >= sent || start.elapsed() > Duration::from_secs(2) {
            return offset;
        }
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
}

#[derive(Clone, Copy, Debug)]
enum Fault {
    /// The sender closes the connection.
    Fin,
    /// The sender's system resets it.
    Rst,
    /// The sender falls silent and asks anew.
    Stall,
}

/// Breaks uploads until `breaks` connections broke, and finishes each; the photographs must be those that were sent.
async fn break_off(fault: Fault, breaks: usize, seed: u64) {
    const LENGTH: usize = 40_000;
    let tus = Tus::start().await;
    let bytes = pattern(LENGTH);
    let mut random = Rng::from_parts(&[seed]);
    let (mut broken, mut number) = (0, 0);
    while broken < breaks {
        let upload = tus.create(&[("upload-length", &LENGTH.to_string())]).await;
        let mut offset = 0usize;
        for _ in 0..4 {
            let sent = 1 + random.below(LENGTH - offset - 1);
            let mut stream = tus.begin_patch(&upload, offset as u64, LENGTH - offset, &[]).await;
            stream.write_all(&bytes[offset..offset + sent]).await.unwrap();
            stream.flush().await.unwrap();
            match fault {
                Fault::Fin => drop(stream),
                Fault::Rst => {
                    // A reset may overtake bytes on their way, so let them arrive.
                    tokio::time::sleep(Duration::from_millis(10)).await;
                    stream.set_zero_linger().unwrap();
                    drop(stream);
                }
                Fault::Stall => {
                    tokio::time::sleep(Duration::from_millis(10)).await;
                    let head = tus.head(&upload).await;
                    assert_eq!(head.offset(), (offset + sent) as u64, "{fault:?} of upload {number}");
                    assert!(status_of(&mut stream).await >= 400);
                }
            }
            broken += 1;
            let kept = settled(&tus, &upload, (offset + sent) as u64).await;
            assert_eq!(kept, (offset + sent) as u64, "{fault:?} of upload {number}: bytes were lost");
            offset += sent;
            if offset >= LENGTH - 2 {
                break;
            }
        }
        tus.patch(&upload, offset as u64, &bytes[offset..]).await.expect(204);
        if tus.own.is_some() {
            assert_eq!(tus.stored(&format!("picture-{number}.jpg")).unwrap(), bytes, "upload {number}");
        }
        number += 1;
    }
    println!("{broken} connections broken by {fault:?}, {number} photographs whole");
}

/// How many connections each test breaks; `MULTISTAGE_TUS_BREAKS` asks for more.
fn breaks() -> usize {
    std::env::var("MULTISTAGE_TUS_BREAKS").ok().and_then(|count| count.parse().ok()).unwrap_or(40)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_closed_connection_costs_no_byte() {
    break_off(Fault::Fin, breaks(), 1).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_reset_connection_costs_no_byte() {
    break_off(Fault::Rst, breaks(), 2).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stalled_connection_costs_no_byte() {
    break_off(Fault::Stall, breaks(), 3).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_sender_is_given_up_and_its_bytes_kept() {
    let tus = Tus::start_own(|config| config.upload_idle_timeout = Duration::from_millis(300)).await;
    let upload = tus.create(&[("upload-length", "100")]).await;
    let mut silent = tus.begin_patch(&upload, 0, 100, &[]).await;
    silent.write_all(&pattern(50)).await.unwrap();
    assert_eq!(status_of(&mut silent).await, 408);
    assert_eq!(tus.head(&upload).await.offset(), 50);
}
