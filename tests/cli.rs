//! The binary, run as a person would.

#![allow(clippy::unwrap_used)]

mod program;

#[path = "cli/bad_pictures.rs"]
mod bad_pictures;
#[path = "cli/degenerate.rs"]
mod degenerate;
#[path = "cli/determinism.rs"]
mod determinism;
#[path = "cli/evaluate.rs"]
mod evaluate;
#[path = "cli/feature_street.rs"]
mod feature_street;
#[path = "cli/look_alikes.rs"]
mod look_alikes;
#[path = "cli/reconstruct.rs"]
mod reconstruct;
#[path = "cli/rendered.rs"]
mod rendered;
#[path = "cli/synthesize.rs"]
mod synthesize;
#[path = "cli/token.rs"]
mod token;
#[path = "cli/trial.rs"]
mod trial;
#[path = "cli/zoomed.rs"]
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
