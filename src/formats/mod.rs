//! Bytes to domain types and back, over `Read` and `Write`: no paths, no policy.

pub mod report;
