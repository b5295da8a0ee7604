//! Formats seen from outside.

mod models;
mod photographs;
mod report_html;
