//! `multistage serve`: the web service, until a signal stops it.

use std::io::Write;
use std::net::SocketAddr;
use std::num::{NonZeroU32, NonZeroU64, NonZeroUsize};
use std::path::PathBuf;
use std::sync::Arc;
use std::time::Duration;

use clap::ValueEnum;
use rustix::process::{Resource, Rlimit, getrlimit, setrlimit};
use rustls_pki_types::CertificateDer;
use rustls_pki_types::pem::PemObject;
use tokio::signal::unix::{SignalKind, signal};
use tracing_subscriber::EnvFilter;

use super::Failure;
use crate::config::{IpNetwork, ServerConfig};
use crate::http::Server;
use crate::jobs::PipelineEngine;

/// Arguments of `multistage serve`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// Address to listen on; port 0 takes a free one. Beyond this machine, every request needs a token.
    #[arg(long, env = "MULTISTAGE_BIND", default_value = "127.0.0.1:8080")]
    bind: SocketAddr,
    /// Serve clients of NodeODM (WebODM, CloudODM, PyODM) as well, at this address, such as 127.0.0.1:3000. Beyond this
    /// machine, every request needs a token.
    #[arg(long, env = "MULTISTAGE_NODEODM_BIND")]
    nodeodm_bind: Option<SocketAddr>,
    /// Serve without tokens beyond this machine too: whoever reaches the address may do everything.
    #[arg(long, env = "MULTISTAGE_INSECURE", conflicts_with = "require_token")]
    insecure: bool,
    /// Require tokens on this machine as well, as behind a proxy.
    #[arg(long, env = "MULTISTAGE_REQUIRE_TOKEN")]
    require_token: bool,
    /// Origin of another site whose pages may use the service; may be given again.
    #[arg(long = "cors-origin", env = "MULTISTAGE_CORS_ORIGINS", value_delimiter = ',')]
    cors_origins: Vec<String>,
    /// Address or network, such as 10.1.0.0/16, that webhooks may lead to besides the public internet; may be given again.
    #[arg(long = "webhook-allow", env = "MULTISTAGE_WEBHOOK_ALLOW", value_delimiter = ',')]
    webhook_allow: Vec<IpNetwork>,
    /// File of certificates (PEM) of authorities that https webhooks are trusted by, besides those of the system; may be given
    /// again.
    #[arg(long = "webhook-ca", env = "MULTISTAGE_WEBHOOK_CA", value_delimiter = ',', value_name = "FILE.pem", value_parser = read_certificates)]
    webhook_ca: Vec<Certificates>,
    /// Requests a second that one token may send, on average [default: 500].
    #[arg(long, env = "MULTISTAGE_REQUESTS_PER_S")]
    requests_per_s: Option<NonZeroU32>,
    /// Wrong tokens a minute that one address may send before it is refused for a while [default: 10].
    #[arg(long, env = "MULTISTAGE_WRONG_TOKENS_PER_MIN")]
    wrong_tokens_per_min: Option<NonZeroU32>,
    /// Directory that keeps photographs, jobs and models; one process at a time may use it.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data")]
    data_dir: PathBuf,
    /// Worker threads of a job [default: all of the machine's].
    #[arg(long, env = "MULTISTAGE_THREADS")]
    threads: Option<NonZeroUsize>,
    /// Memory that all jobs together may take, in bytes [default: 85 % of what the system or the control group allows].
    #[arg(long, env = "MULTISTAGE_MAX_MEMORY_BYTES")]
    max_memory_bytes: Option<NonZeroU64>,
    /// Jobs that run at once; each has its own threads and memory.
    #[arg(long, env = "MULTISTAGE_MAX_PARALLEL_JOBS", default_value = "1")]
    max_parallel_jobs: NonZeroUsize,
    /// Remove jobs so many days after their end, and datasets that nothing has used for as long [default: keep everything].
    #[arg(long, env = "MULTISTAGE_KEEP_DAYS")]
    keep_days: Option<u32>,
    /// Connections open at once [default: 4096, or what the system's limit on open files allows].
    #[arg(long, env = "MULTISTAGE_MAX_CONNECTIONS")]
    max_connections: Option<NonZeroUsize>,
    /// Bytes that one upload may bring [default: 256 GiB].
    #[arg(long, env = "MULTISTAGE_MAX_UPLOAD_BYTES")]
    max_upload_bytes: Option<NonZeroU64>,
    /// Photographs that one upload may bring [default: 100000].
    #[arg(long, env = "MULTISTAGE_MAX_FILES")]
    max_files: Option<NonZeroUsize>,
    /// Bytes up to which a photograph waits in memory until all of it has come; larger ones are written as they come. 0
    /// for none [default: 4 MiB].
    #[arg(long, env = "MULTISTAGE_UPLOAD_MEMORY_FILE_BYTES")]
    upload_memory_file_bytes: Option<u64>,
    /// Bytes of memory that all photographs that wait so may take; when they are used up, further ones are written as they come
    /// [default: 32 MiB].
    #[arg(long, env = "MULTISTAGE_UPLOAD_MEMORY_BYTES")]
    upload_memory_bytes: Option<u64>,
    /// Seed of every job's random choices.
    #[arg(long, default_value = "0")]
    seed: u64,
    /// How the log on standard error is written; RUST_LOG chooses what.
    #[arg(long, env = "MULTISTAGE_LOG_FORMAT", value_enum, default_value = "text")]
    log_format: LogFormat,
}

#[derive(Clone, Copy, Debug, ValueEnum)]
enum LogFormat {
    /// One line for people.
    Text,
    /// One JSON object a line.
    Json,
}

impl Args {
    fn config(&self) -> ServerConfig {
        let mut config = ServerConfig::new(&self.data_dir);
        config.bind = self.bind;
        config.nodeodm_bind = self.nodeodm_bind;
        config.threads = self.threads.map_or(config.threads, NonZeroUsize::get);
        config.parallel_jobs = self.max_parallel_jobs.get();
        config.memory_bytes = self.max_memory_bytes.map(NonZeroU64::get);
        config.keep = self.keep_days.map(|days| Duration::from_secs(24 * 3600 * u64::from(days)));
        config.seed = self.seed;
        let connections = &mut config.connections;
        let wanted = self.max_connections.map_or(connections.max_connections, NonZeroUsize::get);
        connections.max_connections = wanted.min(connections_that_fit());
        config.webhooks.allowed.clone_from(&self.webhook_allow);
        config.webhooks.trusted = self.webhook_ca.iter().flat_map(|file| file.0.iter().cloned()).collect();
        let access = &mut config.access;
        let on_this_machine =
            self.bind.ip().is_loopback() && self.nodeodm_bind.is_none_or(|bind| bind.ip().is_loopback());
        access.token_required = self.require_token || !(self.insecure || on_this_machine);
        access.cors_origins.clone_from(&self.cors_origins);
        access.requests_per_s = self.requests_per_s.map_or(access.requests_per_s, NonZeroU32::get);
        access.failures_per_min = self.wrong_tokens_per_min.map_or(access.failures_per_min, NonZeroU32::get);
        let uploads = &mut config.uploads;
        uploads.max_upload_bytes = self.max_upload_bytes.map_or(uploads.max_upload_bytes, NonZeroU64::get);
        uploads.archive.max_total_bytes = uploads.max_upload_bytes;
        uploads.max_files = self.max_files.map_or(uploads.max_files, NonZeroUsize::get);
        uploads.memory_file_bytes = self.upload_memory_file_bytes.unwrap_or(uploads.memory_file_bytes);
        uploads.memory_bytes = self.upload_memory_bytes.unwrap_or(uploads.memory_bytes);
        config
    }
}

/// The certificates of one file.
#[derive(Clone, Debug)]
struct Certificates(Vec<CertificateDer<'static>>);

fn read_certificates(file: &str) -> Result<Certificates, String> {
    let read = CertificateDer::pem_file_iter(file).map_err(|error| error.to_string())?;
    let certificates = read.collect::<Result<Vec<_>, _>>().map_err(|error| error.to_string())?;
    if certificates.is_empty() { Err("it holds no certificate".to_owned()) } else { Ok(Certificates(certificates)) }
}

/// Open files that the database, uploads, downloads and jobs need besides connections.
const OTHER_FILES: u64 = 512;

/// Raises the process's limit on open files as far as the system lets it, and gives the connections that fit below it.
fn connections_that_fit() -> usize {
    let mut limit = getrlimit(Resource::Nofile);
    let raised = Rlimit { current: limit.maximum, ..limit };
    if setrlimit(Resource::Nofile, raised).is_ok() {
        limit = raised;
    }
    limit.current.map_or(usize::MAX, |files| {
        // With few files, half of them.
        usize::try_from(files.saturating_sub(OTHER_FILES).max(files / 2)).unwrap_or(usize::MAX)
    })
}

/// Runs the service.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    let filter = EnvFilter::try_from_default_env().unwrap_or_else(|_| EnvFilter::new("info,sqlx=warn"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr);
    match args.log_format {
        LogFormat::Text => log.init(),
        LogFormat::Json => log.json().init(),
    }
    let runtime = tokio::runtime::Builder::new_multi_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::Outside(format!("can't start the runtime: {error}")))?;
    let served = runtime.block_on(serve(args.config()));
    // A job that did not stop in time ends with the process and goes on after the next start.
    runtime.shutdown_timeout(Duration::from_secs(1));
    served
}

async fn serve(config: ServerConfig) -> Result<(), Failure> {
    let outside = |error: std::io::Error| Failure::Outside(error.to_string());
    let mut interrupt = signal(SignalKind::interrupt()).map_err(outside)?;
    let mut terminate = signal(SignalKind::terminate()).map_err(outside)?;
    let server =
        Server::start(config, Arc::new(PipelineEngine)).await.map_err(|error| Failure::Outside(error.to_string()))?;
    // For whoever started it and waits for the port.
    println!("listening on http://{}/", server.address);
    if let Some(address) = server.nodeodm_address {
        println!("NodeODM's interface at http://{address}/");
    }
    std::io::stdout().flush().map_err(outside)?;
    tokio::select! {
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    tracing::info!("stopping; a second signal stops at once");
    tokio::select! {
        () = server.stop() => {}
        _ = interrupt.recv() => {}
        _ = terminate.recv() => {}
    }
    Ok(())
}
