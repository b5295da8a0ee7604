//! Tests that measure time and memory of the service, one after the other ([`alone`]).

#![allow(clippy::unwrap_used)]

#[path = "../support/program.rs"]
mod program;
#[path = "../support/service.rs"]
mod service;

mod cancel;
mod load;
mod slow_clients;
mod tokens;

use tokio::sync::{Mutex, MutexGuard};

/// Held by a test while it measures: no other of this program runs beside it.
async fn alone() -> MutexGuard<'static, ()> {
    static MEASURING: Mutex<()> = Mutex::const_new(());
    MEASURING.lock().await
}
