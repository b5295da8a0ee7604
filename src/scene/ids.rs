//! Typed identifiers. None of them has a sentinel value: an absent id is `Option`.

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
    /// A 3D point of one reconstruction.
    Point3dId
);
id!(
    /// The rank of a keypoint in its image's features, which are sorted by descending scale.
    KeypointIdx
);
