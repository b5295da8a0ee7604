//! Room on the disk: what work may still fill, what running jobs have reserved, and a ballast that deleting can fall back on.

use std::collections::HashMap;
use std::fs::File;
use std::io;
use std::path::PathBuf;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

use uuid::Uuid;

use super::{DataDir, Store, StoreError, db};

/// Space that no work may fill, so that deleting and the database always work.
const RESERVE_BYTES: u64 = 32 << 20;
/// Kept as a file, to be given up when the disk is full in spite of that: what other programs write, nobody here can bound.
const BALLAST_BYTES: u64 = 8 << 20;
/// With less free beside it, the ballast is not made again.
const BALLAST_ABOVE_BYTES: u64 = 2 * RESERVE_BYTES;
/// What a job has written is looked up so often.
const LOOK_AGAIN: Duration = Duration::from_secs(5);

/// What running jobs have reserved.
#[derive(Debug, Default)]
pub struct Reservations(Mutex<HashMap<Uuid, Reservation>>);

#[derive(Clone, Debug)]
struct Reservation {
    /// Still to be written when it began.
    bytes: u64,
    /// Where, and what lay there then and when it was last looked at.
    folders: Vec<PathBuf>,
    before: u64,
    now: u64,
    looked: Instant,
}

fn size_of(folders: &[PathBuf]) -> io::Result<u64> {
    folders.iter().map(|folder| DataDir::folder_bytes(folder)).sum()
}

impl Reservations {
    fn all(&self) -> MutexGuard<'_, HashMap<Uuid, Reservation>> {
        // A panic elsewhere can't leave the map half changed.
        self.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Bytes reserved and not written yet.
    fn outstanding_bytes(&self) -> u64 {
        let mut all = self.all();
        for reservation in all.values_mut() {
            if reservation.looked.elapsed() > LOOK_AGAIN {
                // A folder that changes while it is looked at counts as it was.
                reservation.now = size_of(&reservation.folders).unwrap_or(reservation.now);
                reservation.looked = Instant::now();
            }
        }
        let left = |reservation: &Reservation| {
            reservation.bytes.saturating_sub(reservation.now.saturating_sub(reservation.before))
        };
        all.values().map(left).sum()
    }
}

/// Bytes that open uploads have announced and not sent yet. What the database said last is not too little until more is
/// announced.
#[derive(Debug, Default)]
pub(super) struct Promised {
    /// How often they grew.
    growths: AtomicU64,
    /// What the database said, and how often they had grown when it was asked.
    known: Mutex<Option<(u64, u64)>>,
}

impl Promised {
    /// To be called once the database knows of more.
    pub(super) fn grew(&self) {
        self.growths.fetch_add(1, Ordering::SeqCst);
    }

    /// As many at most; none when that is not known.
    fn at_most(&self) -> Option<u64> {
        let known = *self.known.lock().unwrap_or_else(PoisonError::into_inner);
        known.filter(|(_, growths)| *growths == self.growths.load(Ordering::SeqCst)).map(|(bytes, _)| bytes)
    }

    async fn ask(&self, db: &db::Db) -> sqlx::Result<u64> {
        let growths = self.growths.load(Ordering::SeqCst);
        let bytes = u64::try_from(db::uploads::outstanding_bytes(db.reader()).await?).unwrap_or(0);
        *self.known.lock().unwrap_or_else(PoisonError::into_inner) = Some((bytes, growths));
        Ok(bytes)
    }
}

impl Store {
    /// Keeps room for what a job has still to write to its folders, until it is [released](Self::release_space).
    pub fn reserve_space(&self, job: Uuid, folders: Vec<PathBuf>, bytes: u64) {
        let before = size_of(&folders).unwrap_or(0);
        let reservation = Reservation { bytes, folders, before, now: before, looked: Instant::now() };
        self.reservations.all().insert(job, reservation);
    }

    /// Removes artifacts of datasets that no job waits for or runs on: they only save time; whether there were any.
    ///
    /// # Errors
    /// What the system or SQLite said.
    pub async fn drop_idle_work(&self) -> Result<bool, StoreError> {
        let mut dropped = false;
        for dataset in db::datasets::without_active_job(self.db.reader()).await? {
            let Ok(dataset) = dataset.parse::<Uuid>() else { continue };
            let (data, work) = (self.data.clone(), self.data.work(dataset));
            if work.exists() {
                tokio::task::spawn_blocking(move || data.discard(&work)).await.map_err(io::Error::other)??;
                dropped = true;
            }
        }
        Ok(dropped)
    }

    /// Forgets what a job reserved.
    pub fn release_space(&self, job: Uuid) {
        self.reservations.all().remove(&job);
    }

    /// Bytes of the file system that anybody may still fill.
    ///
    /// # Errors
    /// What the system said.
    pub fn disk_free_bytes(&self) -> io::Result<u64> {
        let space = rustix::fs::statvfs(self.data.root()).map_err(io::Error::from)?;
        Ok(space.f_bavail.saturating_mul(space.f_frsize))
    }

    /// Bytes that further work may fill: a reserve for deleting and for the database is kept back, and what open uploads have
    /// announced and running jobs have reserved counts as taken.
    ///
    /// # Errors
    /// What the system or SQLite said.
    pub async fn free_bytes(&self) -> Result<u64, StoreError> {
        let promised = self.promised.ask(&self.db).await?;
        Ok(self.free_beside(promised)?)
    }

    fn free_beside(&self, promised: u64) -> io::Result<u64> {
        let taken = [RESERVE_BYTES, promised, self.reservations.outstanding_bytes()];
        Ok(taken.into_iter().fold(self.disk_free_bytes()?, u64::saturating_sub))
    }

    /// Fails unless there is room for so many bytes more.
    ///
    /// # Errors
    /// [`io::ErrorKind::StorageFull`], or what the system or SQLite said.
    pub async fn check_space(&self, bytes: u64) -> Result<(), StoreError> {
        if let Some(promised) = self.promised.at_most()
            && self.free_beside(promised)? >= bytes
        {
            return Ok(());
        }
        if self.free_bytes().await? < bytes {
            return Err(io::Error::from(io::ErrorKind::StorageFull).into());
        }
        Ok(())
    }

    fn ballast(&self) -> PathBuf {
        self.data.root().join("ballast")
    }

    /// Makes the ballast where it is missing and there is room for it. Blocking.
    ///
    /// # Errors
    /// What the system said.
    pub fn keep_ballast(&self) -> io::Result<()> {
        let there = self.ballast().metadata().is_ok_and(|file| file.len() == BALLAST_BYTES);
        if there || self.disk_free_bytes()? < BALLAST_ABOVE_BYTES {
            return Ok(());
        }
        let file = File::create(self.ballast())?;
        match rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), 0, BALLAST_BYTES) {
            Ok(()) => Ok(()),
            // A file system that can't promise space; then there is no ballast.
            Err(rustix::io::Errno::OPNOTSUPP) => std::fs::remove_file(self.ballast()),
            Err(error) => Err(error.into()),
        }
    }

    /// Gives up the ballast so that what frees space can be written down; whether there was any.
    pub fn drop_ballast(&self) -> bool {
        std::fs::remove_file(self.ballast()).is_ok()
    }
}
