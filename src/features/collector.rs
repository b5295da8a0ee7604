//! Gathers features while they are found and keeps those of the largest scales.

use std::cmp::Reverse;
use std::collections::BinaryHeap;

use crate::scene::{Descriptor, Features, Keypoint};

/// Keeps the features of the `limit` largest scales among those at accepted places.
#[derive(Clone)]
pub(super) struct Collector<'a> {
    limit: usize,
    /// Whether a feature at a pixel of the original image may be kept.
    keeps: &'a dyn Fn(f32, f32) -> bool,
    /// The largest scales so far, smallest first. Positive floats sort as their bits do.
    scales: BinaryHeap<Reverse<u32>>,
    found: Vec<(Keypoint, Descriptor)>,
}

impl<'a> Collector<'a> {
    /// Keeps `limit` features at places that `keeps` accepts.
    pub(super) fn new(limit: usize, keeps: &'a dyn Fn(f32, f32) -> bool) -> Self {
        Self { limit, keeps, scales: BinaryHeap::new(), found: Vec::new() }
    }

    /// Whether a feature at this pixel may be kept at all.
    pub(super) fn wants_at(&self, x: f32, y: f32) -> bool {
        (self.keeps)(x, y)
    }

    /// Whether a feature of this scale could still be among those kept, so that describing it is worth while.
    pub(super) fn wants(&self, scale: f32) -> bool {
        self.scales.len() < self.limit || self.scales.peek().is_some_and(|least| scale.to_bits() >= least.0)
    }

    /// Whether all places are taken by features of at least this scale.
    pub(super) fn is_full_from(&self, scale: f32) -> bool {
        self.scales.len() == self.limit && self.scales.peek().is_some_and(|least| least.0 >= scale.to_bits())
    }

    /// The keypoints found so far.
    pub(super) fn keypoints(&self) -> impl Iterator<Item = Keypoint> {
        self.found.iter().map(|(keypoint, _)| *keypoint)
    }

    /// Takes a feature.
    pub(super) fn push(&mut self, keypoint: Keypoint, descriptor: Descriptor) {
        self.scales.push(Reverse(keypoint.scale.to_bits()));
        if self.scales.len() > self.limit {
            self.scales.pop();
        }
        self.found.push((keypoint, descriptor));
        // Dropping the outgrown ones now and then bounds memory; doubling makes it cheap.
        if self.found.len() >= 2 * self.limit + 1024 {
            let least = self.scales.peek().map_or(0, |least| least.0);
            self.found.retain(|(keypoint, _)| keypoint.scale.to_bits() >= least);
        }
    }

    /// The kept features, sorted. Two extrema that were refined to the same place count once.
    pub(super) fn finish(mut self) -> Features {
        let order = |a: &Keypoint, b: &Keypoint| {
            (b.scale.total_cmp(&a.scale))
                .then(a.y.total_cmp(&b.y))
                .then(a.x.total_cmp(&b.x))
                .then(a.orientation.total_cmp(&b.orientation))
        };
        self.found.sort_by(|(a, _), (b, _)| order(a, b));
        self.found.dedup_by(|(a, _), (b, _)| a == b);
        self.found.truncate(self.limit);
        let (keypoints, descriptors) = self.found.into_iter().unzip();
        Features { keypoints, descriptors }
    }
}
