//! Settings of the service's process.

mod network;

use std::net::{IpAddr, Ipv4Addr, SocketAddr};
use std::path::{Path, PathBuf};
use std::time::Duration;

pub use network::{InvalidNetwork, IpNetwork};
use rustls_pki_types::CertificateDer;

use crate::store::ArchiveLimits;

/// How far one upload request may go.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct UploadLimits {
    /// Bytes of the whole request.
    pub max_upload_bytes: u64,
    /// Photographs of one request, unpacked ones included.
    pub max_files: usize,
    /// Bytes of one photograph.
    pub max_file_bytes: u64,
    /// A photograph of at most so many bytes that comes whole with the request that makes its resumable upload waits in
    /// memory until all of it is there; others are written as they come.
    pub memory_file_bytes: u64,
    /// Memory of all that wait so; when it is used up, they too are written as they come.
    pub memory_bytes: u64,
    /// Unpacking.
    pub archive: ArchiveLimits,
}

impl Default for UploadLimits {
    fn default() -> Self {
        Self {
            max_upload_bytes: 256 << 30,
            max_files: 100_000,
            max_file_bytes: 1 << 30,
            memory_file_bytes: 4 << 20,
            memory_bytes: 32 << 20,
            archive: ArchiveLimits::default(),
        }
    }
}

/// Who may use the service.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AccessPolicy {
    /// Whether every request needs a token.
    pub token_required: bool,
    /// Origins of other sites whose pages may use the service, such as `https://survey.example`.
    pub cors_origins: Vec<String>,
    /// Requests of one token, on average; bursts may bring ten seconds' worth.
    pub requests_per_s: u32,
    /// Wrong tokens that one address may try.
    pub failures_per_min: u32,
}

impl Default for AccessPolicy {
    fn default() -> Self {
        Self { token_required: false, cors_origins: Vec::new(), requests_per_s: 500, failures_per_min: 10 }
    }
}

/// How patient the service is with the other end of a connection.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ConnectionLimits {
    /// Connections open at once. When all places are taken, the one that has waited longest for a request makes room.
    pub max_connections: usize,
    /// Time for the head of a request, and for the next request of an idle connection.
    pub header_timeout: Duration,
    /// Time over which the rate of a request's body is taken.
    pub body_window: Duration,
    /// A body that brings less per second of waiting, over a window, is given up.
    pub min_body_bytes_per_s: u64,
    /// A reader that takes no byte of an answer for so long is given up.
    pub write_stall: Duration,
}

impl Default for ConnectionLimits {
    fn default() -> Self {
        Self {
            max_connections: 4096,
            header_timeout: Duration::from_secs(30),
            body_window: Duration::from_secs(30),
            min_body_bytes_per_s: 128,
            write_stall: Duration::from_secs(60),
        }
    }
}

/// How webhooks are called.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct WebhookPolicy {
    /// Addresses they may lead to besides those of the public internet.
    pub allowed: Vec<IpNetwork>,
    /// Certificates of authorities that are trusted besides those the system trusts.
    pub trusted: Vec<CertificateDer<'static>>,
    /// Time for one request, from the host's name to the end of the answer.
    pub timeout: Duration,
    /// Time until the second attempt; later ones wait longer.
    pub first_pause: Duration,
    /// Attempts until a delivery is given up; by the pauses, within two days.
    pub max_attempts: u32,
}

impl Default for WebhookPolicy {
    fn default() -> Self {
        Self {
            allowed: Vec::new(),
            trusted: Vec::new(),
            timeout: Duration::from_secs(10),
            first_pause: Duration::from_secs(5),
            max_attempts: 14,
        }
    }
}

/// Settings of `multistage serve`.
#[derive(Clone, Debug, PartialEq)]
pub struct ServerConfig {
    /// Address to listen on; port 0 takes a free one.
    pub bind: SocketAddr,
    /// Address where clients of NodeODM are served as well; none without.
    pub nodeodm_bind: Option<SocketAddr>,
    /// Where everything is kept.
    pub data_dir: PathBuf,
    /// Worker threads of a job.
    pub threads: usize,
    /// Memory that all jobs together may take; none for what the system or the control group allows.
    pub memory_bytes: Option<u64>,
    /// Jobs that run at once.
    pub parallel_jobs: usize,
    /// Jobs that ended, and datasets that nothing used, are removed after so long; none for never.
    pub keep: Option<Duration>,
    /// Seed of every job's run.
    pub seed: u64,
    /// Who may use it.
    pub access: AccessPolicy,
    /// What uploads may bring.
    pub uploads: UploadLimits,
    /// How slow the other end may be.
    pub connections: ConnectionLimits,
    /// How webhooks are called.
    pub webhooks: WebhookPolicy,
    /// Time for a request other than uploads, downloads and event streams.
    pub request_timeout: Duration,
    /// An upload that brings no byte for so long is given up.
    pub upload_idle_timeout: Duration,
    /// A resumable upload is kept so long without a further byte.
    pub upload_expiry: Duration,
    /// How long a request waits for another that works on the same resumable upload.
    pub upload_lock_wait: Duration,
    /// How often event streams say that they live.
    pub keep_alive: Duration,
    /// Time for requests and jobs to end when the service stops.
    pub shutdown_grace: Duration,
}

impl ServerConfig {
    /// The defaults, for a data directory.
    pub fn new(data_dir: &Path) -> Self {
        Self {
            bind: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 8080),
            nodeodm_bind: None,
            data_dir: data_dir.to_path_buf(),
            threads: std::thread::available_parallelism().map_or(1, usize::from),
            memory_bytes: None,
            parallel_jobs: 1,
            keep: None,
            seed: 0,
            access: AccessPolicy::default(),
            uploads: UploadLimits::default(),
            connections: ConnectionLimits::default(),
            webhooks: WebhookPolicy::default(),
            request_timeout: Duration::from_secs(30),
            upload_idle_timeout: Duration::from_secs(30),
            upload_expiry: Duration::from_secs(7 * 24 * 3600),
            upload_lock_wait: Duration::from_secs(10),
            keep_alive: Duration::from_secs(15),
            shutdown_grace: Duration::from_secs(10),
        }
    }

    /// Small limits, short times and any free port.
    pub fn for_testing(data_dir: &Path) -> Self {
        Self {
            bind: SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 0),
            threads: 2,
            uploads: UploadLimits {
                max_upload_bytes: 64 << 20,
                max_files: 5_000,
                max_file_bytes: 4 << 20,
                archive: ArchiveLimits { max_entries: 2_000, max_file_bytes: 4 << 20, ..ArchiveLimits::default() },
                ..UploadLimits::default()
            },
            webhooks: WebhookPolicy { first_pause: Duration::from_millis(20), ..WebhookPolicy::default() },
            upload_idle_timeout: Duration::from_secs(5),
            keep_alive: Duration::from_millis(200),
            ..Self::new(data_dir)
        }
    }
}
