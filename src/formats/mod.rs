//! Bytes to domain types and back, over `Read` and `Write`: no paths, no policy.

pub mod exif;
pub mod photograph;
pub mod report;
