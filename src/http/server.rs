//! The running service: store, recovery, executor and listener, started and stopped together.

use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use tokio::net::TcpListener;
use tokio::task::JoinHandle;
use tokio_util::sync::CancellationToken;

use super::{AppState, connection, router};
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
    shutdown: CancellationToken,
    listener: JoinHandle<()>,
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
        let bind_failed = |source| ServerError::Bind { address: config.bind, source };
        let listener = TcpListener::bind(config.bind).await.map_err(bind_failed)?;
        let address = listener.local_addr().map_err(bind_failed)?;
        let jobs = Jobs { store: Arc::clone(&store), hub: Arc::new(Hub::default()), engine };
        let shutdown = CancellationToken::new();
        let machine = Machine::detect(config.threads, config.memory_bytes);
        tracing::info!(?machine, "jobs may take this much");
        let executor = Executor::new(jobs.clone(), machine, config.seed);
        let executor = tokio::spawn(executor.run(config.parallel_jobs, shutdown.clone()));
        tokio::spawn(sweep(Arc::clone(&store), config.keep, shutdown.clone()));
        let grace = config.shutdown_grace;
        let limits = config.connections;
        let app = router(AppState::new(jobs, config, shutdown.clone()));
        let listener = tokio::spawn(connection::serve(listener, app, limits, shutdown.clone()));
        Ok(Self { address, shutdown, listener, executor, grace, store })
    }

    /// Stops: no new requests; open ones and the running job get the time of grace, and the job goes back to the queue.
    pub async fn stop(mut self) {
        self.shutdown.cancel();
        let ended = tokio::time::timeout(self.grace, async {
            let (listener, executor) = tokio::join!(&mut self.listener, &mut self.executor);
            if let Err(error) = listener {
                tracing::error!(%error, "the listener ended with an error");
            }
            if let Err(error) = executor {
                tracing::error!(%error, "the executor ended with an error");
            }
        })
        .await;
        if ended.is_err() {
            tracing::warn!("requests or a job did not end in time; the job goes on after the next start");
            self.listener.abort();
            self.executor.abort();
        }
        self.store.db.close().await;
    }
}

/// Removes what its time is over for, from the start on and now and then.
async fn sweep(store: Arc<Store>, keep: Option<Duration>, shutdown: CancellationToken) {
    loop {
        if let Some(keep) = keep {
            match remove_stale(&store.db, keep).await {
                Ok(stale) if stale.is_empty() => {}
                Ok(stale) => tracing::info!(?stale, "jobs and datasets were kept long enough and are removed"),
                Err(error) => tracing::warn!(%error, "what was kept long enough could not be removed"),
            }
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
        tokio::select! {
            () = tokio::time::sleep(SWEEP_INTERVAL) => {}
            () = shutdown.cancelled() => return,
        }
    }
}
