//! The `multistage` binary.

fn main() {}
