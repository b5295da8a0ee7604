//! A conformance suite for tus 1.0.0, from the outside: it knows addresses and headers, nothing of the server's inside.
//!
//! With `MULTISTAGE_TUS_ENDPOINT` set to the address of another server's upload resource it runs against that one; what only
//! Multistage promises (datasets, expiry settings) then starts a Multistage of its own all the same.

#![allow(clippy::unwrap_used)]

mod service;

#[path = "tus/checksum.rs"]
mod checksum;
#[path = "tus/client.rs"]
mod client;
#[path = "tus/concatenation.rs"]
mod concatenation;
#[path = "tus/core.rs"]
mod core;
#[path = "tus/creation.rs"]
mod creation;
#[path = "tus/datasets.rs"]
mod datasets;
#[path = "tus/expiration.rs"]
mod expiration;
#[path = "tus/faults.rs"]
mod faults;
#[path = "tus/offsets.rs"]
mod offsets;
#[path = "tus/overrides.rs"]
mod overrides;
#[path = "tus/termination.rs"]
mod termination;
#[path = "tus/whole.rs"]
mod whole;
