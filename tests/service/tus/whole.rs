//! Photographs that come whole with the creation: ours keeps them in memory until they are there, as long as there is room.

use std::time::{Duration, Instant};

use serde_json::json;
use tokio::io::AsyncWriteExt;

use super::client::{BYTES, Tus, pattern, status_of};
use crate::service::files_below;

#[tokio::test(flavor = "multi_thread")]
async fn a_whole_photograph_is_stored_once_and_another_of_its_name_is_a_conflict() {
    let tus = Tus::start_own(|_| {}).await;
    let (service, dataset) = tus.own.as_ref().unwrap();
    let metadata = tus.metadata("sub/a.jpg");
    let post = async |bytes: &[u8]| {
        let length = bytes.len().to_string();
        tus.post(&[("upload-length", &length), ("upload-metadata", &metadata), BYTES], Some(bytes)).await
    };
    // What a crash left there without a row makes room.
    let folder = service.data_dir().join("datasets").join(dataset).join("images/sub");
    std::fs::create_dir_all(&folder).unwrap();
    std::fs::write(folder.join("a.jpg"), b"half").unwrap();
    let bytes = pattern(100_000);
    for _ in 0..2 {
        let upload = tus.address(&post(&bytes).await.expect(201));
        let head = tus.head(&upload).await.expect(200);
        assert_eq!((head.offset(), head.header("upload-length")), (100_000, Some("100000")));
        assert_eq!(tus.stored("sub/a.jpg").unwrap(), bytes);
    }
    let mut other = bytes.clone();
    other[99_999] ^= 1;
    post(&other).await.expect(422);
    post(&other[1..]).await.expect(422);
    assert_eq!(tus.stored("sub/a.jpg").unwrap(), bytes);
    // Nor may a photograph be a folder, or lie below one.
    let below = tus.metadata("sub/a.jpg/b.jpg");
    tus.post(&[("upload-length", "5"), ("upload-metadata", &below), BYTES], Some(b"hello")).await.expect(422);
    let above = tus.metadata("sub.jpg");
    std::fs::create_dir(folder.with_file_name("sub.jpg")).unwrap();
    tus.post(&[("upload-length", "5"), ("upload-metadata", &above), BYTES], Some(b"hello")).await.expect(422);
    let images = service.get(&format!("/api/v1/datasets/{dataset}/images")).await.ok(200);
    assert_eq!(images["images"].as_array().unwrap().len(), 1, "{images}");
    assert_eq!(files_below(&service.data_dir().join("incoming")), [""; 0]);
    assert_eq!(files_below(&service.data_dir().join("uploads")), [""; 0]);
    // Of several at once with different bytes one wins.
    let metadata = tus.metadata("b.jpg");
    let headers = [("upload-length", "3"), ("upload-metadata", metadata.as_str()), BYTES];
    let bytes: Vec<[u8; 3]> = (0..8).map(|number| [number; 3]).collect();
    let answers = futures_util::future::join_all(bytes.iter().map(|bytes| tus.post(&headers, Some(bytes)))).await;
    let won: Vec<usize> = (0..8).filter(|number| answers[*number].status == 201).collect();
    assert!(won.len() == 1 && answers.iter().filter(|answer| answer.status == 422).count() == 7, "{answers:?}");
    assert_eq!(tus.stored("b.jpg").unwrap(), bytes[won[0]]);
    let job = service.post_json("/api/v1/jobs", &json!({ "dataset_id": dataset })).await.ok(202);
    service.wait_state(&job, "succeeded").await;
}

#[tokio::test(flavor = "multi_thread")]
async fn without_room_in_memory_photographs_are_written_as_they_come() {
    const LENGTH: usize = 120_000;
    let tus = Tus::start_own(|config| config.uploads.memory_bytes = 200_000).await;
    let written = || files_below(&tus.own.as_ref().unwrap().0.data_dir().join("uploads")).len();
    let bytes = pattern(LENGTH);
    let half = async || {
        let mut stream = tus.begin_post(LENGTH).await;
        stream.write_all(&bytes[..LENGTH / 2]).await.unwrap();
        stream.flush().await.unwrap();
        stream
    };
    let mut first = half().await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(written(), 0, "the first waits in memory");
    let mut second = half().await;
    let start = Instant::now();
    while written() == 0 {
        assert!(start.elapsed() < Duration::from_secs(5), "the second has no room there");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    for stream in [&mut second, &mut first] {
        stream.write_all(&bytes[LENGTH / 2..]).await.unwrap();
        assert_eq!(status_of(stream).await, 201);
    }
    for name in ["picture-0.jpg", "picture-1.jpg"] {
        assert_eq!(tus.stored(name).unwrap(), bytes);
    }
    // Whoever breaks off gives the room back.
    let start = Instant::now();
    while written() > 0 {
        assert!(start.elapsed() < Duration::from_secs(5), "the file of the second goes");
        tokio::time::sleep(Duration::from_millis(5)).await;
    }
    drop(half().await);
    tokio::time::sleep(Duration::from_millis(200)).await;
    let _third = half().await;
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert_eq!(written(), 0, "the third waits in memory");
}
