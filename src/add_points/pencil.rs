//! The pencil of epipolar lines: all pass through the epipole, so one number orders them, and the positions between them.
//!
//! Whether the epipole is in the image, far away or at infinity: in coordinates centred on the target's box and scaled by its
//! size, the lines `l` through the homogeneous epipole `e` are the plane `l . e = 0`. With an orthonormal basis `u, v` of that
//! plane, `l = a u + b v`, and the direction of `(a, b)`, up to sign, is the line's *turn* about the epipole.
//!
//! A position `p = (x, y, 1)` has `s = u . p` and `t = v . p`, and lies on the line with `a s + b t = 0`, so its own turn is
//! that of `(t, -s)`. With `rho = |(s, t)|`, its *reach*, and `alpha` the angle between both turns, its distance from another
//! line of unit `(a, b)` is
//!
//! ```text
//! distance = size |l . p| / |(l_x, l_y)| = size rho |sin alpha| / |(l_x, l_y)|
//! ```
//!
//! (`size` takes scaled units to pixels), so a band around a line is a wedge of turns for all positions of one reach.

use nalgebra::{Matrix3, Vector2, Vector3};

use super::epipolar::BoundingBox;

/// The length of `(a, b)`. Scaled coordinates are far from where squares overflow, which `hypot` takes care of at ten times the
/// cost.
fn length(a: f64, b: f64) -> f64 {
    (a * a + b * b).sqrt()
}

/// The lines through an epipole.
pub struct Pencil {
    /// Takes line coefficients to centred, scaled coordinates.
    lines_to_scaled: Matrix3<f64>,
    center: Vector2<f64>,
    size_px: f64,
    u: Vector3<f64>,
    v: Vector3<f64>,
}

/// A direction in the plane of `a` and `b`, up to sign, as a number that grows with its angle from 0 to pi: `1 - a / (|a| + b)`
/// for `b >= 0`, in units of 2^-31.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Turn(pub u32);

impl Turn {
    /// Of the direction of `(a, b)`; of the zero vector that of `(1, 0)`.
    fn of(a: f64, b: f64) -> Self {
        let (a, b) = if b < 0.0 || (b == 0.0 && a < 0.0) { (-a, -b) } else { (a, b) };
        let length = a.abs() + b;
        let turn = if length > 0.0 { 1.0 - a / length } else { 0.0 };
        // Saturates at the top, which is as far as turns go.
        Self((turn * f64::from(1u32 << 31)) as u32)
    }
}

/// A line of the pencil.
#[derive(Clone, Copy, Debug)]
pub struct PencilLine {
    /// Its turn.
    pub turn: Turn,
    /// Unit `(a, b)`.
    direction: [f64; 2],
    /// `|(l_x, l_y)| / size`: a distance in pixels, times this, is `rho |sin alpha|`.
    per_px: f64,
}

impl Pencil {
    /// Of the lines through an epipole (homogeneous, in undistorted pixels), for positions in a box.
    pub fn new(epipole: &Vector3<f64>, bounds: &BoundingBox) -> Self {
        let (center, size_px) = ((bounds.min + bounds.max) / 2.0, (bounds.max - bounds.min).norm().max(1.0));
        // A position p is center + size p', so l . p = 0 reads (H^T l) . p' = 0 with H below.
        let from_scaled = Matrix3::new(size_px, 0.0, center.x, 0.0, size_px, center.y, 0.0, 0.0, 1.0);
        let scaled =
            Vector3::new(epipole.x - center.x * epipole.z, epipole.y - center.y * epipole.z, size_px * epipole.z)
                .normalize();
        let least = scaled.iamin();
        let u = scaled.cross(&Vector3::ith(least, 1.0)).normalize();
        Self { lines_to_scaled: from_scaled.transpose(), center, size_px, v: scaled.cross(&u), u }
    }

    /// Middle of the box.
    pub fn center(&self) -> Vector2<f64> {
        self.center
    }

    /// A line by its coefficients, of no particular scale.
    pub fn line(&self, coefficients: &Vector3<f64>) -> PencilLine {
        let line = self.lines_to_scaled * coefficients;
        let (a, b) = (line.dot(&self.u), line.dot(&self.v));
        let norm = length(a, b);
        let (a, b) = (a / norm, b / norm);
        let unit = self.u * a + self.v * b;
        PencilLine { turn: Turn::of(a, b), direction: [a, b], per_px: length(unit.x, unit.y) / self.size_px }
    }

    /// Turn and reach of a position.
    pub fn position(&self, at: &Vector2<f64>) -> (Turn, f64) {
        let scaled = ((at - self.center) / self.size_px).push(1.0);
        let (s, t) = (scaled.dot(&self.u), scaled.dot(&self.v));
        (Turn::of(t, -s), length(s, t))
    }
}

impl PencilLine {
    /// The turns of the positions within a distance of the line, of all that have at least some reach: from the first to the
    /// second, through the end and the start of the scale when the first is larger; none when every turn may do.
    pub fn wedge(&self, distance_px: f64, least_reach: f64) -> Option<(Turn, Turn)> {
        let sin = distance_px * self.per_px / least_reach;
        if sin.is_nan() || sin >= 1.0 {
            return None;
        }
        let ([a, b], cos) = (self.direction, (1.0 - sin * sin).sqrt());
        Some((Turn::of(a * cos + b * sin, b * cos - a * sin), Turn::of(a * cos - b * sin, b * cos + a * sin)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::add_points::epipolar::EpipolarLine;
    use crate::math::Rng;

    #[test]
    fn turns_grow_with_the_angle() {
        let turns: Vec<Turn> =
            (0..1000).map(|k| f64::from(k) * 0.00314).map(|angle| Turn::of(angle.cos(), angle.sin())).collect();
        assert!(turns.windows(2).all(|pair| pair[0] < pair[1]));
        assert_eq!(Turn::of(-0.3, -0.7), Turn::of(0.3, 0.7));
    }

    /// Positions within a distance of a line have their turns in its wedge, wherever the epipole is.
    #[test]
    fn wedges_hold_the_band() {
        let mut rng = Rng::from_parts(&[3]);
        let bounds = BoundingBox { min: Vector2::new(-20.0, 10.0), max: Vector2::new(980.0, 810.0) };
        let epipoles = [
            Vector3::new(1.0, 0.2, 0.0),
            Vector3::new(480.0, 410.0, 1.0),
            Vector3::new(300.0, 700.0, 1.0),
            Vector3::new(-9000.0, 300.0, 1.0),
        ];
        let mut within = 0;
        for epipole in epipoles {
            let pencil = Pencil::new(&epipole, &bounds);
            for _ in 0..2000 {
                let mut inside = || Vector2::new(rng.range(-20.0, 980.0), rng.range(10.0, 810.0));
                let (on_line, at) = (inside(), inside());
                let coefficients = epipole.cross(&on_line.push(1.0));
                let line = EpipolarLine::from_coefficients(&coefficients).unwrap();
                let of_pencil = pencil.line(&coefficients);
                assert!(pencil.position(&on_line).0.0.abs_diff(of_pencil.turn.0) < 200);
                let (turn, reach) = pencil.position(&at);
                let distance_px = line.distance_px(&at);
                for (half_width_px, expected) in [(1.001 * distance_px, true), (0.999 * distance_px, false)] {
                    let inside = of_pencil.wedge(half_width_px, reach).is_none_or(|(low, high)| {
                        if low <= high { low <= turn && turn <= high } else { turn >= low || turn <= high }
                    });
                    assert_eq!(inside, expected || half_width_px * of_pencil.per_px >= reach, "{epipole} {at}");
                    within += usize::from(inside);
                }
            }
        }
        assert!(within >= 8000);
    }
}
