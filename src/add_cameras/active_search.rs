//! Active correspondence search (Sattler, Leibe, Kobbelt, "Improving image-based localization by active correspondence
//! search", ECCV 2012; the paper's section 5).
//!
//! Both directions compete for a place in one queue, cheapest first:
//!
//! - 2D to 3D: the features of a word are compared with the points listed under it. Cost: the number of these points. Words
//!   of few points are tried first, because they cost least and confuse least.
//! - 3D to 2D: when a feature has found a point, the points around it are probably in the picture too. Each of them is
//!   compared with the features of its coarser words. Cost: the number of these features.
//!
//! Each has its ratio test, stricter for 3D to 2D, where the competitors are few. The search ends when the correspondences
//! are enough.
//!
//! Departures: features of one word are searched together, since they cost the same; distances are exact; a point is listed
//! under the words of all its sightings, with its mean descriptor.
//!
//! Points by word and features by coarser word are laid out for the kernels once a model and once an image: laying out the
//! candidates of every point anew took twenty times as long as comparing them with it.

use std::cmp::Reverse;
use std::collections::BinaryHeap;
use std::num::NonZero;

use kiddo::SquaredEuclidean;

use super::correspondences::{Correspondence, OneToOne};
use super::vocabulary::Word;
use super::{ActiveSearchOptions, ModelSnapshot};
use crate::matching::RatioTest;
use crate::matching::descriptor::CellRows;
use crate::math::Grouped;
use crate::scene::{Features, KeypointIdx};

/// A place in the queue: ties in cost go to the 2D-to-3D direction, then to the lower number.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
enum Task {
    /// The features of a word among its points.
    FeaturesOfWord(Word),
    /// A point (by rank) among the features of its coarser words.
    Point(u32),
}

/// The search in one image.
struct Search<'a> {
    snapshot: &'a ModelSnapshot,
    features: &'a Features,
    options: &'a ActiveSearchOptions,
    features_of_word: Grouped<u32>,
    features_of_coarse_word: Grouped<u32>,
    rows_of_coarse_word: CellRows,
    queue: BinaryHeap<Reverse<(usize, Task)>>,
    queued_points: Vec<bool>,
    found: OneToOne,
}

/// The correspondences of an image's features with the model.
pub fn active_search(
    snapshot: &ModelSnapshot,
    features: &Features,
    options: &ActiveSearchOptions,
) -> Vec<Correspondence> {
    let vocabulary = &snapshot.vocabulary;
    let words = vocabulary.words_of(&features.descriptors);
    let seen = || words.iter().copied().zip(0u32..);
    let features_of_word = Grouped::new(vocabulary.num_words(), seen());
    let coarse = seen().map(|(word, feature)| (vocabulary.coarse_word_of(word), feature));
    let features_of_coarse_word = Grouped::new(vocabulary.num_coarse_words(), coarse);
    let mut queue = BinaryHeap::new();
    for word in 0..vocabulary.num_words() as Word {
        let listed = snapshot.points_of_word.group(word as usize).len();
        if !features_of_word.group(word as usize).is_empty() && listed > 0 {
            queue.push(Reverse((listed, Task::FeaturesOfWord(word))));
        }
    }
    let mut search = Search {
        snapshot,
        features,
        options,
        rows_of_coarse_word: CellRows::pack(&features.descriptors, &features_of_coarse_word),
        features_of_word,
        features_of_coarse_word,
        queue,
        queued_points: vec![false; snapshot.len()],
        found: OneToOne::default(),
    };
    let (to_3d, to_2d) = (
        RatioTest::new(options.ratio_2d_to_3d, options.max_distance),
        RatioTest::new(options.ratio_3d_to_2d, options.max_distance),
    );
    while search.found.len() < options.enough_correspondences {
        match search.queue.pop() {
            Some(Reverse((_, Task::FeaturesOfWord(word)))) => search.points_for_features(word, &to_3d),
            Some(Reverse((_, Task::Point(point)))) => search.feature_for_point(point, &to_2d),
            None => break,
        }
    }
    search.found.into_sorted()
}

impl Search<'_> {
    /// 2D to 3D.
    fn points_for_features(&mut self, word: Word, test: &RatioTest) {
        let rows = &self.snapshot.rows_of_word;
        let mut fresh = Vec::new();
        for &feature in self.features_of_word.group(word as usize) {
            let Some(nearest) = rows.top2_of(&[word], &self.features.descriptors[feature as usize]) else { continue };
            // A list of one point offers nothing to compare with, so it proves nothing.
            if nearest.second_distance_sq.is_none() || !test.accepts(&nearest) {
                continue;
            }
            let point = rows.rank(nearest.index);
            let id = self.snapshot.ids[point as usize];
            if self.found.claim(KeypointIdx(feature), id, 1, nearest.distance_sq) {
                fresh.push(point);
            }
        }
        for point in fresh {
            self.queue_neighbors(point);
        }
    }

    /// 3D to 2D.
    fn feature_for_point(&mut self, point: u32, test: &RatioTest) {
        let id = self.snapshot.ids[point as usize];
        if self.found.has_point(id) {
            return;
        }
        let words = &self.snapshot.coarse_words_of_point[point as usize];
        let rows = &self.rows_of_coarse_word;
        let Some(nearest) = rows.top2_of(words, &self.snapshot.descriptors[point as usize]) else { return };
        if nearest.second_distance_sq.is_some() && test.accepts(&nearest) {
            self.found.claim(KeypointIdx(rows.rank(nearest.index)), id, 1, nearest.distance_sq);
        }
    }

    /// Puts the points around a found one into the queue.
    fn queue_neighbors(&mut self, point: u32) {
        let (Some(tree), Some(wanted)) = (&self.snapshot.tree, NonZero::new(self.options.neighbors_3d)) else { return };
        let at = self.snapshot.positions[point as usize];
        let near = tree.query(&[at.x, at.y, at.z]).nearest_n::<SquaredEuclidean<f64>>(wanted).execute();
        for neighbor in near {
            let neighbor = neighbor.item;
            if std::mem::replace(&mut self.queued_points[neighbor as usize], true) {
                continue;
            }
            let words = &self.snapshot.coarse_words_of_point[neighbor as usize];
            let cost: usize = words.iter().map(|&word| self.features_of_coarse_word.group(word as usize).len()).sum();
            if cost > 1 {
                self.queue.push(Reverse((cost, Task::Point(neighbor))));
            }
        }
    }
}
