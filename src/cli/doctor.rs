//! `multistage doctor`: whether a data directory is whole.

use std::path::PathBuf;

use super::Failure;
use super::data_dir::{block_on, existing_database, outside};
use crate::store::{DataDir, Db, Finding, examine};

/// Arguments of `multistage doctor`.
#[derive(Debug, clap::Args)]
pub(super) struct Args {
    /// The service's directory.
    #[arg(long, env = "MULTISTAGE_DATA_DIR", default_value = "./multistage-data")]
    data_dir: PathBuf,
    /// Read every file and compare its hash, not only its length.
    #[arg(long)]
    bytes: bool,
    /// Move what belongs to nobody to `quarantine/`, where it stays for a week. The service must not run.
    #[arg(long)]
    quarantine: bool,
}

/// Runs the command.
pub(super) fn run(args: &Args) -> Result<(), Failure> {
    block_on(look(args))
}

async fn look(args: &Args) -> Result<(), Failure> {
    let outside = outside(&args.data_dir);
    let database = existing_database(&args.data_dir)?;
    // Before looking: what a running service is about to store must not be taken for an orphan.
    let own =
        if args.quarantine { Some(DataDir::open(&args.data_dir).map_err(|error| outside(&error))?) } else { None };
    let db = Db::open(&database).await.map_err(|error| outside(&error))?;
    let findings = examine(&db, &args.data_dir, args.bytes).await.map_err(|error| outside(&error))?;
    db.close().await;
    let mut wrong = 0;
    for finding in &findings {
        match finding {
            Finding::Database(what) => println!("database\t{what}"),
            Finding::Missing(path) => println!("missing\t{path}"),
            Finding::Damaged(path) => println!("damaged\t{path}"),
            Finding::Orphan(path) => match &own {
                Some(data) => {
                    let place = data.put_into_quarantine(path).map_err(|error| outside(&error))?;
                    println!("orphan\t{path}\tnow {}", place.display());
                    continue;
                }
                None => println!("orphan\t{path}"),
            },
        }
        wrong += 1;
    }
    match wrong {
        0 => {
            println!("all is well");
            Ok(())
        }
        count => Err(Failure::Outside(format!("{count} things are not as they should be"))),
    }
}
