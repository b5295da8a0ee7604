//! The star-shaped tracks of all images in one piece, most sets of sightings once.
//!
//! A point that n images see is found n times, from each of them, mostly with the same sightings: kept as found, the stars of
//! a hundred photographs take more memory than the model they are for. So a star is left out where the star of its own first
//! sighting has the same sightings (the better of the two stays), and what is left lies in two arrays, without a heap block of
//! its own for every star.

use nalgebra::Vector3;

use super::triangulate::StarTrack;
use super::views::Sighting;
use crate::scene::KeypointIdx;

/// Stars by image and keypoint of their queries.
#[derive(Debug)]
pub struct StarTracks {
    stars: Vec<PackedStar>,
    sightings: Vec<Sighting>,
    /// Where the stars of each image start, by rank, and the end of them all.
    first_of_image: Vec<usize>,
}

#[derive(Debug)]
struct PackedStar {
    xyz: Vector3<f64>,
    mean_relative_error_sq: f64,
    first_sighting: usize,
    query: KeypointIdx,
    distinctive: bool,
}

/// One of [`StarTracks`].
#[derive(Clone, Copy, Debug)]
pub struct Star<'a> {
    /// The sightings that agree, sorted; one an image, two or more.
    pub sightings: &'a [Sighting],
    /// The point.
    pub xyz: Vector3<f64>,
    /// Whether all matches it is made of are distinctive.
    pub distinctive: bool,
    /// Mean of the squared errors, relative to what is allowed.
    pub mean_relative_error_sq: f64,
}

impl Default for StarTracks {
    fn default() -> Self {
        Self { stars: Vec::new(), sightings: Vec::new(), first_of_image: vec![0] }
    }
}

impl StarTracks {
    /// Number of stars.
    pub fn len(&self) -> usize {
        self.stars.len()
    }

    /// Whether there is none.
    pub fn is_empty(&self) -> bool {
        self.stars.is_empty()
    }

    /// The star of this number.
    pub fn get(&self, at: usize) -> Star<'_> {
        let star = &self.stars[at];
        let end = self.stars.get(at + 1).map_or(self.sightings.len(), |next| next.first_sighting);
        Star {
            sightings: &self.sightings[star.first_sighting..end],
            xyz: star.xyz,
            distinctive: star.distinctive,
            mean_relative_error_sq: star.mean_relative_error_sq,
        }
    }

    /// All of them.
    pub fn iter(&self) -> impl Iterator<Item = Star<'_>> {
        (0..self.len()).map(|at| self.get(at))
    }

    /// Adds the stars of the image of the next rank, sorted by their queries.
    pub fn add_image(&mut self, stars: Vec<StarTrack>) {
        for star in stars {
            match self.same_sightings(&star.sightings) {
                Some(at) => self.keep_better(at, &star),
                None => {
                    self.stars.push(PackedStar {
                        xyz: star.xyz,
                        mean_relative_error_sq: star.mean_relative_error_sq,
                        first_sighting: self.sightings.len(),
                        query: star.query.keypoint,
                        distinctive: star.distinctive,
                    });
                    self.sightings.extend(star.sightings);
                }
            }
        }
        self.first_of_image.push(self.stars.len());
    }

    /// The star of the first of these sightings, if it is of an image before and has the same.
    fn same_sightings(&self, sightings: &[Sighting]) -> Option<usize> {
        let first = sightings[0];
        let rank = first.rank as usize;
        let &[start, end] = self.first_of_image.get(rank..rank + 2)? else { return None };
        let at = self.stars[start..end].binary_search_by_key(&first.keypoint, |star| star.query).ok()?;
        (self.get(start + at).sightings == sightings).then_some(start + at)
    }

    fn keep_better(&mut self, at: usize, other: &StarTrack) {
        let star = &mut self.stars[at];
        let is_better = other.distinctive && !star.distinctive
            || other.distinctive == star.distinctive && other.mean_relative_error_sq < star.mean_relative_error_sq;
        if is_better {
            star.xyz = other.xyz;
            star.mean_relative_error_sq = other.mean_relative_error_sq;
            star.distinctive = other.distinctive;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn seen(rank: u32, keypoint: u32) -> Sighting {
        Sighting { rank, keypoint: KeypointIdx(keypoint) }
    }

    fn star(sightings: &[Sighting], x: f64, distinctive: bool, error: f64) -> StarTrack {
        let (xyz, query, mut sightings) = (Vector3::new(x, 0.0, 0.0), sightings[0], sightings.to_vec());
        sightings.sort_unstable();
        StarTrack { query, sightings, xyz, distinctive, mean_relative_error_sq: error }
    }

    #[test]
    fn of_stars_with_the_same_sightings_the_better_stays() {
        let (a, b, c, d) = (seen(0, 7), seen(1, 2), seen(2, 5), seen(2, 6));
        let mut stars = StarTracks::default();
        stars.add_image(vec![star(&[seen(0, 3), b], 1.0, true, 0.3), star(&[a, b, c], 2.0, false, 0.1)]);
        stars.add_image(vec![star(&[b, a, c], 3.0, true, 0.4)]);
        stars.add_image(vec![star(&[c, a, b], 4.0, true, 0.5), star(&[d, a, b], 5.0, true, 0.0)]);
        let kept: Vec<(f64, usize, bool)> =
            stars.iter().map(|star| (star.xyz.x, star.sightings.len(), star.distinctive)).collect();
        assert_eq!(kept, [(1.0, 2, true), (3.0, 3, true), (5.0, 3, true)]);
        assert_eq!(stars.get(2).sightings, [a, b, d]);
        assert_eq!((stars.len(), stars.is_empty()), (3, false));
    }
}
