//! Typed identifiers. None of them has a sentinel value: an absent id is `Option`.

use std::num::NonZeroU32;

use serde::{Deserialize, Serialize};

macro_rules! id {
    ($(#[$doc:meta])* $name:ident) => {
        $(#[$doc])*
        #[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Debug, Serialize, Deserialize)]
        #[serde(transparent)]
        pub struct $name(pub u32);

        impl $name {
            /// The id as an index into a dense array.
            #[inline]
            pub fn index(self) -> usize {
                self.0 as usize
            }
        }
    };
}

id!(
    /// An input photograph: its rank in the sorted list of input names.
    ImageId
);
id!(
    /// A set of intrinsics, shared by one or more images.
    CameraId
);
id!(
    /// The rank of a keypoint in its image's features, which are sorted by descending scale.
    KeypointIdx
);

/// A 3D point of one reconstruction. Every keypoint of a model has room for one or none, so its index is kept plus one: an
/// absent id takes no room of its own.
#[derive(Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Point3dId(NonZeroU32);

impl Point3dId {
    /// The point of this rank among those ever made in its model.
    ///
    /// # Panics
    /// From 2^32 - 1 on.
    #[inline]
    pub fn new(index: usize) -> Self {
        let plus_one = u32::try_from(index + 1).ok().and_then(NonZeroU32::new);
        Self(plus_one.expect("a model has fewer than 2^32 - 1 points"))
    }

    /// The id as an index into a dense array.
    #[inline]
    pub fn index(self) -> usize {
        self.0.get() as usize - 1
    }
}

impl std::fmt::Debug for Point3dId {
    fn fmt(&self, out: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(out, "Point3dId({})", self.index())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_absent_point_takes_no_room() {
        assert_eq!(size_of::<Option<Point3dId>>(), 4);
        assert_eq!([0, 7].map(|index| Point3dId::new(index).index()), [0, 7]);
        assert_eq!(format!("{:?}", Point3dId::new(7)), "Point3dId(7)");
    }
}
