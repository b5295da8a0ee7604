//! Correspondences between points of the model and keypoints of an image, one to one.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use crate::scene::{KeypointIdx, Point3dId};

/// A point of the model and the keypoint that is thought to see it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub struct Correspondence {
    /// The keypoint.
    pub keypoint: KeypointIdx,
    /// The point.
    pub point: Point3dId,
}

/// How good a claim is: more votes first, then the smaller descriptor distance.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
struct Strength {
    votes: u32,
    nearness: std::cmp::Reverse<u32>,
}

/// Claims that are kept one to one: a claim replaces those it contradicts only when it is stronger than each of them.
#[derive(Clone, Debug, Default)]
pub struct OneToOne {
    by_keypoint: BTreeMap<KeypointIdx, (Point3dId, Strength)>,
    by_point: BTreeMap<Point3dId, KeypointIdx>,
}

impl OneToOne {
    /// Number of correspondences.
    pub fn len(&self) -> usize {
        self.by_keypoint.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.by_keypoint.is_empty()
    }

    /// Whether the point has a keypoint.
    pub fn has_point(&self, point: Point3dId) -> bool {
        self.by_point.contains_key(&point)
    }

    /// Claims that `keypoint` sees `point`; whether that was accepted.
    pub fn claim(&mut self, keypoint: KeypointIdx, point: Point3dId, votes: u32, distance_sq: u32) -> bool {
        let strength = Strength { votes, nearness: std::cmp::Reverse(distance_sq) };
        let of_keypoint = self.by_keypoint.get(&keypoint).copied();
        let other_keypoint = self.by_point.get(&point).copied();
        let of_point = other_keypoint.and_then(|other| self.by_keypoint.get(&other).copied());
        if [of_keypoint, of_point].into_iter().flatten().any(|(_, before)| before >= strength) {
            return false;
        }
        if let Some((point, _)) = of_keypoint {
            self.by_point.remove(&point);
        }
        if let Some(other) = other_keypoint {
            self.by_keypoint.remove(&other);
        }
        self.by_keypoint.insert(keypoint, (point, strength));
        self.by_point.insert(point, keypoint);
        true
    }

    /// The correspondences by keypoint.
    pub fn into_sorted(self) -> Vec<Correspondence> {
        self.by_keypoint.into_iter().map(|(keypoint, (point, _))| Correspondence { keypoint, point }).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_stronger_claim_stays() {
        let mut claims = OneToOne::default();
        assert!(claims.claim(KeypointIdx(1), Point3dId::new(10), 1, 500));
        assert!(!claims.claim(KeypointIdx(1), Point3dId::new(11), 1, 500), "no better");
        assert!(claims.claim(KeypointIdx(2), Point3dId::new(11), 1, 100));
        // Nearer than what keypoint 1 has, but not than what point 11 has.
        assert!(!claims.claim(KeypointIdx(1), Point3dId::new(11), 1, 200));
        // Stronger than both: takes both places.
        assert!(claims.claim(KeypointIdx(1), Point3dId::new(11), 2, 400));
        assert_eq!(claims.len(), 1);
        assert!(!claims.has_point(Point3dId::new(10)));
        assert_eq!(claims.into_sorted(), [Correspondence { keypoint: KeypointIdx(1), point: Point3dId::new(11) }]);
    }
}
