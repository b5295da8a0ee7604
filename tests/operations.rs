//! What those who run the service do with it: stop and start it, look after its directory, copy it, read its log and figures.

#![allow(clippy::unwrap_used)]

mod program;
mod service;

#[path = "operations/directory.rs"]
mod directory;
#[path = "operations/migrations.rs"]
mod migrations;
#[path = "operations/process.rs"]
mod process;
