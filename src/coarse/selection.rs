//! Which features the coarse stage uses: the top eta percent by scale (paper, section 4).
//!
//! Features of large scale are few, cover most levels of the scale space, repeat better under changes of light and view,
//! and so appear in more tracks than their number lets expect. Features are sorted by descending scale, so the selection is
//! a prefix. The paper chooses 20 % for images of 10,000 to 30,000 features and all features below 1000; images with few
//! features need a floor, or 20 % of 2000 would leave too little to match.

use serde::{Deserialize, Serialize};

/// How many features of an image enter the coarse stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SelectionOptions {
    /// eta: share of an image's features, by descending scale, in percent. Higher: more matches and images in the coarse
    /// model, quadratically more matching time. 20 in the paper, which finds 10 to 30 useful.
    pub eta_percent: f64,
    /// An image with fewer features than this uses all of them. 1000 in the paper.
    pub all_below: usize,
    /// At least this many features, however small the share. Ours.
    pub min_features: usize,
    /// At most this many features, however large the share; null for no limit. Bounds the time of matching a pair. Ours: at
    /// 25,000 features an image it is the paper's 10 %, whose models are as good here as those of 20 % in 2/5 of the time.
    pub max_features: Option<usize>,
    /// At most this many features in a trial before, which is forgotten when it places too few images; null for no trial. Ours:
    /// a quarter of the matching time where pictures overlap well. Measured on seven sets, 2560, 1280 and 900 give final models
    /// alike to a point of AUC@1, but for the temple ring's 0.3 megapixels: 82, 81 and 77.
    pub trial_max_features: Option<usize>,
    /// A trial is made from this many images on; in smaller sets matching takes too small a part of the time.
    pub trial_from_images: usize,
    /// The trial is forgotten, too, when more than this share of the pairs that it doubted are held apart as
    /// look-alikes: places that look alike need all the evidence. Of 24 random subsets of one desk with the same books
    /// twice, trials folded 2, and 2560 features none. Measured: 0 to 0.24 where there are none, 0.6 to 0.9 where
    /// there are.
    pub trial_max_apart_share: f64,
    /// A wider selection doesn't match those images with each other anew that the largest model so far sees at least
    /// this many points of. Lower: less time for sets of which a part is hard; but a model of few points may hold
    /// together by joins that are too weak to trust. Ours: of ten runs on a street of 29 photographs, four went astray
    /// when all images of such a model kept their pairs, and none with this.
    pub settled_from_points: usize,
}

impl Default for SelectionOptions {
    fn default() -> Self {
        Self {
            eta_percent: 20.0,
            all_below: 1000,
            min_features: 1500,
            max_features: Some(2560),
            trial_max_features: Some(1280),
            trial_from_images: 25,
            trial_max_apart_share: 0.4,
            settled_from_points: 200,
        }
    }
}

impl SelectionOptions {
    /// Adds a sentence for every value out of range.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if !(self.eta_percent > 0.0 && self.eta_percent <= 100.0) {
            errors.push(format!("eta_percent is {}, it must be above 0 and at most 100", self.eta_percent));
        }
        if self.max_features.is_some_and(|max| max < self.min_features) {
            errors.push(format!("max_features is below min_features ({})", self.min_features));
        }
        if !(0.0..=1.0).contains(&self.trial_max_apart_share) {
            errors.push(format!("trial_max_apart_share is {}, it must be from 0 to 1", self.trial_max_apart_share));
        }
        if self.trial_max_features == Some(0) {
            errors.push("trial_max_features is 0; null leaves the trial out".to_owned());
        }
    }

    /// How many of an image's features are selected: the first so many.
    pub fn num_selected(&self, num_features: usize) -> usize {
        if num_features < self.all_below {
            return num_features;
        }
        let share = (0.01 * self.eta_percent * num_features as f64).ceil() as usize;
        share.max(self.min_features).min(self.max_features.unwrap_or(usize::MAX)).min(num_features)
    }

    /// What is selected, as the subject of a sentence.
    pub fn described(&self) -> String {
        match self.max_features {
            Some(max) => format!("The features of largest scale, at most {max} a photograph,"),
            None if self.eta_percent < 100.0 => {
                format!("The {:.0} % of the features of largest scale", self.eta_percent)
            }
            None => "All features together".to_owned(),
        }
    }

    /// The selection of the trial, if so many images have one and it would leave anything out.
    pub fn trial(&self, num_images: usize) -> Option<Self> {
        let trial = self.trial_max_features.filter(|_| num_images >= self.trial_from_images)?;
        self.max_features.is_none_or(|max| trial < max).then(|| Self {
            min_features: self.min_features.min(trial),
            max_features: Some(trial),
            ..self.clone()
        })
    }

    /// The next wider selection, for photographs that the present one leaves unconnected: twice the share and the limits,
    /// and from 40 % on everything. None when everything is selected already.
    pub fn widened(&self) -> Option<Self> {
        const LAST_SHARE_PERCENT: f64 = 40.0;
        if self.eta_percent >= 100.0 && self.max_features.is_none() {
            return None;
        }
        let everything = self.eta_percent >= LAST_SHARE_PERCENT;
        Some(Self {
            eta_percent: if everything { 100.0 } else { (2.0 * self.eta_percent).min(100.0) },
            min_features: 2 * self.min_features,
            max_features: if everything { None } else { self.max_features.map(|max| 2 * max) },
            trial_max_features: None,
            ..self.clone()
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn small_images_use_all_and_large_ones_a_fifth() {
        let options = SelectionOptions::default();
        let selected: Vec<usize> = [0, 999, 1400, 4000, 10_000, 30_000].map(|n| options.num_selected(n)).into();
        assert_eq!(selected, [0, 999, 1400, 1500, 2000, 2560]);
        let paper = SelectionOptions { min_features: 0, max_features: None, ..options };
        assert_eq!([999, 1000, 30_000].map(|n| paper.num_selected(n)), [999, 200, 6000]);
    }

    #[test]
    fn a_trial_selects_fewer() {
        let options = SelectionOptions::default();
        let trial = options.trial(25).unwrap();
        assert_eq!([999, 4000, 30_000].map(|n| trial.num_selected(n)), [999, 1280, 1280]);
        assert_eq!(options.trial(24), None);
        assert_eq!(SelectionOptions { trial_max_features: None, ..options.clone() }.trial(100), None);
        assert_eq!(SelectionOptions { max_features: Some(1280), ..options }.trial(100), None, "it would be the same");
    }

    #[test]
    fn widening_ends_with_everything() {
        let wider = SelectionOptions::default().widened().unwrap();
        assert_eq!((wider.eta_percent, wider.max_features), (40.0, Some(5120)));
        let all = wider.widened().unwrap();
        assert_eq!(all.num_selected(100_000), 100_000);
        assert_eq!(all.widened(), None);
    }

    #[test]
    fn options_out_of_range_are_all_named() {
        let mut errors = Vec::new();
        SelectionOptions {
            eta_percent: 0.0,
            max_features: Some(10),
            trial_max_features: Some(0),
            trial_max_apart_share: -0.1,
            ..SelectionOptions::default()
        }
        .validate(&mut errors);
        assert_eq!(errors.len(), 4);
    }
}
