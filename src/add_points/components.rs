//! Which tracks and points of the model hang together: they share sightings, at once or by way of others (paper, section 6.3).

use std::collections::HashMap;

use super::stars::StarTracks;
use super::views::ViewTable;
use crate::math::{Grouped, UnionFind};
use crate::scene::{Observation, Point3dId, Reconstruction};

/// The components with at least one track, in the order of their first.
pub struct Components {
    stars: Grouped<u32>,
    points: Grouped<Point3dId>,
}

impl Components {
    /// Of these tracks and the points of the model.
    pub fn new(model: &Reconstruction, table: &ViewTable, stars: &StarTracks) -> Self {
        let mut sets = UnionFind::new(table.num_nodes());
        let node_of = |observation: &Observation| table.node(table.sighting(observation));
        for (_, point) in model.points() {
            for pair in point.track.windows(2) {
                sets.union(node_of(&pair[0]), node_of(&pair[1]));
            }
        }
        for star in stars.iter() {
            for pair in star.sightings.windows(2) {
                sets.union(table.node(pair[0]), table.node(pair[1]));
            }
        }
        let mut of_root: HashMap<usize, u32> = HashMap::new();
        let of_stars = (0u32..).zip(stars.iter()).map(|(at, star)| {
            let next = of_root.len() as u32;
            (*of_root.entry(sets.find(table.node(star.sightings[0]))).or_insert(next), at)
        });
        let of_stars: Vec<(u32, u32)> = of_stars.collect();
        let of_points = model.points().filter_map(|(id, point)| {
            let component = of_root.get(&sets.find(node_of(&point.track[0])))?;
            Some((*component, id))
        });
        let of_points: Vec<(u32, Point3dId)> = of_points.collect();
        let count = of_root.len();
        Self { stars: Grouped::new(count, of_stars.into_iter()), points: Grouped::new(count, of_points.into_iter()) }
    }

    /// How many.
    pub fn len(&self) -> usize {
        self.stars.num_groups()
    }

    /// The numbers of a component's tracks and the ids of its points, both ascending.
    pub fn get(&self, component: usize) -> (&[u32], &[Point3dId]) {
        (self.stars.group(component), self.points.group(component))
    }
}
