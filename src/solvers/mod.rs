//! Minimal and linear solvers, one file each.
