//! The command line: one file per command.
//!
//! Exit status: 0 done (for `reconstruct`: a model was made); 1 something outside failed, such as a full disk; 2 bad
//! arguments or input; 3 the photographs gave no model; 130 interrupted.

mod backup;
mod cleanup;
mod data_dir;
mod demo;
mod doctor;
mod evaluate;
mod model_poses;
mod options;
mod progress;
mod reconstruct;
mod serve;
mod synthesize;
mod token;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

#[derive(Debug, Parser)]
#[command(
    name = "multistage",
    version,
    about = "Photographs of a place or an object to camera poses and a 3D point cloud"
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Copy the service's directory while it runs.
    Backup(backup::Args),
    /// Look whether the service's directory is whole.
    Doctor(doctor::Args),
    /// Remove what nobody has used for long.
    Cleanup(cleanup::Args),
    /// Make a model of the photographs in a folder.
    Reconstruct(reconstruct::Args),
    /// Photograph a synthetic temple, reconstruct it by the service, and keep serving.
    Demo(demo::Args),
    /// Measure the camera poses of a model against a reference.
    Evaluate(evaluate::Args),
    /// Run the web service, with its page.
    Serve(serve::Args),
    /// Make photographs or features of a scene whose truth is known.
    Synthesize(synthesize::Args),
    /// Make, list and revoke the tokens that open the service.
    Token(token::Args),
}

/// How a command ended otherwise than well.
#[derive(Debug)]
enum Failure {
    /// Bad arguments or input.
    Input(String),
    /// The photographs gave no model.
    NoModel,
    /// Something outside failed.
    Outside(String),
    /// Somebody asked to stop.
    Interrupted,
}

impl Failure {
    fn exit_code(&self) -> u8 {
        match self {
            Self::Outside(_) => 1,
            Self::Input(_) => 2,
            Self::NoModel => 3,
            Self::Interrupted => 130,
        }
    }
}

/// Parses the arguments, runs the command, and says how it went.
pub fn run() -> ExitCode {
    let result = match Cli::parse().command {
        Command::Backup(args) => backup::run(&args),
        Command::Doctor(args) => doctor::run(&args),
        Command::Cleanup(args) => cleanup::run(&args),
        Command::Reconstruct(args) => reconstruct::run(args),
        Command::Demo(args) => demo::run(&args),
        Command::Evaluate(args) => evaluate::run(&args),
        Command::Serve(args) => serve::run(&args),
        Command::Synthesize(args) => synthesize::run(&args),
        Command::Token(args) => token::run(&args),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(failure) => {
            match &failure {
                Failure::Input(message) | Failure::Outside(message) => eprintln!("error: {message}"),
                Failure::NoModel => eprintln!("The photographs gave no model; the report says why."),
                Failure::Interrupted => {
                    eprintln!("Interrupted; the same command goes on from the last finished stage.")
                }
            }
            ExitCode::from(failure.exit_code())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    #[test]
    fn the_definition_is_consistent() {
        Cli::command().debug_assert();
    }
}
