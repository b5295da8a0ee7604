//! A conformance suite for tus 1.0.0, from the outside: it knows addresses and headers, nothing of the server's inside.
//!
//! With `MULTISTAGE_TUS_ENDPOINT` set to the address of another server's upload resource it runs against that one; what only
//! Multistage promises (datasets, expiry settings) then starts a Multistage of its own all the same.

mod checksum;
mod client;
mod concatenation;
mod core;
mod creation;
mod datasets;
mod expiration;
mod faults;
mod offsets;
mod overrides;
mod termination;
mod whole;
