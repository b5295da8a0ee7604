//! Connections: accepted, served as HTTP/1.1, and closed when their other end is too slow.
//!
//! Whoever opens a connection holds a socket and some memory of this process. So each phase has its limit: the head of
//! a request must come within a time, its body must bring a least rate while the service waits for it ([`PacedBody`]),
//! and a reader that takes nothing is given up ([`StallLimit`]). Event streams and long downloads last as long as they
//! last. When all places are taken, the connection that has waited longest for a request makes room for a new one
//! ([`Waiting`]).

mod paced_body;
mod stall_limit;
mod waiting;

use std::convert::Infallible;
use std::io;
use std::net::SocketAddr;
use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::body::Body;
use axum::extract::ConnectInfo;
use axum::response::Response;
use hyper::Request;
use hyper::body::Incoming;
use hyper::server::conn::http1;
use hyper::service::service_fn;
use hyper_util::rt::{TokioIo, TokioTimer};
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::Semaphore;
use tokio_util::sync::CancellationToken;
use tower::ServiceExt;

use crate::config::ConnectionLimits;
use paced_body::PacedBody;
use stall_limit::StallLimit;
use waiting::{Busy, HeldBody, Place, Waiting};

/// The head of a request, and what one read of a connection brings at most.
const MAX_BUFFER_BYTES: usize = 128 << 10;
/// After a failure to accept, as when the process has no descriptor left.
const ACCEPT_RETRY: Duration = Duration::from_millis(200);

/// Accepts connections and serves `app` on them until `shutdown`; returns once the open requests are answered.
pub(super) async fn serve(listener: TcpListener, app: Router, limits: ConnectionLimits, shutdown: CancellationToken) {
    let max = u32::try_from(limits.max_connections).unwrap_or(u32::MAX).clamp(1, MAX_PLACES);
    let places = Arc::new(Semaphore::new(max as usize));
    let waiting = Arc::new(Waiting::default());
    let accept = async {
        loop {
            let (stream, peer) = match listener.accept().await {
                Ok(accepted) => accepted,
                // The other end changed its mind.
                Err(error) if error.kind() == io::ErrorKind::ConnectionAborted => continue,
                Err(error) => {
                    tracing::warn!(%error, "a connection could not be accepted");
                    tokio::time::sleep(ACCEPT_RETRY).await;
                    continue;
                }
            };
            if places.available_permits() == 0 {
                waiting.dismiss_longest();
            }
            // Closed never.
            let Ok(place) = Arc::clone(&places).acquire_owned().await else { return };
            let serving = connection(stream, peer, app.clone(), limits, Place::new(&waiting), shutdown.clone());
            tokio::spawn(async move {
                serving.await;
                drop(place);
            });
        }
    };
    tokio::select! {
        () = accept => {}
        () = shutdown.cancelled() => {}
    }
    drop(listener);
    // Every place is free again when the last connection is closed.
    let _ = places.acquire_many(max).await;
}

/// What the counter of places can hold.
const MAX_PLACES: u32 = 1 << 28;

/// Serves one connection to its end.
async fn connection(
    stream: TcpStream,
    peer: SocketAddr,
    app: Router,
    limits: ConnectionLimits,
    place: Place,
    shutdown: CancellationToken,
) {
    // Events are small and must not wait for more.
    if let Err(error) = stream.set_nodelay(true) {
        tracing::debug!(%peer, %error, "the connection is gone already");
        return;
    }
    let dismissed = place.dismissed();
    let place = Arc::new(place);
    let service = service_fn(move |request: Request<Incoming>| {
        let busy = Busy::begin(&place);
        let (app, mut request) = (app.clone(), request.map(|body| Body::new(PacedBody::new(body, &limits))));
        request.extensions_mut().insert(ConnectInfo(peer));
        async move {
            let response: Response = match app.oneshot(request).await {
                Ok(response) => response,
                Err(never) => match never {},
            };
            Ok::<_, Infallible>(response.map(|body| HeldBody::new(body, busy)))
        }
    });
    let io = TokioIo::new(StallLimit::new(stream, limits.write_stall));
    let serving = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(limits.header_timeout)
        .max_buf_size(MAX_BUFFER_BYTES)
        .serve_connection(io, service);
    tokio::pin!(serving);
    let mut stopping = false;
    loop {
        tokio::select! {
            // Time-outs and resets are the other end's affair.
            ended = &mut serving => return if let Err(error) = ended {
                tracing::debug!(%peer, %error, "a connection broke off");
            },
            () = shutdown.cancelled(), if !stopping => {
                stopping = true;
                serving.as_mut().graceful_shutdown();
            }
            () = dismissed.notified() => return,
        }
    }
}
