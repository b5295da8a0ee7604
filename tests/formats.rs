//! Formats seen from outside: photographs of every kind and oddity.

#[path = "formats/photographs.rs"]
mod photographs;
