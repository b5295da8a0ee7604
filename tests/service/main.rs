//! The HTTP interface on a real listener, in the tests' own process and with a quick engine: request by request, one
//! file per resource; its contract, the clients that others wrote, and what nobody in good faith sends.

#![allow(clippy::unwrap_used)]

#[path = "../support/program.rs"]
mod program;
#[path = "../support/service.rs"]
mod service;

mod access;
mod datasets;
mod events;
mod hostile;
mod job_images;
mod jobs;
mod nodeodm;
mod openapi;
mod outputs;
mod page;
mod parsers;
mod queue;
mod tus;
mod upload_clients;
mod webhooks;
