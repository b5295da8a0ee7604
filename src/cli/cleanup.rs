//! `multistage cleanup`: removes what nobody has used for long. Works while the service runs.

use std::path::PathBuf;
use std::time::Duration;

use super::Failure;
use super::data_dir::{block_on, existing_database, outside};
use crate::jobs::{Stale, find_stale, remove_stale};
use crate::store::{DataDir, Db, Store};

/// Arguments of `multistage cleanup`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The service's directory.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data")]
    data_dir: PathBuf,
    /// Removes jobs that ended, and datasets that nothing has used, more than so many days ago.
    #[arg(long)]
    keep_days: u32,
    /// Say what would go, and remove nothing.
    #[arg(long)]
    dry_run: bool,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    block_on(clean_up(args))
}

async fn clean_up(args: &Args) -> Result<(), Failure> {
    let outside = outside(&args.data_dir);
    let database = existing_database(&args.data_dir)?;
    let keep = Duration::from_secs(24 * 3600 * u64::from(args.keep_days));
    let db = Db::open(&database).await.map_err(|error| outside(&error))?;
    let stale = find_stale(&db, keep).await.map_err(|error| outside(&error))?;
    let mut bytes = 0;
    for thing in &stale {
        let (kind, id) = match thing {
            Stale::Job(id) => ("job", id),
            Stale::Dataset(id) => ("dataset", id),
        };
        let size =
            DataDir::folder_bytes(&args.data_dir.join(format!("{kind}s/{id}"))).map_err(|error| outside(&error))?;
        bytes += size;
        println!("{kind}\t{id}\t{size}");
    }
    let verb = if args.dry_run { "would be removed" } else { "removed" };
    println!("{} things of {bytes} bytes {verb}", stale.len());
    if !args.dry_run {
        remove_stale(&db, keep).await.map_err(|error| outside(&error))?;
    }
    db.close().await;
    if !args.dry_run {
        // A running service removes the folders within a minute.
        if let Ok(store) = Store::open(&args.data_dir).await {
            store.discard_deleted().await.map_err(|error| outside(&error))?;
            store.db.close().await;
        }
    }
    Ok(())
}
