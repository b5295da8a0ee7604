//! What the commands that work on a data directory, beside the service, begin with.

use std::fmt::Display;
use std::future::Future;
use std::path::{Path, PathBuf};

use super::Failure;
use crate::store::DataDir;

/// Runs a command's work to its end, on this thread.
pub(super) fn block_on(work: impl Future<Output = Result<(), Failure>>) -> Result<(), Failure> {
    let runtime = tokio::runtime::Builder::new_current_thread()
        .enable_all()
        .build()
        .map_err(|error| Failure::Outside(format!("can't start the runtime: {error}")))?;
    runtime.block_on(work)
}

/// A failure of what lies in a data directory.
pub(super) fn outside(data_dir: &Path) -> impl Fn(&dyn Display) -> Failure {
    move |error| Failure::Outside(format!("{}: {error}", data_dir.display()))
}

/// The database of a data directory that is there already.
pub(super) fn existing_database(data_dir: &Path) -> Result<PathBuf, Failure> {
    let database = DataDir::database_in(data_dir);
    if database.exists() {
        Ok(database)
    } else {
        Err(Failure::Input(format!("{}: there is no data directory", data_dir.display())))
    }
}
