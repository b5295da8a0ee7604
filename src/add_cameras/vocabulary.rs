//! Visual words: the descriptor space cut into cells by k-means, in two levels.
//!
//! Trained on the model's own descriptors, because they are what will be looked for. The coarser level clusters the centres of
//! the finer one.

use crate::matching::clusters::{k_means, nearest};
use crate::matching::descriptor::PackedDescriptors;
use crate::scene::Descriptor;

use super::VocabularyOptions;

/// A word of the finer or the coarser level.
pub type Word = u32;

/// Visual words in two levels.
#[derive(Clone, Debug, Default)]
pub struct Vocabulary {
    centers: PackedDescriptors,
    coarse_of: Vec<Word>,
    num_coarse_words: usize,
}

impl Vocabulary {
    /// Trains on these descriptors, one for each point of the model. Empty when there is none.
    pub fn train(descriptors: &[Descriptor], options: &VocabularyOptions) -> Self {
        if descriptors.is_empty() {
            return Self::default();
        }
        let num_words = (descriptors.len() / options.points_per_word.max(1)).clamp(1, options.max_words.max(1));
        let centers = k_means(descriptors, num_words, options.iterations);
        let num_coarse_words = centers.len().div_ceil(options.words_per_coarse_word.max(1));
        let coarse_centers = k_means(&centers, num_coarse_words, options.iterations);
        let coarse_of = nearest(&centers, &PackedDescriptors::pack(&coarse_centers));
        Self { centers: PackedDescriptors::pack(&centers), coarse_of, num_coarse_words: coarse_centers.len() }
    }

    /// Number of words of the finer level.
    pub fn num_words(&self) -> usize {
        self.centers.len()
    }

    /// Number of words of the coarser level.
    pub fn num_coarse_words(&self) -> usize {
        self.num_coarse_words
    }

    /// The word of every descriptor; empty when there are no words.
    pub fn words_of(&self, descriptors: &[Descriptor]) -> Vec<Word> {
        nearest(descriptors, &self.centers)
    }

    /// The coarser word of a word.
    pub fn coarse_word_of(&self, word: Word) -> Word {
        self.coarse_of[word as usize]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;
    use crate::scene::DESCRIPTOR_LEN;

    #[test]
    fn clusters_are_found_again() {
        let mut rng = Rng::from_parts(&[11]);
        let truth: Vec<Descriptor> = (0..8).map(|_| std::array::from_fn(|_| 40 + rng.below(120) as u8)).collect();
        let members: Vec<Descriptor> =
            (0..400).map(|i| truth[i % 8].map(|byte| byte - 10 + rng.below(21) as u8)).collect();
        let options = VocabularyOptions { points_per_word: 5, ..VocabularyOptions::default() };
        let vocabulary = Vocabulary::train(&members, &options);
        assert_eq!((vocabulary.num_words(), vocabulary.num_coarse_words()), (80, 4));
        let words = vocabulary.words_of(&members);
        // Members of different clusters never share a word.
        for (i, a) in words.iter().enumerate() {
            for (j, b) in words.iter().enumerate() {
                assert!(a != b || i % 8 == j % 8, "{i} {j}");
            }
        }
    }

    #[test]
    fn nothing_gives_no_words() {
        let vocabulary = Vocabulary::train(&[], &VocabularyOptions::default());
        assert_eq!(vocabulary.num_words(), 0);
        assert!(vocabulary.words_of(&[[0; DESCRIPTOR_LEN]]).is_empty());
    }
}
