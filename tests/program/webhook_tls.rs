//! Webhooks over TLS: the real program tells an https receiver whose authority it was told to trust (`--webhook-ca`),
//! and nothing to one whose certificate is of an unknown authority or of another host.

use std::net::SocketAddr;
use std::path::Path;
use std::sync::{Arc, Mutex};
use std::time::{Duration, Instant};

use rcgen::{BasicConstraints, CertificateParams, CertifiedIssuer, DnType, IsCa, KeyPair};
use reqwest::multipart::{Form, Part};
use serde_json::{Value, json};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpListener;
use tokio_rustls::TlsAcceptor;
use tokio_rustls::rustls::{self, ServerConfig};

use crate::program::Program;

const SECRET: &str = "a secret of enough letters";

/// An authority of the test's own.
fn authority(name: &str) -> CertifiedIssuer<'static, KeyPair> {
    let mut params = CertificateParams::new(Vec::new()).unwrap();
    params.distinguished_name.push(DnType::OrganizationName, name);
    params.is_ca = IsCa::Ca(BasicConstraints::Unconstrained);
    CertifiedIssuer::self_signed(params, KeyPair::generate().unwrap()).unwrap()
}

/// Requests that an https receiver got, whole.
type Heard = Arc<Mutex<Vec<String>>>;

/// Listens with a certificate of this authority for that host, and answers every request with 204.
async fn receiver(authority: &CertifiedIssuer<'static, KeyPair>, host: &str) -> (SocketAddr, Heard) {
    let key = KeyPair::generate().unwrap();
    let certificate = CertificateParams::new(vec![host.to_owned()]).unwrap().signed_by(&key, authority).unwrap();
    let config = ServerConfig::builder_with_provider(Arc::new(rustls::crypto::ring::default_provider()))
        .with_safe_default_protocol_versions()
        .unwrap()
        .with_no_client_auth()
        .with_single_cert(vec![certificate.der().clone()], key.into())
        .unwrap();
    let (acceptor, listener) = (TlsAcceptor::from(Arc::new(config)), TcpListener::bind("127.0.0.1:0").await.unwrap());
    let (address, heard) = (listener.local_addr().unwrap(), Heard::default());
    let kept = Arc::clone(&heard);
    tokio::spawn(async move {
        while let Ok((stream, _)) = listener.accept().await {
            let Ok(mut stream) = acceptor.accept(stream).await else { continue };
            let mut request = Vec::new();
            // The body is JSON, so it ends with the brace that closes it.
            while !request.ends_with(b"}") && stream.read_buf(&mut request).await.unwrap_or(0) > 0 {}
            kept.lock().unwrap().push(String::from_utf8(request).unwrap());
            let _ = stream.write_all(b"HTTP/1.1 204 No Content\r\nconnection: close\r\n\r\n").await;
            let _ = stream.shutdown().await;
        }
    });
    (address, heard)
}

/// The first delivery of a new job's webhook at this address, once it was tried.
async fn first_delivery(program: &Program, address: SocketAddr) -> Value {
    let client = reqwest::Client::new();
    let webhook = json!({"url": format!("https://{address}/hook"), "secret": SECRET});
    let form = Form::new()
        .part("images", Part::bytes(b"no photograph".to_vec()).file_name("a.jpg"))
        .text("webhook", webhook.to_string());
    let made = client.post(format!("{}/api/v1/jobs", program.base)).multipart(form).send().await.unwrap();
    assert_eq!(made.status(), 202);
    let job: Value = made.json().await.unwrap();
    let start = Instant::now();
    loop {
        let link = format!("{}{}", program.base, job["links"]["webhooks"].as_str().unwrap());
        let list: Value = client.get(link).send().await.unwrap().json().await.unwrap();
        let first = &list["webhooks"][0]["deliveries"][0];
        if first["attempts"].as_i64() > Some(0) {
            return first.clone();
        }
        assert!(start.elapsed() < Duration::from_secs(20), "waited too long: {list:#}");
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
}

fn start(data_dir: &Path, authorities: &Path) -> Program {
    Program::start_with(data_dir, &["--webhook-allow", "127.0.0.1", "--webhook-ca", authorities.to_str().unwrap()])
}

#[tokio::test(flavor = "multi_thread")]
async fn https_receivers_are_told_when_their_authority_is_trusted_and_the_host_is_theirs() {
    let folder = tempfile::tempdir().unwrap();
    let (trusted, unknown) = (authority("trusted"), authority("unknown"));
    let file = folder.path().join("authorities.pem");
    std::fs::write(&file, trusted.pem()).unwrap();
    let program = start(&folder.path().join("data"), &file);

    let (address, heard) = receiver(&trusted, "127.0.0.1").await;
    let delivery = first_delivery(&program, address).await;
    assert_eq!((&delivery["state"], &delivery["last_status"]), (&json!("delivered"), &json!(204)), "{delivery:#}");
    let request = heard.lock().unwrap()[0].clone();
    assert!(
        request.starts_with("POST /hook HTTP/1.1\r\n") && request.contains("x-multistage-signature: t="),
        "{request}"
    );

    for (authority, host, why) in
        [(&unknown, "127.0.0.1", "UnknownIssuer"), (&trusted, "other.example", "not valid for")]
    {
        let (address, heard) = receiver(authority, host).await;
        let delivery = first_delivery(&program, address).await;
        let error = delivery["last_error"].as_str().unwrap();
        assert!(error.contains(why) && delivery["last_status"].is_null(), "{delivery:#}");
        assert_eq!(delivery["state"], "pending");
        assert_eq!(heard.lock().unwrap().len(), 0, "nothing is said to a stranger");
    }
}

#[test]
fn a_file_without_certificates_is_refused_at_the_start() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("empty.pem");
    std::fs::write(&file, "no certificate").unwrap();
    for file in [file, folder.path().join("not-there.pem")] {
        let mut serve = std::process::Command::new(env!("CARGO_BIN_EXE_multistage"));
        let refused = serve.args(["serve", "--bind", "127.0.0.1:0", "--webhook-ca"]).arg(file).output().unwrap();
        assert_eq!(refused.status.code(), Some(2));
        assert!(String::from_utf8(refused.stderr).unwrap().contains("--webhook-ca"));
    }
}
