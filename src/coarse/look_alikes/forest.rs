//! The strongest chains of pairs between photographs.

use std::collections::BTreeMap;

use crate::scene::ImageId;

/// A pair that joins two trees.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Link {
    pub(super) images: (ImageId, ImageId),
    pub(super) strength: f64,
}

/// Trees of images joined by descending strength. Trees are hung under the larger one's root and never flattened, so the
/// weakest link of the strongest chain between two images is the weakest on their ways up to where these meet, which are
/// logarithmically short.
#[derive(Default)]
pub(super) struct SpanningForest {
    /// The parent and the join.
    parent: BTreeMap<ImageId, (ImageId, Link)>,
    size: BTreeMap<ImageId, usize>,
    /// The links of every image.
    links: BTreeMap<ImageId, Vec<Link>>,
}

impl SpanningForest {
    /// The images from one up to its root, each with the weakest link on the way.
    fn way_up(&self, image: ImageId) -> Vec<(ImageId, Option<Link>)> {
        let mut way = vec![(image, None)];
        let (mut at, mut weakest) = (image, None);
        while let Some(&(parent, link)) = self.parent.get(&at) {
            at = parent;
            weakest = weaker(weakest, Some(link));
            way.push((at, weakest));
        }
        way
    }

    /// Joins two trees; when the images are in one already, the weakest link of the strongest chain between them.
    pub(super) fn join_or_weakest_link(&mut self, link: Link) -> Option<Link> {
        let (way_a, way_b) = (self.way_up(link.images.0), self.way_up(link.images.1));
        let meeting = way_a.iter().find_map(|&(image, weakest_a)| {
            let &(_, weakest_b) = way_b.iter().find(|&&(other, _)| other == image)?;
            weaker(weakest_a, weakest_b)
        });
        if meeting.is_some() {
            return meeting;
        }
        let (root_a, root_b) = (way_a[way_a.len() - 1].0, way_b[way_b.len() - 1].0);
        let [size_a, size_b] = [root_a, root_b].map(|root| self.size.get(&root).copied().unwrap_or(1));
        let (over, under) = if size_a >= size_b { (root_a, root_b) } else { (root_b, root_a) };
        self.parent.insert(under, (over, link));
        self.size.insert(over, size_a + size_b);
        for image in [link.images.0, link.images.1] {
            self.links.entry(image).or_default().push(link);
        }
        None
    }

    /// The links of the strongest chain between two images; none where there is no chain.
    pub(super) fn chain(&self, (from, to): (ImageId, ImageId)) -> Vec<Link> {
        let mut came_by: BTreeMap<ImageId, (ImageId, Link)> = BTreeMap::new();
        let mut waiting = vec![from];
        while let Some(at) = waiting.pop() {
            for &link in self.links.get(&at).into_iter().flatten() {
                let next = if link.images.0 == at { link.images.1 } else { link.images.0 };
                if next != from && !came_by.contains_key(&next) {
                    came_by.insert(next, (at, link));
                    waiting.push(next);
                }
            }
        }
        let mut chain = Vec::new();
        let mut at = to;
        while let Some(&(before, link)) = came_by.get(&at) {
            chain.push(link);
            at = before;
        }
        chain
    }
}

/// The weaker of two links, the other where one is missing.
fn weaker(a: Option<Link>, b: Option<Link>) -> Option<Link> {
    match (a, b) {
        (Some(first), Some(second)) => Some(if second.strength < first.strength { second } else { first }),
        (link, None) | (None, link) => link,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_weakest_link_of_the_strongest_chain_is_found() {
        let mut forest = SpanningForest::default();
        let mut join = |a: u32, b: u32, strength: f64| {
            let link = Link { images: (ImageId(a), ImageId(b)), strength };
            forest.join_or_weakest_link(link).map(|weakest| (weakest.images.0.0, weakest.images.1.0, weakest.strength))
        };
        assert_eq!(join(0, 1, 0.9), None);
        assert_eq!(join(2, 3, 0.8), None);
        assert_eq!(join(4, 3, 0.7), None);
        assert_eq!(join(1, 2, 0.5), None);
        assert_eq!(join(0, 4, 0.4), Some((1, 2, 0.5)));
        assert_eq!(join(4, 2, 0.4), Some((4, 3, 0.7)));
        assert_eq!(join(5, 0, 0.3), None);
        assert_eq!(join(5, 3, 0.2), Some((5, 0, 0.3)));
        let chain = |a: u32, b: u32| -> Vec<(u32, u32)> {
            let links = forest.chain((ImageId(a), ImageId(b)));
            links.iter().map(|link| (link.images.0.0, link.images.1.0)).collect()
        };
        assert_eq!(chain(5, 4), [(4, 3), (2, 3), (1, 2), (0, 1), (5, 0)]);
        assert_eq!(chain(2, 3), [(2, 3)]);
        assert_eq!(chain(3, 9), []);
    }
}
