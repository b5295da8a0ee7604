//! Bytes to domain types and back, over `Read` and `Write`: no paths, no policy.

pub mod bundler;
pub mod colmap;
mod error;
pub mod exif;
pub mod features;
pub mod photograph;
pub mod ply;
pub mod poses;
pub mod report;
pub mod report_html;
mod shortest;
pub mod stored_zip;

pub use error::FormatError;
