//! One request to a webhook: the host's addresses are asked for once, all are judged, and the connection goes to one of them.
//! Redirects are answers like others; there is no proxy and nothing is kept between requests.

use std::io;
use std::net::SocketAddr;
use std::sync::{Arc, OnceLock};

use bytes::Bytes;
use http_body_util::{BodyExt, Full, Limited};
use hyper::{Request, StatusCode, header};
use hyper_util::rt::TokioIo;
use tokio::io::{AsyncRead, AsyncWrite};
use tokio::net::TcpStream;
use tokio_rustls::TlsConnector;
use tokio_rustls::rustls::pki_types::{CertificateDer, ServerName};
use tokio_rustls::rustls::{self, ClientConfig, RootCertStore};
use url::Position;

use super::target::{InvalidTarget, Target, may_connect};
use crate::config::{IpNetwork, WebhookPolicy};

/// Bytes of an answer that are read, so that the other side can end it properly.
const MAX_ANSWER_BYTES: usize = 64 << 10;

/// Finds the addresses of a host. There is one besides the system's in tests, which changes its mind.
pub(super) trait Resolve: Send + Sync {
    fn resolve(&self, host: &str, port: u16) -> impl Future<Output = io::Result<Vec<SocketAddr>>> + Send;
}

/// The system's resolver.
pub(super) struct SystemResolver;

impl Resolve for SystemResolver {
    async fn resolve(&self, host: &str, port: u16) -> io::Result<Vec<SocketAddr>> {
        Ok(tokio::net::lookup_host((host, port)).await?.collect())
    }
}

/// Why a request came to nothing.
#[derive(Debug, thiserror::Error)]
pub(super) enum SendError {
    #[error(transparent)]
    Target(#[from] InvalidTarget),
    #[error("the host's name has no address")]
    Resolve,
    #[error("can't connect: {0}")]
    Connect(io::Error),
    #[error("no answer: {0}")]
    Http(#[from] hyper::Error),
    #[error("the request can't be made: {0}")]
    Request(#[from] hyper::http::Error),
    #[error("no answer in time")]
    Timeout,
}

/// What is sent.
pub(super) struct Message {
    pub(super) headers: Vec<(&'static str, String)>,
    pub(super) body: String,
}

/// Sends a message and gives the answer's status.
pub(super) async fn send(
    resolver: &impl Resolve,
    trust: &Trust,
    target: &Target,
    policy: &WebhookPolicy,
    message: Message,
) -> Result<StatusCode, SendError> {
    let sent = async {
        let stream = connect(resolver, target, &policy.allowed).await?;
        if !target.is_encrypted() {
            return exchange(stream, target, message).await;
        }
        let name = ServerName::try_from(target.host()).map_err(io::Error::other).map_err(SendError::Connect)?;
        let tls =
            TlsConnector::from(trust.config(&policy.trusted).map_err(io::Error::other).map_err(SendError::Connect)?);
        let stream = tls.connect(name, stream).await.map_err(SendError::Connect)?;
        exchange(stream, target, message).await
    };
    tokio::time::timeout(policy.timeout, sent).await.map_err(|_| SendError::Timeout)?
}

/// Connects to the first of the host's addresses that takes the connection, provided that all of them are acceptable: a
/// name with one foot in this network is a trick.
async fn connect(resolver: &impl Resolve, target: &Target, allowed: &[IpNetwork]) -> Result<TcpStream, SendError> {
    let addresses = resolver.resolve(&target.host(), target.port()).await.map_err(|_| SendError::Resolve)?;
    if addresses.iter().any(|address| !may_connect(address.ip(), allowed)) {
        return Err(InvalidTarget::NotPublic.into());
    }
    let mut failure = SendError::Resolve;
    for address in addresses {
        match TcpStream::connect(address).await {
            Ok(stream) => return Ok(stream),
            Err(error) => failure = SendError::Connect(error),
        }
    }
    Err(failure)
}

async fn exchange(
    stream: impl AsyncRead + AsyncWrite + Send + Unpin + 'static,
    target: &Target,
    message: Message,
) -> Result<StatusCode, SendError> {
    let (mut sender, connection) = hyper::client::conn::http1::handshake(TokioIo::new(stream)).await?;
    let connection = tokio::spawn(connection);
    let url = target.url();
    let mut request = Request::post(&url[Position::BeforePath..Position::AfterQuery])
        .header(header::HOST, &url[Position::BeforeHost..Position::AfterPort])
        .header(header::USER_AGENT, concat!(env!("CARGO_PKG_NAME"), "/", env!("CARGO_PKG_VERSION")))
        .header(header::CONTENT_TYPE, "application/json")
        .header(header::CONNECTION, "close");
    for (name, value) in message.headers {
        request = request.header(name, value);
    }
    let answered = async {
        let answer = sender.send_request(request.body(Full::new(Bytes::from(message.body)))?).await?;
        let status = answer.status();
        // What it says beyond its status concerns nobody.
        let _ = Limited::new(answer.into_body(), MAX_ANSWER_BYTES).collect().await;
        Ok(status)
    };
    let status = answered.await;
    connection.abort();
    status
}

/// TLS by the certificates that the system trusts and those of the settings; read when the first https webhook is called.
#[derive(Default)]
pub(super) struct Trust(OnceLock<Result<Arc<ClientConfig>, rustls::Error>>);

impl Trust {
    fn config(&self, trusted: &[CertificateDer<'static>]) -> Result<Arc<ClientConfig>, rustls::Error> {
        let config = self.0.get_or_init(|| {
            let found = rustls_native_certs::load_native_certs();
            for error in found.errors {
                tracing::warn!(%error, "a trusted certificate of the system can't be read");
            }
            let mut roots = RootCertStore::empty();
            roots.add_parsable_certificates(found.certs);
            for certificate in trusted {
                roots.add(certificate.clone())?;
            }
            let provider = Arc::new(rustls::crypto::ring::default_provider());
            let config = ClientConfig::builder_with_provider(provider).with_safe_default_protocol_versions()?;
            Ok(Arc::new(config.with_root_certificates(roots).with_no_client_auth()))
        });
        config.clone()
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use std::sync::atomic::{AtomicUsize, Ordering};
    use std::time::Duration;

    use tokio::io::{AsyncReadExt, AsyncWriteExt};
    use tokio::net::TcpListener;

    use super::*;

    /// Answers everybody who connects, and counts them.
    async fn listener(address: &str, answer: &'static str) -> (SocketAddr, Arc<AtomicUsize>) {
        let listener = TcpListener::bind(address).await.unwrap();
        let (address, hits) = (listener.local_addr().unwrap(), Arc::new(AtomicUsize::new(0)));
        let count = Arc::clone(&hits);
        tokio::spawn(async move {
            while let Ok((mut stream, _)) = listener.accept().await {
                count.fetch_add(1, Ordering::SeqCst);
                let mut request = vec![0; 4096];
                let _ = stream.read(&mut request).await;
                let _ = stream.write_all(answer.as_bytes()).await;
            }
        });
        (address, hits)
    }

    /// Gives the answers one after the other, as a name server of an attacker does.
    struct Fickle {
        answers: Vec<Vec<SocketAddr>>,
        asked: AtomicUsize,
    }

    impl Resolve for Fickle {
        async fn resolve(&self, _: &str, _: u16) -> io::Result<Vec<SocketAddr>> {
            let asked = self.asked.fetch_add(1, Ordering::SeqCst);
            Ok(self.answers[asked % self.answers.len()].clone())
        }
    }

    fn policy(timeout: Duration) -> WebhookPolicy {
        WebhookPolicy { allowed: vec!["127.0.0.2".parse().unwrap()], timeout, ..WebhookPolicy::default() }
    }

    /// 127.0.0.2 stands for the public internet, 127.0.0.1 for what is within.
    #[tokio::test]
    async fn the_connection_goes_to_the_address_that_was_judged() {
        let (public, heard) = listener("127.0.0.2:0", "HTTP/1.1 204 No Content\r\n\r\n").await;
        let (within, canary) = listener("127.0.0.1:0", "HTTP/1.1 200 OK\r\n\r\n").await;
        let policy = policy(Duration::from_secs(5));
        let target = Target::parse("http://rebinding.example/hook", &policy.allowed).unwrap();
        let send = async |answers: &[&[SocketAddr]]| {
            let answers: Vec<_> = answers.iter().map(|answer| answer.to_vec()).collect();
            let (count, resolver) = (answers.len(), Fickle { answers, asked: AtomicUsize::new(0) });
            let mut results = Vec::new();
            for _ in 0..count {
                let message = Message { headers: Vec::new(), body: "{}".to_owned() };
                results.push(send(&resolver, &Trust::default(), &target, &policy, message).await);
            }
            assert_eq!(resolver.asked.into_inner(), count, "a name is asked for once a request");
            results
        };
        let results = send(&[&[public], &[within], &[public, within], &[within, public], &[]]).await;
        assert!(matches!(results[0], Ok(StatusCode::NO_CONTENT)), "{results:?}");
        for refused in &results[1..4] {
            assert!(matches!(refused, Err(SendError::Target(InvalidTarget::NotPublic))), "{refused:?}");
        }
        assert!(matches!(results[4], Err(SendError::Resolve)));
        assert_eq!((heard.load(Ordering::SeqCst), canary.load(Ordering::SeqCst)), (1, 0));
    }

    #[tokio::test]
    async fn redirects_lead_nowhere_and_silence_ends() {
        let (within, canary) = listener("127.0.0.1:0", "HTTP/1.1 200 OK\r\n\r\n").await;
        let redirect = format!("HTTP/1.1 307 Elsewhere\r\nlocation: http://{within}/\r\ncontent-length: 0\r\n\r\n");
        let (public, _) = listener("127.0.0.2:0", Box::leak(redirect.into_boxed_str())).await;
        let (silent, _) = listener("127.0.0.2:0", "").await;
        let policy = policy(Duration::from_millis(500));
        let ask = async |address: SocketAddr| {
            let target = Target::parse(&format!("http://{address}/x?y=z#w"), &policy.allowed).unwrap();
            let message = Message { headers: Vec::new(), body: "{}".to_owned() };
            send(&SystemResolver, &Trust::default(), &target, &policy, message).await
        };
        assert!(matches!(ask(public).await, Ok(StatusCode::TEMPORARY_REDIRECT)));
        assert!(ask(silent).await.is_err());
        // Who speaks no TLS is not spoken to without.
        let target = Target::parse(&format!("https://{public}/"), &policy.allowed).unwrap();
        let message = Message { headers: Vec::new(), body: "{}".to_owned() };
        let plain = send(&SystemResolver, &Trust::default(), &target, &policy, message).await;
        assert!(matches!(plain, Err(SendError::Connect(_))), "{plain:?}");
        assert_eq!(canary.load(Ordering::SeqCst), 0);
    }
}
