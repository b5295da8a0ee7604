//! What is kept no longer: jobs that ended long ago, and datasets that nothing has used for as long.

use std::time::Duration;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::deletion::remove_job;
use crate::store::StoreError;
use crate::store::db::{Db, datasets, jobs, now_ms};

/// A thing that is kept no longer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Stale {
    /// A job that ended.
    Job(Uuid),
    /// A dataset that no job uses.
    Dataset(Uuid),
}

/// What nobody has used for `keep`.
///
/// # Errors
/// What the store said.
pub async fn find_stale(db: &Db, keep: Duration) -> Result<Vec<Stale>, StoreError> {
    let mut tx = db.write().await?;
    let found = remove_rows(&mut tx, keep).await?;
    // Only to see what would go.
    tx.rollback().await?;
    Ok(found)
}

/// Removes the rows of what nobody has used for `keep`; their folders are noted to go.
///
/// # Errors
/// What the store said.
pub async fn remove_stale(db: &Db, keep: Duration) -> Result<Vec<Stale>, StoreError> {
    let mut tx = db.write().await?;
    let found = remove_rows(&mut tx, keep).await?;
    tx.commit().await?;
    Ok(found)
}

async fn remove_rows(tx: &mut SqliteConnection, keep: Duration) -> Result<Vec<Stale>, StoreError> {
    let before_ms = now_ms().saturating_sub(i64::try_from(keep.as_millis()).unwrap_or(i64::MAX));
    let mut found = Vec::new();
    for id in jobs::ended_before(&mut *tx, before_ms).await? {
        let Ok(id) = id.parse() else { continue };
        let own = remove_job(tx, id).await?;
        found.push(Stale::Job(id));
        found.extend(own.map(Stale::Dataset));
    }
    // After the jobs: the last job of a dataset may be gone only now.
    for id in datasets::unused_since(&mut *tx, before_ms).await? {
        let Ok(id) = id.parse() else { continue };
        datasets::delete(tx, id).await?;
        found.push(Stale::Dataset(id));
    }
    Ok(found)
}
