//! The routes, one file per resource; each owns its router, bodies and handlers.

pub(super) mod datasets;
pub(super) mod job_events;
pub(super) mod job_images;
pub(super) mod jobs;
pub(super) mod outputs;
pub(super) mod service;
pub(super) mod uploads;
pub(super) mod webhooks;
