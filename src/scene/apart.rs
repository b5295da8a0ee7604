//! Images known to show different places that look alike.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::ImageId;

/// Pairs of images that show different places, so that no point can be seen by both.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ApartImages {
    others: BTreeMap<ImageId, BTreeSet<ImageId>>,
}

impl ApartImages {
    /// Whether no images are known to be apart.
    pub fn is_empty(&self) -> bool {
        self.others.is_empty()
    }

    /// Whether two images are apart.
    pub fn are_apart(&self, a: ImageId, b: ImageId) -> bool {
        self.others.get(&a).is_some_and(|others| others.contains(&b))
    }

    /// Whether an image is apart from any of these.
    pub fn from_any(&self, image: ImageId, others: impl IntoIterator<Item = ImageId>) -> bool {
        self.others.get(&image).is_some_and(|apart| others.into_iter().any(|other| apart.contains(&other)))
    }
}

impl FromIterator<(ImageId, ImageId)> for ApartImages {
    fn from_iter<T: IntoIterator<Item = (ImageId, ImageId)>>(pairs: T) -> Self {
        let mut apart = Self::default();
        for (a, b) in pairs {
            apart.others.entry(a).or_default().insert(b);
            apart.others.entry(b).or_default().insert(a);
        }
        apart
    }
}
