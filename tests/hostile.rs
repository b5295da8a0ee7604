//! What nobody in good faith sends: each is refused with a problem that says what is wrong, quickly and in little memory, and the
//! service goes on. Never an answer of the 500s.

#![allow(clippy::unwrap_used)]

mod service;

#[path = "hostile/archives.rs"]
mod archives;
#[path = "hostile/multipart.rs"]
mod multipart;
#[path = "hostile/options.rs"]
mod options;
#[path = "hostile/pictures.rs"]
mod pictures;
