//! `multistage reconstruct IMAGES_DIR --out OUT_DIR`: the whole pipeline in the foreground.

use std::path::PathBuf;
use std::sync::Arc;

use super::progress::TerminalProgress;
use super::{Failure, options};
use crate::formats::report::{ImageState, Report};
use crate::pipeline::{CancelFlag, Context, PipelineError, ReconstructionOptions, RunPaths, reconstruct};

/// Arguments of `reconstruct`.
#[derive(Debug, clap::Args)]
#[command(after_help = "Exit status: 0 a model was made; 1 something outside failed; 2 bad arguments or input; 3 the \
photographs gave no model (OUT_DIR/report.html says why); 130 interrupted (the same command goes on from its last finished unit \
of work).")]
pub struct Args {
    /// Folder of photographs (JPEG, PNG, TIFF, WebP), with sub-folders.
    images_dir: PathBuf,
    /// Folder for the outputs; made if it does not exist.
    #[arg(long, value_name = "OUT_DIR")]
    out: PathBuf,
    /// Options as a JSON file; what it leaves out keeps its default.
    #[arg(long, value_name = "FILE.json")]
    options: Option<PathBuf>,
    /// Set one option, for example --set iterations=1; may be repeated, and goes over the file.
    #[arg(long = "set", value_name = "KEY=VALUE")]
    sets: Vec<String>,
    /// Print all options with their values as JSON, and do nothing else.
    #[arg(long)]
    print_options: bool,
    /// Worker threads; the result does not depend on it. Default: one for each processor.
    #[arg(long, value_parser = clap::value_parser!(u16).range(1..=1024))]
    threads: Option<u16>,
    /// Seed of everything random; the same seed gives the same bytes.
    #[arg(long, default_value_t = 0)]
    seed: u64,
    /// Folder for the results of stages, from which an interrupted run goes on; kept. Default: OUT_DIR/.work, removed when
    /// the run is done.
    #[arg(long, value_name = "DIR")]
    work_dir: Option<PathBuf>,
    /// Show no progress and no summary.
    #[arg(long, short)]
    quiet: bool,
}

/// Runs the command.
pub fn run(args: Args) -> Result<(), Failure> {
    let options = read_options(&args)?;
    if args.print_options {
        let json = serde_json::to_string_pretty(&options).map_err(|error| Failure::Outside(error.to_string()))?;
        println!("{json}");
        return Ok(());
    }
    let paths = RunPaths {
        work_dir: args.work_dir.clone().unwrap_or_else(|| args.out.join(".work")),
        images_dir: args.images_dir,
        out_dir: args.out,
    };
    let threads = args
        .threads
        .map_or_else(|| std::thread::available_parallelism().map_or(1, std::num::NonZeroUsize::get), usize::from);
    let cancel = CancelFlag::default();
    cancel_on_interrupt(&cancel);
    let progress = Arc::new(TerminalProgress::new(args.quiet));
    let context = Context { seed: args.seed, threads, cancel, progress };
    let report = reconstruct(&paths, &options, &context).map_err(|error| match error {
        PipelineError::Cancelled => Failure::Interrupted,
        PipelineError::InvalidOptions(_) | PipelineError::InvalidInput { .. } => Failure::Input(error.to_string()),
        PipelineError::Io { .. } => Failure::Outside(error.to_string()),
    })?;
    if args.work_dir.is_none()
        && let Err(error) = std::fs::remove_dir_all(&paths.work_dir)
    {
        eprintln!("warning: {} could not be removed: {error}", paths.work_dir.display());
    }
    if !args.quiet {
        summarize(&report);
        println!("Outputs: {}", paths.out_dir.display());
    }
    if report.models.is_empty() { Err(Failure::NoModel) } else { Ok(()) }
}

fn read_options(args: &Args) -> Result<ReconstructionOptions, Failure> {
    let file = match &args.options {
        None => None,
        Some(path) => {
            let text = std::fs::read_to_string(path)
                .map_err(|error| Failure::Input(format!("{}: {error}", path.display())))?;
            let json =
                serde_json::from_str(&text).map_err(|error| Failure::Input(format!("{}: {error}", path.display())))?;
            Some(json)
        }
    };
    let options: ReconstructionOptions = options::merged(file, &args.sets).map_err(Failure::Input)?;
    options.validate().map_err(|error| Failure::Input(error.to_string()))?;
    Ok(options)
}

/// The first interrupt asks the run to stop at its next unit of work; the second ends the process at once.
fn cancel_on_interrupt(cancel: &CancelFlag) {
    let cancel = cancel.clone();
    let listen = move || {
        let Ok(runtime) = tokio::runtime::Builder::new_current_thread().enable_io().build() else { return };
        runtime.block_on(async {
            if tokio::signal::ctrl_c().await.is_ok() {
                eprintln!("Stopping; interrupt again to stop at once.");
                cancel.cancel();
                if tokio::signal::ctrl_c().await.is_ok() {
                    std::process::exit(i32::from(Failure::Interrupted.exit_code()));
                }
            }
        });
    };
    // Without this thread, an interrupt ends the process as usual.
    let _ = std::thread::Builder::new().name("interrupt".into()).spawn(listen);
}

fn summarize(report: &Report) {
    for model in &report.models {
        let error = model.mean_reprojection_error_px.map_or_else(|| "unknown".into(), |error| format!("{error:.3} px"));
        println!(
            "Model {}: {} photographs, {} points, mean reprojection error {error}",
            model.id, model.images, model.points
        );
    }
    let left_out: Vec<_> = report.images.iter().filter(|image| image.state != ImageState::Registered).collect();
    if !left_out.is_empty() {
        println!("Left out, {} of {} photographs:", left_out.len(), report.images.len());
    }
    for image in left_out {
        let reason = image.reason.as_deref().unwrap_or("unknown");
        println!("  {} [{reason}] {}", image.name, image.advice.as_deref().unwrap_or_default());
    }
    for note in &report.notes {
        println!("Note: {note}");
    }
    println!("Time {:.1} s, processor time {:.1} s", report.wall_s, report.cpu_s);
}
