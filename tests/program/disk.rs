//! Disks that are full or broken, and machines that are too small: what was acknowledged stays, what can't be stored is
//! refused by name, deleting works, and work goes on by itself once there is room.
//!
//! `MULTISTAGE_FAULTS=500 cargo test --locked --test program disk -- --nocapture` lets each of the first 500 writes
//! fail, with either error.

mod faults;
mod small_disk;
mod small_machine;
