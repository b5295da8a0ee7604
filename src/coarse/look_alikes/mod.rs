//! Look-alikes: verified pairs that show different copies of one thing (the two fronts of a symmetric building, equal houses
//! along a street, a product twice on a shelf). Their matches obey a two-view geometry like any others, so verification lets
//! them pass, and a model built with them folds the copies into one place.
//!
//! Three steps, each cheaper than matching by far:
//!
//! 1. **Strength** ([`strength`]). Each pair is rated by how much of what its photographs show is matched: of the
//!    places that hold any feature known from some other photograph, the share (intersection over union) with a match
//!    of this pair near by, the rarer what they hold, the more they weigh. Photographs of one place taken near each
//!    other match all over; those of two copies match on the copy alone, however many matches that gives: their
//!    surroundings are missing correspondences (Zach, Irschara, Bischof, CVPR 2008).
//! 2. **Skeleton** ([`skeleton`]). From the strongest pair on, pairs are taken while the tracks they grow agree. A pair whose
//!    images stronger pairs connect already, and whose matches the tracks of these do not know, is put off: either the chain
//!    came back to the same place or the two places look alike.
//! 3. **Judgement** ([`judgement`]). A model of the skeleton alone tells which: it has a point for either keypoint of a match.
//!    Where the two points of most matches lie apart, the pair is cut; where they coincide it closes a loop and is kept.
//!
//! Going from strong to weak and doubting only what a stronger chain contradicts follows the path networks of Yan,
//! Yang, Zhang, Xiao, "Distinguishing the Indistinguishable", CVPR 2017, and the maximum spanning trees of Jiang, Tan,
//! Cheong, "Seeing Double Without Confusion", CVPR 2012. Nothing depends on the order of the photographs or on when
//! they were taken.

mod forest;
mod judgement;
mod options;
mod skeleton;
mod strength;

pub use options::LookAlikeOptions;

use std::collections::BTreeSet;

use serde::{Deserialize, Serialize};

use super::MatchGraph;
use super::mapper::{self, CoarseModels, MapperInput, MapperOptions, MapperRun};
use crate::scene::{ApartImages, ImageId};
use judgement::Verdict;
use skeleton::Suspect;

/// A pair that was cut, and why.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct CutPair {
    /// The images, the smaller id first.
    pub images: (ImageId, ImageId),
    /// Its matches.
    pub matches: usize,
    /// Of those, how many join keypoints that the stronger pairs hold for one point too.
    pub agreeing: usize,
    /// How much of what the photographs show is matched, 0 to 1; what is seen in few photographs counts most.
    pub strength: f64,
    /// The weakest link of the strongest chain between the two photographs, on the same scale.
    pub chain_strength: f64,
    /// Median distance between the two places of its matches in the model of the stronger pairs, in units of their distance
    /// from the camera; none when that model holds too few of both.
    pub displacement: Option<f64>,
    /// Whether its images are held apart for good: none, or nearly none, of its matches joins one place.
    pub apart: bool,
}

/// What the check did.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct LookAlikeAccount {
    /// Pairs put off.
    pub suspected: usize,
    /// Pairs cut.
    pub cut: Vec<CutPair>,
}

impl LookAlikeAccount {
    /// The images that are held apart.
    pub fn apart(&self) -> ApartImages {
        self.cut.iter().filter(|cut| cut.apart).map(|cut| cut.images).collect()
    }

    /// Of the pairs put off, the share that is held apart; 0 where none was put off.
    pub fn apart_share(&self) -> f64 {
        self.cut.iter().filter(|cut| cut.apart).count() as f64 / self.suspected.max(1) as f64
    }
}

/// Reconstructs as [`mapper::reconstruct`] does, without the pairs that join look-alikes.
pub fn reconstruct(
    input: &MapperInput,
    options: &LookAlikeOptions,
    mapper_options: &MapperOptions,
    run: &MapperRun<'_>,
) -> (CoarseModels, LookAlikeAccount) {
    let without = |left_out: &BTreeSet<(ImageId, ImageId)>, apart: ApartImages| {
        let kept = input.graph.pairs.iter().filter(|(pair, _)| !left_out.contains(pair));
        let graph = MatchGraph { pairs: kept.map(|(&pair, geometry)| (pair, geometry.clone())).collect() };
        MapperInput { images: input.images.clone(), cameras: input.cameras.clone(), graph, apart }
    };
    let suspects = if options.enabled { skeleton::suspects(input, options, run.keep_going) } else { Vec::new() };
    let put_off: BTreeSet<_> = suspects.iter().map(|suspect| suspect.images).collect();
    let confident = without(&put_off, ApartImages::default());
    let models = mapper::reconstruct(&confident, mapper_options, run);
    if suspects.is_empty() {
        return (models, LookAlikeAccount::default());
    }
    let verdicts = judgement::judge(&models, input, &suspects, options);
    let account = LookAlikeAccount { suspected: suspects.len(), cut: cut_pairs(&suspects, &verdicts, options) };
    let apart = account.apart();
    if account.cut.len() == suspects.len() && apart.is_empty() {
        return (models, account);
    }
    let judged = without(&account.cut.iter().map(|cut| cut.images).collect(), apart);
    (mapper::extend(&judged, &models, mapper_options, run), account)
}

/// The suspects that are cut: those whose matches join two places, and, once there is such a pair and the set is so known to
/// hold look-alikes, those that no model can judge.
fn cut_pairs(suspects: &[Suspect], verdicts: &[Verdict], options: &LookAlikeOptions) -> Vec<CutPair> {
    let ambiguous = verdicts.iter().any(|verdict| matches!(verdict, Verdict::Apart { .. }));
    let cut = suspects.iter().zip(verdicts).filter_map(|(suspect, verdict)| {
        let (displacement, in_one_place, of) = match *verdict {
            Verdict::Together => return None,
            Verdict::Unknown if !ambiguous => return None,
            Verdict::Unknown => (None, suspect.agreeing, suspect.matches),
            Verdict::Apart { displacement, coinciding, judged } => (Some(displacement), coinciding, judged),
        };
        let shares_place = in_one_place >= options.min_shared_place_matches
            && in_one_place as f64 > options.shared_place_share * of as f64;
        Some(CutPair {
            images: suspect.images,
            matches: suspect.matches,
            agreeing: suspect.agreeing,
            strength: suspect.strength,
            chain_strength: suspect.chain_strength,
            displacement,
            apart: !shares_place,
        })
    });
    cut.collect()
}

#[cfg(test)]
mod tests;
