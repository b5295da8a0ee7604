//! Formats seen from outside: photographs of every kind and oddity.

#![allow(clippy::unwrap_used)]

#[path = "formats/photographs.rs"]
mod photographs;
