//! `multistage backup`: a copy of the data directory, while the service runs.

use std::path::PathBuf;

use super::Failure;
use super::data_dir::{block_on, existing_database, outside};
use crate::store::{Db, back_up};

/// Arguments of `multistage backup`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The service's directory.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data")]
    data_dir: PathBuf,
    /// Where the copy goes; an earlier copy there is brought up to date. To restore, serve the copy.
    #[arg(long)]
    to: PathBuf,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    block_on(copy(args))
}

async fn copy(args: &Args) -> Result<(), Failure> {
    let outside = outside(&args.data_dir);
    let database = existing_database(&args.data_dir)?;
    let db = Db::open(&database).await.map_err(|error| outside(&error))?;
    let account = back_up(&db, &args.data_dir, &args.to).await.map_err(|error| outside(&error))?;
    db.close().await;
    println!("{} files of {} bytes and the database are in {}", account.files, account.bytes, args.to.display());
    Ok(())
}
