//! Direct 3D-2D matching (Shah, Deshpande, Narayanan, "Multistage SFM: revisiting incremental structure from motion", 3DV
//! 2014; the paper's section 5): every point's mean descriptor against all features of the image, with the ratio test.
//!
//! Exact and exhaustive, so nothing that could be matched is missed; with byte kernels, a hundred thousand points and ten
//! thousand features are a billion distances, under half a second. Departure: a cross-check, from the same pass.

use super::correspondences::{Correspondence, OneToOne};
use super::{DirectMatchOptions, ModelSnapshot};
use crate::matching::RatioTest;
use crate::matching::descriptor::{PackedDescriptors, top2_both};
use crate::scene::{Features, KeypointIdx};

/// The correspondences of an image's features with the model.
pub fn direct_match(
    snapshot: &ModelSnapshot,
    features: &Features,
    options: &DirectMatchOptions,
) -> Vec<Correspondence> {
    let (mut of_points, mut of_features) = (Vec::new(), Vec::new());
    top2_both(&snapshot.descriptors, &PackedDescriptors::pack(&features.descriptors), &mut of_points, &mut of_features);
    let test = RatioTest::new(options.ratio, options.max_distance);
    let mut claims = OneToOne::default();
    for ((point, found), &id) in (0u32..).zip(&of_points).zip(&snapshot.ids) {
        let agreed = !options.cross_check || of_features[found.index as usize].index == point;
        if agreed && test.accepts(found) {
            claims.claim(KeypointIdx(found.index), id, 1, found.distance_sq);
        }
    }
    claims.into_sorted()
}
