//! Over bad lines senders send again what arrived long ago. Every photograph of a set is sent three times, in random
//! order and several at once, while three of ten senders leave before they read the answer; and again until it was
//! acknowledged. The dataset must then hold the set, byte for byte, and nothing twice: through tus, as parts of forms,
//! and in archives.

use std::collections::BTreeMap;
use std::io::{Cursor, Write};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use futures_util::StreamExt;
use multistage::math::Rng;
use serde_json::{Value, json};
use sha2::Digest;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::program::Program;

/// Photographs of the set.
const FILES: usize = 24;
/// How often each is sent before anybody asks what was acknowledged.
const TIMES: usize = 3;
/// Of a hundred answers so many are not read.
const DROPPED_PERCENT: usize = 30;
/// Requests at once.
const AT_ONCE: usize = 6;

/// How photographs travel.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Way {
    /// One in one request of tus.
    Tus,
    /// Created by one request of tus, its bytes brought by another.
    TusInTwo,
    /// A part of a form.
    Form,
    /// In an archive, the next ones of the set beside it.
    Archive,
}

/// Sends a request; whether its answer was read, which must be a good one. A sender who drops it closes at once.
async fn send(address: &str, request: &[u8], dropped: bool) -> Option<String> {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(request).await.unwrap();
    if dropped {
        return None;
    }
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.unwrap();
    let answer = String::from_utf8_lossy(&answer).into_owned();
    let status = answer.split(' ').nth(1).unwrap_or("none");
    assert!(["200", "201", "204"].contains(&status), "{answer}");
    Some(answer)
}

fn request(method: &str, path: &str, headers: &str, body: &[u8]) -> Vec<u8> {
    let head = format!(
        "{method} {path} HTTP/1.1\r\nhost: x\r\nconnection: close\r\ncontent-length: {}\r\n{headers}\r\n",
        body.len()
    );
    [head.as_bytes(), body].concat()
}

fn form(path: &str, name: &str, file_name: &str, bytes: &[u8]) -> Vec<u8> {
    let mut body = format!(
        "--limit\r\ncontent-disposition: form-data; name=\"{name}\"; filename=\"{file_name}\"\r\ncontent-type: application/octet-stream\r\n\r\n"
    )
    .into_bytes();
    body.extend_from_slice(bytes);
    body.extend_from_slice(b"\r\n--limit--\r\n");
    request("POST", path, "content-type: multipart/form-data; boundary=limit\r\n", &body)
}

type Set = Vec<(String, Vec<u8>)>;

fn archive(files: &[(String, Vec<u8>)]) -> Vec<u8> {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

/// Sends the `number`th photograph once; whether that was acknowledged.
async fn send_one(address: &str, dataset: &str, set: &Set, number: usize, way: Way, dropped: [bool; 2]) -> bool {
    let (name, bytes) = &set[number];
    let images = format!("/api/v1/datasets/{dataset}/images");
    let metadata = format!("dataset {},path {}", BASE64_STANDARD.encode(dataset), BASE64_STANDARD.encode(name));
    let tus = "tus-resumable: 1.0.0\r\n";
    let create = format!("{tus}upload-length: {}\r\nupload-metadata: {metadata}\r\n", bytes.len());
    let bytes_follow = "content-type: application/offset+octet-stream\r\n";
    match way {
        Way::Tus => {
            let create = request("POST", "/api/v1/uploads", &(create + bytes_follow), bytes);
            send(address, &create, dropped[0]).await.is_some()
        }
        Way::TusInTwo => {
            let Some(made) = send(address, &request("POST", "/api/v1/uploads", &create, b""), dropped[0]).await else {
                return false;
            };
            let link = made.split("location: ").nth(1).unwrap().split("\r\n").next().unwrap();
            let patch = request("PATCH", link, &format!("{tus}{bytes_follow}upload-offset: 0\r\n"), bytes);
            send(address, &patch, dropped[1]).await.is_some()
        }
        Way::Form => send(address, &form(&images, "images", name, bytes), dropped[0]).await.is_some(),
        Way::Archive => {
            let zip = archive(&set[number..set.len().min(number + 3)]);
            send(address, &form(&images, "archive", "photographs.zip", &zip), dropped[0]).await.is_some()
        }
    }
}

fn sha256(bytes: &[u8]) -> String {
    sha2::Sha256::digest(bytes).iter().map(|byte| format!("{byte:02x}")).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn photographs_that_are_sent_again_and_again_are_stored_once() {
    let folder = tempfile::tempdir().unwrap();
    let program = Program::start(folder.path());
    let address = program.base.strip_prefix("http://").unwrap();
    let http = reqwest::Client::new();
    let mut random = Rng::from_parts(&[3]);
    for way in [Way::Tus, Way::TusInTwo, Way::Form, Way::Archive] {
        let set: Set = (0..FILES)
            .map(|number| {
                let bytes = (0..2000 + random.below(60_000)).map(|_| random.below(256) as u8).collect();
                (format!("{}/{number}.jpg", number % 3), bytes)
            })
            .collect();
        let made = http.post(format!("{}/api/v1/datasets", program.base)).json(&json!({})).send().await.unwrap();
        let dataset = made.json::<Value>().await.unwrap()["id"].as_str().unwrap().to_owned();
        let mut open: Vec<usize> = (0..FILES).flat_map(|number| [number; TIMES]).collect();
        let mut acknowledged = [0; FILES];
        let (mut sent, mut dropped) = (0, 0);
        while !open.is_empty() {
            random.shuffle(&mut open);
            let sends: Vec<_> =
                open.into_iter().map(|number| (number, [0; 2].map(|_| random.below(100) < DROPPED_PERCENT))).collect();
            sent += sends.len();
            let (dataset, set) = (&dataset, &set);
            let sends = futures_util::stream::iter(sends).map(|(number, drops)| async move {
                (number, send_one(address, dataset, set, number, way, drops).await)
            });
            for (number, heard) in sends.buffer_unordered(AT_ONCE).collect::<Vec<_>>().await {
                acknowledged[number] += usize::from(heard);
                dropped += usize::from(!heard);
            }
            open = (0..FILES).filter(|number| acknowledged[*number] == 0).collect();
        }
        assert!(dropped > sent / 10, "{dropped} of {sent}");
        let link = format!("{}/api/v1/datasets/{dataset}/images?limit=1000", program.base);
        let images: Value = http.get(link).send().await.unwrap().json().await.unwrap();
        let images = images["images"].as_array().unwrap();
        let listed: BTreeMap<_, _> =
            images.iter().map(|image| (image["path"].as_str(), image["sha256"].as_str())).collect();
        let hashes: Vec<_> = set.iter().map(|(name, bytes)| (name, sha256(bytes))).collect();
        let expected: BTreeMap<_, _> =
            hashes.iter().map(|(name, hash)| (Some(name.as_str()), Some(hash.as_str()))).collect();
        assert_eq!((listed, images.len()), (expected, FILES), "{way:?}");
        for (name, bytes) in &set {
            let file = folder.path().join("datasets").join(&dataset).join("images").join(name);
            assert!(std::fs::read(file).unwrap() == *bytes, "{way:?} {name}");
        }
        println!("{way:?}: {FILES} photographs sent {sent} times, {dropped} answers not heard: each stored once");
    }
    drop(program);
    let mut doctor = std::process::Command::new(env!("CARGO_BIN_EXE_multistage"));
    let doctor = doctor.args(["doctor", "--bytes", "--data-dir"]).arg(folder.path()).output().unwrap();
    assert_eq!(String::from_utf8_lossy(&doctor.stdout), "all is well\n");
}
