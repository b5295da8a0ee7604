//! The suite's own client: requests with the headers one by one, and a raw connection for what a library would not send.

use std::sync::atomic::{AtomicUsize, Ordering};

use base64::Engine;
use base64::prelude::BASE64_STANDARD;
use multistage::config::ServerConfig;
use reqwest::{Method, Response};
use serde_json::json;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::service::Service;

/// Headers of a request.
pub type Headers<'a> = &'a [(&'a str, &'a str)];

pub const BYTES: (&str, &str) = ("content-type", "application/offset+octet-stream");

/// An upload resource.
pub struct Tus {
    /// Where uploads are made.
    pub endpoint: String,
    /// Ours, with the dataset that uploads go to.
    pub own: Option<(Service, String)>,
    http: reqwest::Client,
    made: AtomicUsize,
}

/// An answer.
#[derive(Debug)]
pub struct Answer {
    pub status: u16,
    pub headers: reqwest::header::HeaderMap,
    pub body: Vec<u8>,
}

impl Answer {
    pub fn header(&self, name: &str) -> Option<&str> {
        self.headers.get(name).map(|value| value.to_str().unwrap())
    }

    #[track_caller]
    pub fn offset(&self) -> u64 {
        self.header("upload-offset").unwrap_or_else(|| panic!("no offset: {self:?}")).parse().unwrap()
    }

    #[track_caller]
    pub fn expect(self, status: u16) -> Self {
        assert_eq!(self.status, status, "{:?} {}", self.headers, String::from_utf8_lossy(&self.body));
        self
    }

    #[track_caller]
    pub fn expect_one_of(self, statuses: &[u16]) -> Self {
        assert!(statuses.contains(&self.status), "{} {:?}", self.status, self.headers);
        self
    }
}

impl Tus {
    pub async fn start() -> Self {
        match std::env::var("MULTISTAGE_TUS_ENDPOINT") {
            Ok(endpoint) => Self { endpoint, own: None, http: reqwest::Client::new(), made: AtomicUsize::new(0) },
            Err(_) => Self::start_own(|_| {}).await,
        }
    }

    pub async fn start_own(change: impl FnOnce(&mut ServerConfig)) -> Self {
        let service = Service::start_in(tempfile::tempdir().unwrap(), change).await;
        Self::over(service).await
    }

    pub async fn over(service: Service) -> Self {
        let dataset = service.post_json("/api/v1/datasets", &json!({"name": "tus"})).await.ok(201);
        let id = dataset["id"].as_str().unwrap().to_owned();
        let endpoint = format!("{}/api/v1/uploads", service.base);
        Self { endpoint, own: Some((service, id)), http: reqwest::Client::new(), made: AtomicUsize::new(0) }
    }

    /// The metadata of a photograph with this name.
    pub fn metadata(&self, path: &str) -> String {
        let dataset = self.own.as_ref().map_or("none", |(_, dataset)| dataset);
        format!("dataset {},path {}", BASE64_STANDARD.encode(dataset), BASE64_STANDARD.encode(path))
    }

    /// Metadata with a name no upload had before.
    pub fn fresh_metadata(&self) -> String {
        self.metadata(&format!("picture-{}.jpg", self.made.fetch_add(1, Ordering::Relaxed)))
    }

    /// Sends exactly these headers, and the version unless one is among them.
    pub async fn send(&self, method: &str, address: &str, headers: Headers<'_>, body: Option<&[u8]>) -> Answer {
        let mut request = self.http.request(Method::from_bytes(method.as_bytes()).unwrap(), address);
        if !headers.iter().any(|(name, _)| *name == "tus-resumable") {
            request = request.header("tus-resumable", "1.0.0");
        }
        for (name, value) in headers.iter().filter(|(_, value)| !value.is_empty()) {
            request = request.header(*name, *value);
        }
        if let Some(body) = body {
            request = request.body(body.to_vec());
        }
        let response: Response = request.send().await.unwrap();
        let (status, headers) = (response.status().as_u16(), response.headers().clone());
        Answer { status, headers, body: response.bytes().await.unwrap().to_vec() }
    }

    pub async fn post(&self, headers: Headers<'_>, body: Option<&[u8]>) -> Answer {
        if headers.iter().any(|(name, _)| *name == "upload-metadata") {
            return self.send("POST", &self.endpoint, headers, body).await;
        }
        let metadata = self.fresh_metadata();
        let mut all = vec![("upload-metadata", metadata.as_str())];
        all.extend_from_slice(headers);
        self.send("POST", &self.endpoint, &all, body).await
    }

    /// Makes an upload and gives its address.
    pub async fn create(&self, headers: Headers<'_>) -> String {
        let answer = self.post(headers, None).await.expect(201);
        self.address(&answer)
    }

    pub fn address(&self, answer: &Answer) -> String {
        let location = answer.header("location").expect("a location");
        reqwest::Url::parse(&self.endpoint).unwrap().join(location).unwrap().to_string()
    }

    pub async fn head(&self, upload: &str) -> Answer {
        self.send("HEAD", upload, &[], None).await
    }

    pub async fn patch(&self, upload: &str, offset: u64, body: &[u8]) -> Answer {
        self.patch_with(upload, offset, &[], body).await
    }

    pub async fn patch_with(&self, upload: &str, offset: u64, headers: Headers<'_>, body: &[u8]) -> Answer {
        let offset = offset.to_string();
        let mut all = vec![BYTES, ("upload-offset", offset.as_str())];
        all.extend_from_slice(headers);
        self.send("PATCH", upload, &all, Some(body)).await
    }

    /// Starts a PATCH of `length` bytes by hand, with nothing of its body sent yet.
    pub async fn begin_patch(&self, upload: &str, offset: u64, length: usize, headers: Headers<'_>) -> TcpStream {
        let offset = offset.to_string();
        let mut all = vec![("upload-offset", offset.as_str())];
        all.extend_from_slice(headers);
        self.begin("PATCH", upload, length, &all).await
    }

    /// The same for a POST that makes an upload of these bytes.
    pub async fn begin_post(&self, length: usize) -> TcpStream {
        let (metadata, bytes) = (self.fresh_metadata(), length.to_string());
        self.begin("POST", &self.endpoint, length, &[("upload-metadata", &metadata), ("upload-length", &bytes)]).await
    }

    async fn begin(&self, method: &str, address: &str, length: usize, headers: Headers<'_>) -> TcpStream {
        let url = reqwest::Url::parse(address).unwrap();
        let host = format!("{}:{}", url.host_str().unwrap(), url.port_or_known_default().unwrap());
        let mut stream = TcpStream::connect(&host).await.unwrap();
        let more: String = headers.iter().map(|(name, value)| format!("{name}: {value}\r\n")).collect();
        let head = format!(
            "{method} {} HTTP/1.1\r\nhost: {host}\r\ntus-resumable: 1.0.0\r\ncontent-type: application/offset+octet-stream\r\n\
             content-length: {length}\r\n{more}\r\n",
            url.path()
        );
        stream.write_all(head.as_bytes()).await.unwrap();
        stream
    }

    /// The bytes of a stored photograph of ours.
    pub fn stored(&self, path: &str) -> Option<Vec<u8>> {
        let (service, dataset) = self.own.as_ref().expect("ours");
        std::fs::read(service.data_dir().join("datasets").join(dataset).join("images").join(path)).ok()
    }
}

/// Reads an answer's status off a raw connection.
pub async fn status_of(stream: &mut TcpStream) -> u16 {
    let mut head = vec![0; 64];
    let read = stream.read(&mut head).await.unwrap();
    let head = String::from_utf8_lossy(&head[..read]).into_owned();
    head.split(' ').nth(1).unwrap_or_else(|| panic!("no answer: {head:?}")).parse().unwrap()
}

/// Bytes that differ from place to place.
pub fn pattern(length: usize) -> Vec<u8> {
    (0..length as u64).map(|at| (at.wrapping_mul(0x9e37_79b9_7f4a_7c15) >> 56) as u8).collect()
}
