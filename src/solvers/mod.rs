//! Minimal and linear solvers, one file each. Each head gives the equations and where they come from.
//!
//! Solvers allocate nothing and return few candidates ([`Solutions`]); a degenerate sample gives none.

pub mod eight_point;
pub mod five_point;
pub mod homography;
mod normalization;
mod null_space;
pub mod p3p;
pub mod p4pf;
pub mod seven_point;
mod solutions;
#[cfg(test)]
pub(crate) mod test_scenes;

pub use solutions::Solutions;
