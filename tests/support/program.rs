//! The real program on a data directory of its own, to be killed. Unless it is told otherwise, it listens on a free
//! port of this machine, has two threads and logs errors alone.
#![allow(dead_code, reason = "every test binary uses its own part")]

use std::io::{BufRead, BufReader};
use std::path::Path;
use std::process::{Child, ChildStdout, Command, ExitStatus, Stdio};

/// The running program; it ends with this value at the latest.
pub struct Program {
    child: Child,
    /// Its address, without a slash at the end.
    pub base: String,
    /// What it says after that.
    pub output: BufReader<ChildStdout>,
}

impl Program {
    /// Starts it and waits until it listens.
    pub fn start(data_dir: &Path) -> Self {
        Self::start_with(data_dir, &[])
    }

    /// The same with further arguments.
    pub fn start_with(data_dir: &Path, arguments: &[&str]) -> Self {
        Self::start_logging(data_dir, arguments, Stdio::inherit())
    }

    /// The same, with its log to there.
    pub fn start_logging(data_dir: &Path, arguments: &[&str], log: impl Into<Stdio>) -> Self {
        Self::start_as(Command::new(env!("CARGO_BIN_EXE_multistage")), data_dir, arguments, log)
    }

    /// The same, with so much of it in the log as `level` says.
    pub fn start_logging_at(level: &str, data_dir: &Path, arguments: &[&str], log: impl Into<Stdio>) -> Self {
        let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
        command.env("RUST_LOG", level);
        Self::start_as(command, data_dir, arguments, log)
    }

    /// The same by another command, which ends with the program's name and may say what goes to the log.
    pub fn start_as(mut command: Command, data_dir: &Path, arguments: &[&str], log: impl Into<Stdio>) -> Self {
        if !command.get_envs().any(|(name, _)| name == "RUST_LOG") {
            command.env("RUST_LOG", "error");
        }
        let mut child = command
            // Arguments override these.
            .env("MULTISTAGE_BIND", "127.0.0.1:0")
            .env("MULTISTAGE_THREADS", "2")
            .args(["serve", "--data-dir"])
            .arg(data_dir)
            .args(arguments)
            .stderr(log)
            .stdout(Stdio::piped())
            .spawn()
            .unwrap();
        let mut line = String::new();
        let mut output = BufReader::new(child.stdout.take().unwrap());
        output.read_line(&mut line).unwrap();
        let base = line.trim().strip_prefix("listening on ").unwrap_or_else(|| panic!("{line:?}"));
        Self { base: base.trim_end_matches('/').to_owned(), output, child }
    }

    /// Starts it and does not wait for anything.
    pub fn spawn(data_dir: &Path) -> Child {
        Command::new(env!("CARGO_BIN_EXE_multistage"))
            .args(["serve", "--bind", "127.0.0.1:0", "--data-dir"])
            .arg(data_dir)
            .env("RUST_LOG", "error")
            .stdout(Stdio::null())
            .spawn()
            .unwrap()
    }

    /// The process.
    pub fn id(&self) -> u32 {
        self.child.id()
    }

    /// How it ended, once it has.
    pub fn ended(&mut self) -> Option<ExitStatus> {
        self.child.try_wait().unwrap()
    }

    /// Waits until it has ended.
    pub fn wait_for_end(&mut self) {
        self.child.wait().unwrap();
    }

    /// As `kill -9`: no time for anything.
    pub fn kill(mut self) {
        self.child.kill().unwrap();
        self.child.wait().unwrap();
    }
}

impl Drop for Program {
    fn drop(&mut self) {
        // Already gone after `kill`.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}
