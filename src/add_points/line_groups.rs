//! Queries that share an epipolar line, and so its candidates (paper, section 6.2.2).
//!
//! All points on a line in the target have their counterparts on one *dual* line in the query image, so the queries along a
//! dual line have nearly the same epipolar line. They are grouped: two queries share a group when their lines cut the
//! target's border within a tolerance (2 pixels) at both ends.
//!
//! Epipolar lines are a pencil ([`super::pencil`]): one number orders them, their turn about the epipole. Sorted by it, a
//! group ends as soon as a line's border hits are further than the tolerance from those of the group's *first* line.
//! Comparing each line with the one before it instead, as the paper's appendix A.2 does, lets groups drift without bound.

use nalgebra::Vector2;

use super::epipolar::{BoundingBox, EpipolarGeometry, EpipolarLine};
use super::pencil::{Pencil, Turn};
use crate::camera::Normalized;

/// Queries with nearly one epipolar line.
#[derive(Clone, Debug)]
pub struct LineGroup {
    /// The line of the group's first query.
    pub anchor: EpipolarLine,
    /// The queries, by the turns of their lines.
    pub queries: Vec<u32>,
}

/// A query's line, where it cuts the border, and its place in the pencil.
struct QueryLine {
    query: u32,
    turn: Turn,
    line: EpipolarLine,
    ends: [Vector2<f64>; 2],
}

/// Groups queries by their lines in the target. Queries whose line misses the target's box, and those without a line, are
/// in no group.
pub fn group_by_line(
    geometry: &EpipolarGeometry,
    queries: impl Iterator<Item = (u32, Normalized)>,
    target_bounds: &BoundingBox,
    tolerance_px: f64,
) -> Vec<LineGroup> {
    let pencil = Pencil::new(&geometry.epipole_in_target(), target_bounds);
    let mut lines: Vec<QueryLine> = queries
        .filter_map(|(query, at)| {
            let coefficients = geometry.line_coefficients(&at);
            let line = EpipolarLine::from_coefficients(&coefficients)?;
            let ends = target_bounds.clip(&line)?;
            Some(QueryLine { query, turn: pencil.line(&coefficients).turn, line, ends })
        })
        .collect();
    lines.sort_unstable_by_key(|line| (line.turn, line.query));
    let mut groups: Vec<LineGroup> = Vec::new();
    let mut anchor_ends = [Vector2::repeat(f64::INFINITY); 2];
    for QueryLine { query, line, ends, .. } in lines {
        if within(&anchor_ends, &ends, tolerance_px) {
            let group = groups.last_mut().expect("the ends of no group are at infinity");
            group.queries.push(query);
        } else {
            anchor_ends = ends;
            groups.push(LineGroup { anchor: line, queries: vec![query] });
        }
    }
    groups
}

/// Whether two lines cut the border nearby at both ends, taken in either order: a line's direction flips somewhere in
/// every pencil.
fn within(a: &[Vector2<f64>; 2], b: &[Vector2<f64>; 2], tolerance_px: f64) -> bool {
    let near = |p: &Vector2<f64>, q: &Vector2<f64>| (p - q).norm() <= tolerance_px;
    near(&a[0], &b[0]) && near(&a[1], &b[1]) || near(&a[0], &b[1]) && near(&a[1], &b[0])
}

#[cfg(test)]
mod tests {
    use nalgebra::{UnitQuaternion, Vector3};

    use super::*;
    use crate::camera::{Camera, CameraModel, FocalSource, Pixel};
    use crate::geometry::Rigid3;
    use crate::math::Rng;

    const TOLERANCE: f64 = 2.0;

    fn grouped(center_of_target: Vector3<f64>, turn: f64) -> (Vec<LineGroup>, EpipolarGeometry, Vec<Normalized>) {
        let camera = Camera::centered(CameraModel::Pinhole, 1000, 800, 900.0, FocalSource::Known);
        let target =
            Rigid3::from_center(UnitQuaternion::from_scaled_axis(Vector3::new(0.0, turn, 0.0)), &center_of_target);
        let geometry = EpipolarGeometry::new((&camera, &Rigid3::identity()), (&camera, &target)).unwrap();
        let mut rng = Rng::from_parts(&[5]);
        let queries: Vec<Normalized> =
            (0..5000).map(|_| camera.unproject(&Pixel::new(rng.range(0.0, 1000.0), rng.range(0.0, 800.0)))).collect();
        let groups = group_by_line(&geometry, (0..).zip(queries.iter().copied()), &BOX, TOLERANCE);
        (groups, geometry, queries)
    }

    const BOX: BoundingBox = BoundingBox { min: Vector2::new(0.0, 0.0), max: Vector2::new(1000.0, 800.0) };

    /// Epipole at infinity, in the image, far to the side.
    fn setups() -> [(Vector3<f64>, f64); 3] {
        [(Vector3::new(1.0, 0.0, 0.0), 0.0), (Vector3::new(0.05, 0.0, 1.0), 0.0), (Vector3::new(1.0, 0.2, 0.1), -0.2)]
    }

    #[test]
    fn every_line_is_near_its_groups_first() {
        for (center, turn) in setups() {
            let (groups, geometry, queries) = grouped(center, turn);
            let mut grouped_queries = 0;
            for group in &groups {
                grouped_queries += group.queries.len();
                let anchor = BOX.clip(&group.anchor).unwrap();
                for &query in &group.queries {
                    let line = geometry.line_in_target(&queries[query as usize]).unwrap();
                    assert!(within(&anchor, &BOX.clip(&line).unwrap(), TOLERANCE));
                }
            }
            assert!(grouped_queries > 4000, "{grouped_queries}");
            assert!(grouped_queries > 5 * groups.len(), "groups are worth it: {}", groups.len());
        }
    }

    #[test]
    fn no_query_is_in_two_groups_and_order_does_not_matter() {
        for (center, turn) in setups() {
            let (groups, geometry, queries) = grouped(center, turn);
            let mut all: Vec<u32> = groups.iter().flat_map(|group| group.queries.clone()).collect();
            all.sort_unstable();
            assert!(all.windows(2).all(|pair| pair[0] != pair[1]));
            let backwards = (0..queries.len() as u32).rev().map(|q| (q, queries[q as usize]));
            let again = group_by_line(&geometry, backwards, &BOX, TOLERANCE);
            let members = |groups: &[LineGroup]| groups.iter().map(|g| g.queries.clone()).collect::<Vec<_>>();
            assert_eq!(members(&groups), members(&again));
        }
    }

    #[test]
    fn groups_do_not_chain() {
        // Thousands of parallel lines a fraction of a pixel apart: chained by their predecessors they would be one group.
        let (groups, ..) = grouped(Vector3::new(1.0, 0.0, 0.0), 0.0);
        let tallest = 800.0 / TOLERANCE;
        assert!(groups.len() as f64 > 0.8 * tallest && groups.len() as f64 <= tallest + 1.0, "{}", groups.len());
    }
}
