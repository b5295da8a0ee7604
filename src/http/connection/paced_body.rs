//! A request's body that must come at a least rate.

use std::io;
use std::pin::Pin;
use std::task::{Context, Poll, ready};
use std::time::Duration;

use bytes::Bytes;
use hyper::body::{Body, Frame, SizeHint};
use tokio::time::{Instant, Sleep, sleep_until};

use crate::config::ConnectionLimits;

/// Fails when the sender brought too little in a window of time. Only time in which the service waits for the sender
/// counts: one that the service keeps waiting, as while a photograph is stored, is not slow.
pub(super) struct PacedBody<B> {
    body: B,
    window: Duration,
    /// Bytes that a window must bring.
    least_bytes: u64,
    /// The present window: bytes that came, time spent waiting, and since when the service waits now.
    bytes: u64,
    waited: Duration,
    waiting_since: Option<Instant>,
    /// Whether it failed: then it brings nothing more, so that nobody waits for the rest.
    failed: bool,
    /// Made with the first wait: most requests have no body to wait for.
    timer: Option<Pin<Box<Sleep>>>,
}

impl<B> PacedBody<B> {
    pub(super) fn new(body: B, limits: &ConnectionLimits) -> Self {
        let least = limits.min_body_bytes_per_s as f64 * limits.body_window.as_secs_f64();
        Self {
            body,
            window: limits.body_window,
            least_bytes: least.ceil() as u64,
            bytes: 0,
            waited: Duration::ZERO,
            waiting_since: None,
            failed: false,
            timer: None,
        }
    }

    /// Ends the present window once it is over; fails when it brought too little.
    fn turn(&mut self) -> Result<(), axum::Error> {
        if self.waited >= self.window {
            self.failed = self.bytes < self.least_bytes;
            (self.bytes, self.waited) = (0, Duration::ZERO);
        }
        if self.failed { Err(too_slow()) } else { Ok(()) }
    }

    /// Adds up the wait that ends now.
    fn stop_waiting(&mut self) {
        if let Some(since) = self.waiting_since.take() {
            self.waited += since.elapsed();
        }
    }
}

fn too_slow() -> axum::Error {
    axum::Error::new(io::Error::new(io::ErrorKind::TimedOut, "the body comes too slowly"))
}

impl<B> Body for PacedBody<B>
where
    B: Body<Data = Bytes> + Unpin,
    B::Error: Into<axum::BoxError>,
{
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        if this.failed {
            return Poll::Ready(Some(Err(too_slow())));
        }
        if let Poll::Ready(frame) = Pin::new(&mut this.body).poll_frame(context) {
            this.stop_waiting();
            let Some(frame) = frame else { return Poll::Ready(None) };
            let frame = frame.map_err(axum::Error::new)?;
            this.bytes += frame.data_ref().map_or(0, |data| data.len() as u64);
            return Poll::Ready(Some(this.turn().map(|()| frame)));
        }
        loop {
            let since = *this.waiting_since.get_or_insert_with(Instant::now);
            let until = since + this.window.saturating_sub(this.waited);
            let timer = this.timer.get_or_insert_with(|| Box::pin(sleep_until(until)));
            if timer.deadline() != until {
                timer.as_mut().reset(until);
            }
            ready!(timer.as_mut().poll(context));
            this.stop_waiting();
            // Timers are exact to the millisecond only.
            this.waited = this.waited.max(this.window);
            if let Err(error) = this.turn() {
                return Poll::Ready(Some(Err(error)));
            }
        }
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

#[cfg(test)]
mod tests {
    use axum::body::Body as AxumBody;
    use futures_util::{StreamExt, stream};

    use super::*;

    /// Ten chunks of so many bytes, one after every `pause`; how long the body lived and how many bytes came through.
    async fn read(chunk_bytes: usize, pause: Duration) -> (Duration, usize, bool) {
        let chunks = stream::iter(0..10).then(move |_| async move {
            tokio::time::sleep(pause).await;
            Ok::<_, io::Error>(Bytes::from(vec![0; chunk_bytes]))
        });
        let limits = ConnectionLimits {
            body_window: Duration::from_secs(30),
            min_body_bytes_per_s: 100,
            ..ConnectionLimits::default()
        };
        let mut body = AxumBody::new(PacedBody::new(AxumBody::from_stream(chunks), &limits)).into_data_stream();
        let (start, mut bytes) = (Instant::now(), 0);
        while let Some(chunk) = body.next().await {
            match chunk {
                Ok(chunk) => bytes += chunk.len(),
                Err(_) => return (start.elapsed(), bytes, false),
            }
        }
        (start.elapsed(), bytes, true)
    }

    #[tokio::test(start_paused = true)]
    async fn a_trickle_ends_with_the_window_and_a_slow_line_does_not() {
        let (lived, bytes, whole) = read(1, Duration::from_secs(1)).await;
        assert!(whole && bytes == 10, "over before the window is: {lived:?}");
        let (lived, bytes, whole) = read(10, Duration::from_secs(7)).await;
        assert_eq!((lived.as_secs(), bytes, whole), (30, 40, false));
        let (lived, bytes, whole) = read(1000, Duration::from_secs(9)).await;
        assert_eq!((lived.as_secs(), bytes, whole), (90, 10_000, true));
        let (lived, _, whole) = read(100_000, Duration::from_secs(31)).await;
        assert_eq!((lived.as_secs(), whole), (30, false), "nothing at all");
    }

    /// The service's own work between two chunks is not held against the sender.
    #[tokio::test(start_paused = true)]
    async fn a_sender_that_is_kept_waiting_is_not_slow() {
        let chunks = stream::iter((0..10).map(|_| Ok::<_, io::Error>(Bytes::from_static(b"x"))));
        let limits = ConnectionLimits { body_window: Duration::from_secs(1), ..ConnectionLimits::default() };
        let mut body = AxumBody::new(PacedBody::new(AxumBody::from_stream(chunks), &limits)).into_data_stream();
        let mut bytes = 0;
        while let Some(chunk) = body.next().await {
            bytes += chunk.map_or(0, |chunk| chunk.len());
            tokio::time::sleep(Duration::from_secs(5)).await;
        }
        assert_eq!(bytes, 10);
    }
}
