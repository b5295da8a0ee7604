//! Datasets that take photographs now, as far as that is known without asking the database.
//!
//! Which datasets there are and which of them jobs use changes in transactions of their own alone, never in the group
//! commits of photographs and uploads. So what the database said once holds until the next such transaction: of many
//! photographs in a row only the first asks. Whoever writes the row asks again, within its transaction.

use std::collections::HashSet;
use std::sync::{Mutex, MutexGuard, PoisonError};

use uuid::Uuid;

use super::placing::check_writable;
use super::{Db, StoreError};

/// Datasets that took photographs when the database had changed so often.
#[derive(Debug, Default)]
pub(super) struct Writable(Mutex<(u64, HashSet<Uuid>)>);

impl Writable {
    fn known(&self) -> MutexGuard<'_, (u64, HashSet<Uuid>)> {
        // A panic elsewhere can't leave a set that says too much.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Fails unless photographs may be added to a dataset now.
    pub(super) async fn check(&self, db: &Db, dataset: Uuid) -> Result<(), StoreError> {
        let changes = db.changes();
        {
            let known = self.known();
            if known.0 == changes && known.1.contains(&dataset) {
                return Ok(());
            }
        }
        check_writable(&mut *db.reader().acquire().await?, dataset).await?;
        let mut known = self.known();
        if known.0 < changes {
            *known = (changes, HashSet::new());
        }
        if known.0 == changes {
            known.1.insert(dataset);
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::super::db::{datasets, jobs};
    use super::*;

    #[tokio::test]
    async fn what_was_known_holds_until_datasets_or_jobs_change() {
        let folder = tempfile::tempdir().unwrap();
        let db = Db::open(&folder.path().join("x.db")).await.unwrap();
        let (dataset, writable) = (Uuid::now_v7(), Writable::default());
        assert!(matches!(writable.check(&db, dataset).await, Err(StoreError::NotFound)));
        let mut tx = db.write().await.unwrap();
        datasets::insert(&mut tx, dataset, "", 1, None, None).await.unwrap();
        tx.commit().await.unwrap();
        writable.check(&db, dataset).await.unwrap();
        // Behind its back, to see that it does not ask.
        let mut tx = db.write_untimed().await.unwrap();
        datasets::delete(&mut tx, dataset).await.unwrap();
        tx.commit().await.unwrap();
        writable.check(&db, dataset).await.unwrap();
        let mut tx = db.write().await.unwrap();
        datasets::insert(&mut tx, dataset, "", 1, None, None).await.unwrap();
        let job = jobs::NewJobRow {
            id: Uuid::now_v7(),
            name: String::new(),
            created_ms: 1,
            dataset,
            options: "{}".to_owned(),
            ignored: None,
            priority: 0,
            owner_token: None,
        };
        jobs::insert(&mut tx, &job).await.unwrap();
        tx.commit().await.unwrap();
        assert!(matches!(writable.check(&db, dataset).await, Err(StoreError::DatasetInUse)));
        let mut tx = db.write().await.unwrap();
        jobs::delete(&mut tx, job.id).await.unwrap();
        datasets::delete(&mut tx, dataset).await.unwrap();
        tx.commit().await.unwrap();
        assert!(matches!(writable.check(&db, dataset).await, Err(StoreError::NotFound)));
    }
}
