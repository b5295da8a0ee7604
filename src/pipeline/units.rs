//! Finished units of work of a stage: kept while the stage goes on, so that a run that is stopped at any moment goes on
//! from them, and removed once the stage's own result is stored.
//!
//! A unit's result is kept under the key of its stage, which stands for everything that decides it besides the unit itself
//! (stages before, options, seed), and the hash of the unit's own description. How work is cut into units decides what a stop
//! costs, never a result.

use std::path::Path;

use serde::Serialize;
use serde::de::DeserializeOwned;

use super::runner::erased::Part;
use super::runner::{ArtifactKey, io_error, to_bytes};
use super::{PipelineError, Stage};
use crate::store::ArtifactStore;

/// The units of one stage. Any number of threads may use them at once.
pub struct Units<'a> {
    store: &'a ArtifactStore,
    stage: Stage,
    folder: String,
}

impl<'a> Units<'a> {
    /// Those of the stage whose result gets this key.
    pub fn new(store: &'a ArtifactStore, stage: Stage, key: &ArtifactKey) -> Self {
        Self { store, stage, folder: format!("{}.units", key.0) }
    }

    /// What an earlier run that was stopped found for a unit.
    ///
    /// # Errors
    /// A file that is there but can't be read.
    pub fn known<T: DeserializeOwned>(&self, unit: &dyn Part) -> Result<Option<T>, PipelineError> {
        let key = self.key(unit);
        let bytes = self.store.get(&key).map_err(|source| io_error(self.stage, Path::new(&key), source))?;
        Ok(bytes.and_then(|bytes| postcard::from_bytes(&bytes).ok()))
    }

    /// Of the units that `cut` gives, each part of the work of the model `rank`: what an earlier run found for some,
    /// and the others.
    ///
    /// # Errors
    /// As [`Units::known`]'s.
    pub fn split<'u, I: Serialize, T: DeserializeOwned>(
        &self,
        rank: usize,
        cut: impl Iterator<Item = &'u [I]>,
    ) -> Result<(Vec<T>, Vec<&'u [I]>), PipelineError> {
        let (mut known, mut waiting) = (Vec::new(), Vec::new());
        for unit in cut {
            match self.known(&(rank, unit))? {
                Some(found) => known.push(found),
                None => waiting.push(unit),
            }
        }
        Ok((known, waiting))
    }

    /// Keeps what was found for a unit.
    ///
    /// # Errors
    /// When it can't be stored.
    pub fn keep<T: Serialize + ?Sized>(&self, unit: &dyn Part, found: &T) -> Result<(), PipelineError> {
        let key = self.key(unit);
        self.store.put(&key, &to_bytes(found)).map_err(|source| io_error(self.stage, Path::new(&key), source))
    }

    /// Removes all of them.
    ///
    /// # Errors
    /// When they can't be removed.
    pub fn clear(&self) -> Result<(), PipelineError> {
        let folder = &self.folder;
        self.store.remove_folder(folder).map_err(|source| io_error(self.stage, Path::new(folder), source))
    }

    fn key(&self, unit: &dyn Part) -> String {
        format!("{}/{}", self.folder, ArtifactKey::of("unit", &[unit]).0)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;

    #[test]
    fn units_are_kept_apart_by_stage_and_go_together() {
        let folder = tempfile::tempdir().unwrap();
        let store = ArtifactStore::open(folder.path()).unwrap();
        let keys = [1, 2].map(|seed| ArtifactKey::of("stage", &[&seed]));
        let [one, other] = [0, 1].map(|at: usize| Units::new(&store, Stage::AddPoints, &keys[at]));
        assert_eq!(one.known::<Vec<u32>>(&(0, "a")).unwrap(), None);
        one.keep(&(0, "a"), [1u32, 2].as_slice()).unwrap();
        one.keep(&(0, "b"), [3u32].as_slice()).unwrap();
        other.keep(&(0, "a"), [4u32].as_slice()).unwrap();
        store.put(&keys[0].0, b"the result").unwrap();
        assert_eq!(one.known::<Vec<u32>>(&(0, "a")).unwrap(), Some(vec![1, 2]));
        assert_eq!(one.known::<Vec<u32>>(&(1, "a")).unwrap(), None);
        one.clear().unwrap();
        one.clear().unwrap();
        assert_eq!(one.known::<Vec<u32>>(&(0, "b")).unwrap(), None);
        assert_eq!(other.known::<Vec<u32>>(&(0, "a")).unwrap(), Some(vec![4]));
        assert!(store.get(&keys[0].0).unwrap().is_some());
    }
}
