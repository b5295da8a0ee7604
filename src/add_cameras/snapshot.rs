//! The model as localisation needs it. Built once a round and shared, unchanged, by all images.
//!
//! A point is described by the mean of its track's descriptors (Shah et al., and Sattler et al.). It is listed under every
//! word that one of its sightings falls into, because a feature of a new image may fall into any of these; and under the
//! coarser words of these for the search the other way.

use kiddo::ImmutableKdTree;
use nalgebra::Vector3;

use super::set_cover::set_cover;
use super::vocabulary::{Vocabulary, Word};
use super::{AddCamerasOptions, LoadFeatures};
use crate::matching::descriptor::CellRows;
use crate::math::Grouped;
use crate::scene::{DESCRIPTOR_LEN, Descriptor, Point3dId, Reconstruction};

/// The searchable part of a model. Points are named by their rank in it.
pub struct ModelSnapshot {
    /// The points, in id order.
    pub ids: Vec<Point3dId>,
    /// Their positions in the world.
    pub positions: Vec<Vector3<f64>>,
    /// The mean descriptor of each.
    pub descriptors: Vec<Descriptor>,
    /// The visual words.
    pub vocabulary: Vocabulary,
    /// The points listed under each word, ascending.
    pub points_of_word: Grouped<u32>,
    /// Their mean descriptors by word.
    pub rows_of_word: CellRows,
    /// The coarser words each point is listed under, ascending.
    pub coarse_words_of_point: Vec<Vec<Word>>,
    /// The positions, to find neighbours; none of a model without points.
    pub tree: Option<ImmutableKdTree<f64, 3>>,
}

impl ModelSnapshot {
    /// Takes all points of the model, or a cover of them when they are very many.
    pub fn build(model: &Reconstruction, features: &LoadFeatures, options: &AddCamerasOptions) -> Self {
        let ids = if model.num_points() > options.set_cover.above_points {
            set_cover(model, options.set_cover.points_per_camera)
        } else {
            model.points().map(|(id, _)| id).collect()
        };
        let mut rank_of = vec![None; model.point_id_bound()];
        for (rank, id) in (0u32..).zip(&ids) {
            rank_of[id.index()] = Some(rank);
        }
        let positions: Vec<Vector3<f64>> = ids.iter().filter_map(|&id| Some(model.point(id)?.xyz)).collect();
        let descriptors = mean_descriptors(model, features, &rank_of, ids.len());
        let vocabulary = Vocabulary::train(&descriptors, &options.vocabulary);

        let mut words_of_point = vec![Vec::new(); ids.len()];
        for_each_image(model, features, &rank_of, |ranks, descriptors| {
            for (&rank, word) in ranks.iter().zip(vocabulary.words_of(&descriptors)) {
                words_of_point[rank as usize].push(word);
            }
        });
        let mut coarse_words_of_point = Vec::with_capacity(ids.len());
        for words in &mut words_of_point {
            words.sort_unstable();
            words.dedup();
            let mut coarse: Vec<Word> = words.iter().map(|&word| vocabulary.coarse_word_of(word)).collect();
            coarse.sort_unstable();
            coarse.dedup();
            coarse_words_of_point.push(coarse);
        }
        let listed =
            (0u32..).zip(&words_of_point).flat_map(|(rank, words)| words.iter().map(move |&word| (word, rank)));
        let points_of_word = Grouped::new(vocabulary.num_words(), listed);
        let rows_of_word = CellRows::pack(&descriptors, &points_of_word);
        let coordinates: Vec<[f64; 3]> = positions.iter().map(|x| [x.x, x.y, x.z]).collect();
        let tree = if ids.is_empty() { None } else { ImmutableKdTree::new_from_slice(&coordinates).ok() };
        Self { ids, positions, descriptors, vocabulary, points_of_word, rows_of_word, coarse_words_of_point, tree }
    }

    /// Number of points.
    pub fn len(&self) -> usize {
        self.ids.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.ids.is_empty()
    }
}

/// Calls `visit` for every image, in id order, with the ranks of the chosen points it sees and their descriptors there.
fn for_each_image(
    model: &Reconstruction,
    features: &LoadFeatures,
    rank_of: &[Option<u32>],
    mut visit: impl FnMut(Vec<u32>, Vec<Descriptor>),
) {
    for (&id, image) in model.images() {
        let features = features(id);
        let seen = image.points().iter().zip(&features.descriptors);
        let chosen = seen.filter_map(|(point, descriptor)| Some((rank_of[(*point)?.index()]?, *descriptor)));
        let (ranks, descriptors) = chosen.unzip();
        visit(ranks, descriptors);
    }
}

fn mean_descriptors(
    model: &Reconstruction,
    features: &LoadFeatures,
    rank_of: &[Option<u32>],
    count: usize,
) -> Vec<Descriptor> {
    let mut sums = vec![[0u32; DESCRIPTOR_LEN]; count];
    let mut sizes = vec![0u32; count];
    for_each_image(model, features, rank_of, |ranks, descriptors| {
        for (&rank, descriptor) in ranks.iter().zip(&descriptors) {
            sizes[rank as usize] += 1;
            for (sum, &byte) in sums[rank as usize].iter_mut().zip(descriptor) {
                *sum += u32::from(byte);
            }
        }
    });
    sums.iter().zip(&sizes).map(|(sum, &size)| sum.map(|sum| ((sum + size / 2) / size.max(1)) as u8)).collect()
}
