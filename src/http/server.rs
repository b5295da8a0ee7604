//! The running service: store, recovery, executor and listener, started and stopped together.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::{AppState, connection, nodeodm, router};
use crate::config::ServerConfig;
use crate::jobs::{Engine, Executor, Hub, Jobs, Machine, recover, remove_stale};
use crate::store::{Store, StoreError};

/// Between two looks for uploads whose time is over.
const SWEEP_INTERVAL: Duration = Duration::from_secs(60);

/// Why the service could not start.
#[derive(Debug, thiserror::Error)]
pub enum ServerError {
    /// The data directory can't be used.
    #[error("the data directory {path}: {source}")]
    Store {
        /// Which.
        path: String,
        /// Why.
        source: StoreError,
    },
    /// The address can't be listened on.
    #[error("can't listen on {address}: {source}")]
    Bind {
        /// Which.
        address: SocketAddr,
        /// Why.
        source: io::Error,
    },
}

/// A service that runs.
pub struct Server {
    /// Where it listens.
    pub address: SocketAddr,
    /// Where it listens for clients of NodeODM.
    pub nodeodm_address: Option<SocketAddr>,
    shutdown: CancellationToken,
    listeners: Vec<JoinHandle<()>>,
    executor: JoinHandle<()>,
    grace: Duration,
    store: Arc<Store>,
}

impl Server {
    /// Opens the data directory, puts it in order, starts the executor and listens.
    ///
    /// # Errors
    /// Why it could not start.
    pub async fn start(config: ServerConfig, engine: Arc<dyn Engine>) -> Result<Self, ServerError> {
        let failed = |source| ServerError::Store { path: config.data_dir.display().to_string(), source };
        let store = Arc::new(Store::open(&config.data_dir).await.map_err(failed)?);
        let recovered = recover(&store).await.map_err(failed)?;
        tracing::info!(?recovered, data_dir = %store.data.root().display(), "store opened");
        let (listener, address) = bind(config.bind).await?;
        let nodeodm = match config.nodeodm_bind {
            Some(address) => Some(bind(address).await?),
            None => None,
        };
        let nodeodm_address = nodeodm.as_ref().map(|(_, address)| *address);
        let jobs = Jobs { store: Arc::clone(&store), hub: Arc::new(Hub::default()), engine, figures: Arc::default() };
        let shutdown = CancellationToken::new();
        let machine = Machine::detect(config.threads, config.memory_bytes);
        tracing::info!(?machine, "jobs may take this much");
        let executor = Executor::new(jobs.clone(), machine, config.seed);
        let executor = tokio::spawn(executor.run(config.parallel_jobs, shutdown.clone()));
        tokio::spawn(jobs.clone().call_webhooks(config.webhooks.clone(), shutdown.clone()));
        tokio::spawn(sweep(jobs.clone(), config.keep, config.upload_expiry, shutdown.clone()));
        let grace = config.shutdown_grace;
        let limits = config.connections;
        let state = AppState::new(jobs, config, shutdown.clone());
        let mut listeners = Vec::new();
        if let Some((listener, _)) = nodeodm {
            let app = nodeodm::router(state.clone());
            listeners.push(tokio::spawn(connection::serve(listener, app, limits, shutdown.clone())));
        }
        listeners.push(tokio::spawn(connection::serve(listener, router(state), limits, shutdown.clone())));
        Ok(Self { address, nodeodm_address, shutdown, listeners, executor, grace, store })
    }

    /// Stops: no new requests; open ones and the running job get the time of grace, and the job goes back to the queue.
    pub async fn stop(mut self) {
        self.shutdown.cancel();
        let ended = tokio::time::timeout(self.grace, async {
            for listener in &mut self.listeners {
                if let Err(error) = listener.await {
                    tracing::error!(%error, "a listener ended with an error");
                }
            }
            if let Err(error) = (&mut self.executor).await {
                tracing::error!(%error, "the executor ended with an error");
            }
        })
        .await;
        if ended.is_err() {
            tracing::warn!("requests or a job did not end in time; the job goes on after the next start");
            self.listeners.iter().for_each(JoinHandle::abort);
            self.executor.abort();
        }
        self.store.db.close().await;
    }
}

async fn bind(address: SocketAddr) -> Result<(TcpListener, SocketAddr), ServerError> {
    let failed = |source| ServerError::Bind { address, source };
    let listener = TcpListener::bind(address).await.map_err(failed)?;
    let bound = listener.local_addr().map_err(failed)?;
    Ok((listener, bound))
}

/// Removes what its time is over for, from the start on and now and then.
async fn sweep(jobs: Jobs, keep: Option<Duration>, upload_expiry: Duration, shutdown: CancellationToken) {
    loop {
        let store = &jobs.store;
        if let Some(keep) = keep {
            match remove_stale(&store.db, keep).await {
                Ok(stale) if stale.is_empty() => {}
                Ok(stale) => tracing::info!(?stale, "jobs and datasets were kept long enough and are removed"),
                Err(error) => tracing::warn!(%error, "what was kept long enough could not be removed"),
            }
        }
        match store.data.empty_quarantine() {
            Ok(0) => {}
            Ok(removed) => tracing::info!(removed, "what was in quarantine long enough is removed"),
            Err(error) => tracing::warn!(%error, "the quarantine could not be emptied"),
        }
        if let Err(error) = store.keep_ballast() {
            tracing::warn!(%error, "the ballast could not be made");
        }
        // What `multistage cleanup` noted goes, too.
        if let Err(error) = store.discard_deleted().await {
            tracing::warn!(%error, "deleted folders could not be removed");
        }
        match store.sweep_uploads().await {
            Ok(0) => {}
            Ok(expired) => tracing::info!(expired, "uploads expired"),
            Err(error) => tracing::warn!(%error, "expired uploads could not be removed"),
        }
        match jobs.remove_abandoned_tasks(upload_expiry).await {
            Ok(0) => {}
            Ok(removed) => tracing::info!(removed, "tasks that were never committed removed"),
            Err(error) => tracing::warn!(%error, "tasks that were never committed could not be removed"),
        }
        tokio::select! {
            () = tokio::time::sleep(SWEEP_INTERVAL) => {}
            () = shutdown.cancelled() => return,
        }
    }
}
