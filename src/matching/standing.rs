//! Matches that stand still in the frame: what is at the same pixel in both pictures while the rest has moved is no
//! part of the scene. It is the room behind an object on a turntable before a camera on a tripod, a date or a name
//! stamped on photographs, a spot on the sensor. Such matches agree with a camera that did not move, and where they are
//! many they outvote the object.
//!
//! They are told by the density of shifts. Matches of a scene between two places have shifts that vary smoothly over
//! the picture, so the shifts within a small radius of zero are fewer than those in the ring around it, whose area is
//! eight times theirs if it is three times as wide. (Even along the axis that a camera turns about, where one component
//! is zero, the ring holds twice as many.) Matches of what stands still lie within the radius alone.

use serde::{Deserialize, Serialize};

/// When matches stand still.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct StandingOptions {
    /// Whether matches that stand still are left out of pairs whose other matches have a geometry of their own.
    pub leave_out: bool,
    /// Shift up to which a match stands still, in pixels: what keypoints of one spot differ by between two pictures.
    pub max_shift_px: f64,
    /// Fewest matches that stand still. Below, chance may do it.
    pub min_matches: usize,
    /// So many times as many as in the ring around them. A scene has half of what is in the ring at most, so chance
    /// reaches 2 hardly ever; of a background nearly all is within.
    pub min_contrast: f64,
}

impl Default for StandingOptions {
    fn default() -> Self {
        Self { leave_out: true, max_shift_px: 1.0, min_matches: 10, min_contrast: 2.0 }
    }
}

impl StandingOptions {
    /// Appends what is wrong with the values.
    pub fn validate(&self, errors: &mut Vec<String>) {
        if !(self.max_shift_px > 0.0 && self.max_shift_px.is_finite()) {
            errors.push(format!("standing.max_shift_px must be positive, not {}", self.max_shift_px));
        }
        if !(self.min_contrast >= 1.0 && self.min_contrast.is_finite()) {
            errors.push(format!("standing.min_contrast must be at least 1, not {}", self.min_contrast));
        }
    }
}

/// The radius of the ring around the shifts that stand still, as a multiple of theirs.
const RING: f64 = 3.0;

/// A pair's matches that moved, in their order, by their shifts in pixels; none where none to speak of stand still. The
/// two pictures must be of one size.
pub fn moved<T: Clone>(matches: &[T], shift_px: impl Fn(&T) -> f64, options: &StandingOptions) -> Option<Vec<T>> {
    let shifts_px: Vec<f64> = matches.iter().map(shift_px).collect();
    let within = |radius_px: f64| shifts_px.iter().filter(|&&shift_px| shift_px <= radius_px).count();
    let standing = within(options.max_shift_px);
    let in_ring = within(RING * options.max_shift_px) - standing;
    let stand_out = standing as f64 > options.min_contrast * in_ring as f64;
    let moved = matches.iter().zip(&shifts_px).filter(|&(_, &shift_px)| shift_px > options.max_shift_px);
    (options.leave_out && standing >= options.min_matches && stand_out)
        .then(|| moved.map(|(found, _)| found.clone()).collect())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Rng;

    /// Shifts of `n` matches of a camera that goes round what it looks at: along x as the distance to the axis, along y
    /// by noise.
    fn of_a_scene(n: usize, rng: &mut Rng) -> Vec<f64> {
        (0..n).map(|_| (rng.range(-40.0, 40.0_f64) + 0.5 * rng.normal()).hypot(0.5 * rng.normal())).collect()
    }

    /// And of `n` that stand still.
    fn of_a_background(n: usize, rng: &mut Rng) -> Vec<f64> {
        (0..n).map(|_| (0.25 * rng.normal()).hypot(0.25 * rng.normal())).collect()
    }

    #[test]
    fn a_background_is_told_from_what_a_camera_goes_round() {
        let (mut rng, options) = (Rng::from_parts(&[1]), StandingOptions::default());
        for n in [100, 1000, 10_000] {
            let scene = of_a_scene(n, &mut rng);
            assert_eq!(moved(&scene, |&shift_px| shift_px, &options), None, "{n} matches of a scene");
            let background = of_a_background(n / 5, &mut rng);
            let both: Vec<(bool, f64)> =
                background.into_iter().map(|at| (true, at)).chain(scene.into_iter().map(|at| (false, at))).collect();
            let moved = moved(&both, |&(_, shift_px)| shift_px, &options).expect("a background");
            let stayed =
                |of_background| moved.iter().filter(|(is_background, _)| *is_background == of_background).count();
            let (background, scene) = (n / 5 - stayed(true), n - stayed(false));
            assert!(background > n / 5 - n / 100, "{background} of {} matches of the background", n / 5);
            assert!(scene < n / 20, "{scene} of {n} matches of the scene");
        }
    }

    #[test]
    fn a_few_still_matches_are_chance_and_the_option_turns_it_off() {
        let (mut rng, options) = (Rng::from_parts(&[2]), StandingOptions::default());
        let mut shifts_px = of_a_background(options.min_matches - 1, &mut rng);
        shifts_px.resize(500, 30.0);
        assert_eq!(moved(&shifts_px, |&at| at, &options), None);
        shifts_px.push(0.0);
        assert!(moved(&shifts_px, |&at| at, &options).is_some());
        assert_eq!(moved(&shifts_px, |&at| at, &StandingOptions { leave_out: false, ..options }), None);
    }
}
