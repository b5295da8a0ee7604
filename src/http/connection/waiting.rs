//! Which connections wait for a request, in the order in which they began to.

use std::collections::BTreeMap;
use std::pin::Pin;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::task::{Context, Poll};

use axum::body::{Body, Bytes};
use hyper::body::{Body as HttpBody, Frame, SizeHint};
use tokio::sync::Notify;

/// The connections without a request under way.
#[derive(Debug, Default)]
pub(super) struct Waiting(Mutex<Queue>);

#[derive(Debug, Default)]
struct Queue {
    next: u64,
    waiting: BTreeMap<u64, Arc<Notify>>,
}

impl Waiting {
    fn queue(&self) -> MutexGuard<'_, Queue> {
        // A panic elsewhere can't leave the queue half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Closes the connection that has waited longest, if one waits.
    pub(super) fn dismiss_longest(&self) {
        if let Some((_, dismissed)) = self.queue().waiting.pop_first() {
            dismissed.notify_one();
        }
    }
}

/// A connection's place in the queue.
#[derive(Debug)]
pub(super) struct Place {
    waiting: Arc<Waiting>,
    dismissed: Arc<Notify>,
    /// Its number while it waits.
    number: Mutex<Option<u64>>,
}

impl Place {
    /// A new connection waits for its first request.
    pub(super) fn new(waiting: &Arc<Waiting>) -> Self {
        let place = Self { waiting: Arc::clone(waiting), dismissed: Arc::default(), number: Mutex::default() };
        place.wait();
        place
    }

    /// Notified when the connection must make room.
    pub(super) fn dismissed(&self) -> Arc<Notify> {
        Arc::clone(&self.dismissed)
    }

    fn number(&self) -> MutexGuard<'_, Option<u64>> {
        self.number.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn wait(&self) {
        let mut queue = self.waiting.queue();
        let number = queue.next;
        queue.next += 1;
        queue.waiting.insert(number, Arc::clone(&self.dismissed));
        *self.number() = Some(number);
    }

    fn leave(&self) {
        if let Some(number) = self.number().take() {
            self.waiting.queue().waiting.remove(&number);
        }
    }
}

impl Drop for Place {
    fn drop(&mut self) {
        self.leave();
    }
}

/// A request under way: its connection can't be dismissed meanwhile.
#[derive(Debug)]
pub(super) struct Busy(Arc<Place>);

impl Busy {
    pub(super) fn begin(place: &Arc<Place>) -> Self {
        place.leave();
        Self(Arc::clone(place))
    }
}

impl Drop for Busy {
    fn drop(&mut self) {
        self.0.wait();
    }
}

/// The body of an answer: the request is under way until it is sent.
#[derive(Debug)]
pub(super) struct HeldBody {
    body: Body,
    _busy: Busy,
}

impl HeldBody {
    pub(super) fn new(body: Body, busy: Busy) -> Self {
        Self { body, _busy: busy }
    }
}

impl HttpBody for HeldBody {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        context: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        HttpBody::poll_frame(Pin::new(&mut self.body), context)
    }

    fn is_end_stream(&self) -> bool {
        HttpBody::is_end_stream(&self.body)
    }

    fn size_hint(&self) -> SizeHint {
        HttpBody::size_hint(&self.body)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_longest_waiting_goes_first_and_the_busy_stay() {
        let waiting = Arc::new(Waiting::default());
        let places: Vec<_> = (0..3).map(|_| Arc::new(Place::new(&waiting))).collect();
        let order = |waiting: &Waiting| {
            let queue = waiting.queue();
            let at = |notify: &Arc<Notify>| places.iter().position(|place| Arc::ptr_eq(&place.dismissed, notify));
            queue.waiting.values().map(at).collect::<Vec<_>>()
        };
        let busy = Busy::begin(&places[0]);
        assert_eq!(order(&waiting), [Some(1), Some(2)]);
        drop(busy);
        assert_eq!(order(&waiting), [Some(1), Some(2), Some(0)], "it waits anew");
        waiting.dismiss_longest();
        assert_eq!(order(&waiting), [Some(2), Some(0)]);
        drop(places);
        assert!(waiting.queue().waiting.is_empty());
        waiting.dismiss_longest();
    }
}
