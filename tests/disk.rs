//! Disks that are full or broken, and machines that are too small: what was acknowledged stays, what can't be stored is refused by
//! name, deleting works, and work goes on by itself once there is room.
//!
//! `MULTISTAGE_FAULTS=500 cargo test --locked --test disk -- --nocapture` lets each of the first 500 writes fail, with either error.

#![allow(clippy::unwrap_used)]

mod program;
mod service;

#[path = "disk/faults.rs"]
mod faults;
#[path = "disk/small_disk.rs"]
mod small_disk;
#[path = "disk/small_machine.rs"]
mod small_machine;
