//! The models as they stand between stages, with their history.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::StageKey;
use crate::add_points::PairOfSightings;
use crate::coarse::Unregistered;
use crate::formats::report::ModelStage;
use crate::scene::{ImageId, Reconstruction};

/// One model and its history.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ModelState {
    /// The model.
    pub model: Reconstruction,
    /// Matches that become points if a third image sees the same.
    pub unconfirmed: Vec<PairOfSightings>,
    /// The stage that registered each image.
    pub registered_in: BTreeMap<ImageId, String>,
    /// The model after each stage that changed it.
    pub history: Vec<ModelStage>,
}

impl ModelState {
    /// A model without history.
    pub fn new(model: Reconstruction) -> Self {
        Self { model, unconfirmed: Vec::new(), registered_in: BTreeMap::new(), history: Vec::new() }
    }
}

/// All models, and why every other image is in none.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct PipelineState {
    /// Largest first.
    pub models: Vec<ModelState>,
    /// Why each image is in no model.
    pub unregistered: BTreeMap<ImageId, Unregistered>,
    /// The image that each image shares most verified coarse matches with, where it shares any.
    pub most_alike: BTreeMap<ImageId, ImageId>,
}

impl PipelineState {
    /// The model of each registered image.
    pub fn located(&self) -> BTreeMap<ImageId, usize> {
        let numbered = self.models.iter().enumerate();
        numbered.flat_map(|(rank, account)| account.model.images().keys().map(move |&id| (id, rank))).collect()
    }

    /// Notes the models as `stage` left them, and which images it registered.
    pub fn record(&mut self, stage: StageKey) {
        for account in &mut self.models {
            for &id in account.model.images().keys() {
                account.registered_in.entry(id).or_insert_with(|| stage.to_string());
            }
            let ModelState { model, registered_in, history, .. } = account;
            registered_in.retain(|id, _| model.image(*id).is_some());
            history.push(summary(stage, model));
        }
    }
}

/// Numbers of a model after a stage.
fn summary(stage: StageKey, model: &Reconstruction) -> ModelStage {
    let (mean, median) = mean_and_median(model.reprojection_errors_px());
    ModelStage {
        stage: stage.to_string(),
        images: model.images().len(),
        points: model.num_points(),
        points_3plus: model.num_points_3plus(),
        mean_reprojection_error_px: mean,
        median_reprojection_error_px: median,
    }
}

/// Mean and median; none of nothing.
pub fn mean_and_median(mut values: Vec<f64>) -> (Option<f64>, Option<f64>) {
    if values.is_empty() {
        return (None, None);
    }
    let mean = values.iter().sum::<f64>() / values.len() as f64;
    let middle = values.len() / 2;
    let (_, median, _) = values.select_nth_unstable_by(middle, f64::total_cmp);
    (Some(mean), Some(*median))
}
