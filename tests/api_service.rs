//! The HTTP interface, request by request, on a real listener with a quick engine. One binary, one file per resource.

#![allow(clippy::unwrap_used)]

mod service;

#[path = "service/access.rs"]
mod access;
#[path = "service/datasets.rs"]
mod datasets;
#[path = "service/events.rs"]
mod events;
#[path = "service/job_images.rs"]
mod job_images;
#[path = "service/jobs.rs"]
mod jobs;
#[path = "service/outputs.rs"]
mod outputs;
#[path = "service/page.rs"]
mod page;
#[path = "service/queue.rs"]
mod queue;
#[path = "service/webhooks.rs"]
mod webhooks;
