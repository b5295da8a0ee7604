//! Formats seen from outside.

#![allow(clippy::unwrap_used)]

#[path = "formats/models.rs"]
mod models;
#[path = "formats/photographs.rs"]
mod photographs;
#[path = "formats/report_html.rs"]
mod report_html;
