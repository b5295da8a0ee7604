//! Gathers features while they are found and keeps those of the largest scales: first the distinct ones, then, where these are
//! few, faint ones.

use std::cmp::{Ordering, Reverse};
use std::collections::BinaryHeap;

use crate::scene::{Descriptor, Features, Keypoint};

/// How well a feature stands out.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Class {
    /// Its contrast is above the threshold.
    Distinct,
    /// Its contrast is below: taken to make up the number only.
    Faint,
}

/// Keeps the `limit` distinct features of the largest scales among those at accepted places, and so many faint ones, likewise,
/// as make up `faint_up_to`.
#[derive(Clone)]
pub(super) struct Collector<'a> {
    limit: usize,
    faint_up_to: usize,
    /// Whether a feature at a pixel of the original image may be kept.
    keeps: &'a dyn Fn(f32, f32) -> bool,
    /// The largest scales of each class so far, smallest first. Positive floats sort as their bits do.
    scales: [BinaryHeap<Reverse<u32>>; 2],
    found: Vec<(Class, Keypoint, Descriptor)>,
}

impl<'a> Collector<'a> {
    /// Keeps so many features at places that `keeps` accepts.
    pub(super) fn new(limit: usize, faint_up_to: usize, keeps: &'a dyn Fn(f32, f32) -> bool) -> Self {
        Self { limit, faint_up_to, keeps, scales: Default::default(), found: Vec::new() }
    }

    /// Distinct features kept at most.
    pub(super) fn limit(&self) -> usize {
        self.limit
    }

    /// The number that faint features make up.
    pub(super) fn faint_up_to(&self) -> usize {
        self.faint_up_to
    }

    /// Features of a class that are kept at most, given the distinct ones so far.
    fn room(&self, class: Class) -> usize {
        match class {
            Class::Distinct => self.limit,
            Class::Faint => self.faint_up_to.saturating_sub(self.scales[Class::Distinct as usize].len()),
        }
    }

    /// Whether any faint feature could still be kept.
    pub(super) fn has_room_for_faint(&self) -> bool {
        self.room(Class::Faint) > 0
    }

    /// Whether a feature at this pixel may be kept at all.
    pub(super) fn wants_at(&self, x: f32, y: f32) -> bool {
        (self.keeps)(x, y)
    }

    /// Whether a feature of this scale could still be among those kept, so that describing it is worth while.
    pub(super) fn wants(&self, class: Class, scale: f32) -> bool {
        let (scales, room) = (&self.scales[class as usize], self.room(class));
        scales.len() < room || (room > 0 && scales.peek().is_some_and(|least| scale.to_bits() >= least.0))
    }

    /// The share of what a class is to make up that features of at least this scale do make up; faint ones are to make up
    /// their number together with all distinct ones.
    pub(super) fn share_from(&self, class: Class, scale: f32) -> f64 {
        let of_scale = self.scales[class as usize].iter().filter(|kept| kept.0 >= scale.to_bits()).count();
        let (kept, wanted) = match class {
            Class::Distinct => (of_scale, self.limit),
            Class::Faint => (self.scales[Class::Distinct as usize].len() + of_scale, self.faint_up_to),
        };
        if wanted == 0 { 1.0 } else { kept as f64 / wanted as f64 }
    }

    /// The keypoints of a class found so far.
    pub(super) fn keypoints(&self, class: Class) -> impl Iterator<Item = Keypoint> {
        self.found.iter().filter(move |found| found.0 == class).map(|found| found.1)
    }

    /// Takes a feature.
    pub(super) fn push(&mut self, class: Class, keypoint: Keypoint, descriptor: Descriptor) {
        self.scales[class as usize].push(Reverse(keypoint.scale.to_bits()));
        for outgrown in [Class::Distinct, Class::Faint] {
            while self.scales[outgrown as usize].len() > self.room(outgrown) {
                self.scales[outgrown as usize].pop();
            }
        }
        self.found.push((class, keypoint, descriptor));
        // Dropping the outgrown ones now and then bounds memory; doubling makes it cheap.
        if self.found.len() >= 2 * self.limit + 1024 {
            let least = self.scales.each_ref().map(|scales| scales.peek().map_or(u32::MAX, |least| least.0));
            self.found.retain(|(class, keypoint, _)| keypoint.scale.to_bits() >= least[*class as usize]);
        }
    }

    /// The kept features, sorted. Two extrema that were refined to the same place count once.
    pub(super) fn finish(self) -> Features {
        // Without the descriptors, which make up most of what sorting would move.
        let mut ranked: Vec<(Class, Keypoint, usize)> =
            self.found.iter().enumerate().map(|(at, &(class, keypoint, _))| (class, keypoint, at)).collect();
        ranked.sort_unstable_by(|a, b| a.0.cmp(&b.0).then_with(|| by_scale(&a.1, &b.1)).then(a.2.cmp(&b.2)));
        ranked.dedup_by(|a, b| a.1 == b.1);
        let faint = ranked.split_off(ranked.partition_point(|found| found.0 == Class::Distinct));
        ranked.truncate(self.limit);
        let room = self.faint_up_to.saturating_sub(ranked.len());
        ranked.extend(faint.into_iter().take(room));
        ranked.sort_unstable_by(|a, b| by_scale(&a.1, &b.1).then(a.2.cmp(&b.2)));
        Features {
            keypoints: ranked.iter().map(|found| found.1).collect(),
            descriptors: ranked.iter().map(|found| self.found[found.2].2).collect(),
        }
    }
}

/// Larger scales first; the rest makes the order whole.
fn by_scale(a: &Keypoint, b: &Keypoint) -> Ordering {
    (b.scale.total_cmp(&a.scale))
        .then(a.y.total_cmp(&b.y))
        .then(a.x.total_cmp(&b.x))
        .then(a.orientation.total_cmp(&b.orientation))
}
