//! Offsets that do not fit, and requests that meet.

use std::time::{Duration, Instant};

use tokio::io::AsyncWriteExt;

use super::client::{BYTES, Tus, pattern, status_of};

#[tokio::test(flavor = "multi_thread")]
async fn an_offset_that_is_behind_or_ahead_is_409() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    tus.patch(&upload, 0, b"12345").await.expect(204);
    for offset in [0, 4, 6, 10, u64::MAX] {
        tus.patch(&upload, offset, b"x").await.expect(409);
    }
    assert_eq!(tus.head(&upload).await.offset(), 5);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_offset_that_is_no_number_is_400() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    for offset in ["-1", "x", "1.0", "0x1", "+0"] {
        tus.send("PATCH", &upload, &[BYTES, ("upload-offset", offset)], Some(b"x")).await.expect(400);
    }
    tus.send("PATCH", &upload, &[BYTES], Some(b"x")).await.expect(400);
    assert_eq!(tus.head(&upload).await.offset(), 0);
}

#[tokio::test(flavor = "multi_thread")]
async fn of_two_patches_at_once_exactly_one_is_taken() {
    let tus = Tus::start().await;
    for _ in 0..10 {
        let upload = tus.create(&[("upload-length", "400000")]).await;
        let (one, other) = (vec![1; 200_000], vec![2; 200_000]);
        let (one, other) = tokio::join!(tus.patch(&upload, 0, &one), tus.patch(&upload, 0, &other));
        let mut statuses = [one.status, other.status];
        statuses.sort_unstable();
        assert!(statuses[0] == 204 && [409, 423].contains(&statuses[1]), "{statuses:?}");
        assert_eq!(tus.head(&upload).await.offset(), 200_000);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_patch_beside_a_running_one_is_refused() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "100")]).await;
    let mut running = tus.begin_patch(&upload, 0, 100, &[]).await;
    running.write_all(&pattern(10)).await.unwrap();
    tokio::time::sleep(Duration::from_millis(100)).await;
    tus.patch(&upload, 0, b"x").await.expect_one_of(&[409, 423]);
    running.write_all(&pattern(90)).await.unwrap();
    assert_eq!(status_of(&mut running).await, 204);
}

#[tokio::test(flavor = "multi_thread")]
async fn head_during_a_patch_answers_within_a_second_and_ends_it() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "100000")]).await;
    let mut stale = tus.begin_patch(&upload, 0, 100_000, &[]).await;
    stale.write_all(&pattern(60_000)).await.unwrap();
    tokio::time::sleep(Duration::from_millis(200)).await;
    let start = Instant::now();
    let answer = tus.head(&upload).await.expect_one_of(&[200, 204]);
    assert!(start.elapsed() < Duration::from_secs(1), "{:?}", start.elapsed());
    assert_eq!(answer.offset(), 60_000, "every byte that came is kept");
    assert!(status_of(&mut stale).await >= 400);
    tus.patch(&upload, 60_000, &[7; 40_000]).await.expect(204);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_a_stale_patch_sends_later_is_not_taken() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "20")]).await;
    let mut stale = tus.begin_patch(&upload, 0, 20, &[]).await;
    stale.write_all(b"0123456789").await.unwrap();
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(tus.head(&upload).await.offset(), 10);
    // The connection may be closed by now.
    let _ = stale.write_all(b"xxxxxxxxxx").await;
    tokio::time::sleep(Duration::from_millis(100)).await;
    assert_eq!(tus.head(&upload).await.offset(), 10);
    tus.patch(&upload, 10, b"abcdefghij").await.expect(204);
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"0123456789abcdefghij");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn two_heads_at_once_both_answer() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "10")]).await;
    let (one, other) = tokio::join!(tus.head(&upload), tus.head(&upload));
    assert_eq!((one.offset(), other.offset()), (0, 0));
}

#[tokio::test(flavor = "multi_thread")]
async fn delete_during_a_patch_ends_it() {
    let tus = Tus::start().await;
    let upload = tus.create(&[("upload-length", "100")]).await;
    let mut stale = tus.begin_patch(&upload, 0, 100, &[]).await;
    stale.write_all(&pattern(10)).await.unwrap();
    tokio::time::sleep(Duration::from_millis(100)).await;
    tus.send("DELETE", &upload, &[], None).await.expect(204);
    tus.head(&upload).await.expect_one_of(&[404, 410]);
}
