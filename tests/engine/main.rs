//! The engine as programs and people use it: the binary's commands, runs that are stopped and go on, and the files it
//! writes and reads.

#![allow(clippy::unwrap_used)]

mod bad_pictures;
mod checkpoints;
mod degenerate;
mod determinism;
mod evaluate;
mod feature_street;
mod formats;
mod look_alikes;
mod reconstruct;
mod rendered;
mod synthesize;
mod trial;
mod zoomed;

use std::process::{Command, Output};

/// Runs the binary with these arguments.
fn multistage(args: &[&str]) -> Output {
    Command::new(env!("CARGO_BIN_EXE_multistage")).args(args).output().unwrap()
}

/// The binary's exit code and standard error.
fn failure(args: &[&str]) -> (i32, String) {
    let output = multistage(args);
    (output.status.code().unwrap(), String::from_utf8(output.stderr).unwrap())
}

#[test]
fn bad_arguments_end_with_status_2() {
    for args in [&[][..], &["paint"], &["evaluate", "one"], &["evaluate", "a", "b", "--loud"]] {
        assert_eq!(failure(args).0, 2, "{args:?}");
    }
    assert!(multistage(&["--version"]).status.success());
    assert!(multistage(&["evaluate", "--help"]).status.success());
}
