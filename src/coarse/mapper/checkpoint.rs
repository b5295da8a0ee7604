//! What a reconstruction is given besides its input and options, and how one that was stopped goes on.
//!
//! Everything before a model grows (tracks, the initial pair) is done again: it is quick. The growth itself is kept
//! after every adjustment of all that there is, and as the input, the options and the seed are the same, a model that
//! is taken up there becomes the one it would have become.

use std::borrow::Cow;
use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::{Mapper, Unregistered};
use crate::bundle::KeepGoing;
use crate::scene::{BareModel, ImageId, Point3dId};

/// What a reconstruction is given besides its input and options.
#[derive(Clone, Copy)]
pub struct MapperRun<'a> {
    /// All randomness derives from it.
    pub seed: u64,
    /// Asked at every registration and every step of an adjustment; once it says no, what there is so far is returned.
    pub keep_going: &'a KeepGoing<'a>,
    /// Told the number of images registered.
    pub progress: &'a (dyn Fn(usize) + Sync),
    /// Keeps models while they grow.
    pub checkpoints: &'a dyn Checkpoints,
}

impl MapperRun<'_> {
    /// One that nobody stops or watches.
    pub fn undisturbed(seed: u64) -> Self {
        Self { seed, keep_going: &|| true, progress: &|_| (), checkpoints: &NoCheckpoints }
    }
}

/// Keeps models while they grow. The models of a reconstruction begin in the same order in every run of it.
pub trait Checkpoints: Sync {
    /// The next model begins: how an earlier run that was stopped kept it last, if it did.
    fn begin(&self) -> Option<Checkpoint<'static>>;

    /// The model that began last stands so.
    fn keep(&self, checkpoint: &Checkpoint<'_>);
}

/// Keeps nothing.
struct NoCheckpoints;

impl Checkpoints for NoCheckpoints {
    fn begin(&self) -> Option<Checkpoint<'static>> {
        None
    }

    fn keep(&self, _: &Checkpoint<'_>) {}
}

/// How far a model has grown.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Growth {
    /// Images and points when everything was adjusted last.
    pub(super) adjusted_at: (usize, usize),
    /// Inliers a pose needs now.
    pub(super) min_inliers: usize,
}

/// A growing model after an adjustment of everything: all that decides how it goes on.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Checkpoint<'a> {
    model: BareModel<'a>,
    point_of_track: Cow<'a, [Option<Point3dId>]>,
    trials: Cow<'a, BTreeMap<ImageId, u32>>,
    drops: Cow<'a, BTreeMap<ImageId, u32>>,
    failures: Cow<'a, BTreeMap<ImageId, Unregistered>>,
    is_whole: bool,
    growth: Growth,
}

impl Checkpoint<'_> {
    /// Number of images the model has.
    pub fn num_images(&self) -> usize {
        self.model.image_ids().count()
    }
}

impl Mapper<'_> {
    /// Keeps the model as it stands, unless the adjustment before was stopped on its way.
    pub(super) fn keep(&self, growth: Growth) {
        if !self.goes_on() {
            return;
        }
        self.run.checkpoints.keep(&Checkpoint {
            model: BareModel::of(&self.model),
            point_of_track: Cow::Borrowed(&self.point_of_track),
            trials: Cow::Borrowed(&self.trials),
            drops: Cow::Borrowed(&self.drops),
            failures: Cow::Borrowed(&self.failures),
            is_whole: self.is_whole,
            growth,
        });
    }

    /// Takes up the model where an earlier run left it; none where there is nothing that fits.
    pub(super) fn take_up(&mut self) -> Option<Growth> {
        let kept = self.run.checkpoints.begin()?;
        if kept.point_of_track.len() != self.point_of_track.len() {
            return None;
        }
        let keypoints = |id: ImageId| self.input.images.get(&id).map(|image| image.keypoints.clone());
        self.model = kept.model.complete(&keypoints)?;
        self.point_of_track = kept.point_of_track.into_owned();
        self.trials = kept.trials.into_owned();
        self.drops = kept.drops.into_owned();
        self.failures = kept.failures.into_owned();
        self.is_whole = kept.is_whole;
        Some(kept.growth)
    }
}
