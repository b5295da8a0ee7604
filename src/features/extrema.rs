//! Extrema of the difference of Gaussians: found on the grid, then refined by fitting a quadratic (Brown and Lowe,
//! "Invariant features from interest point groups", BMVC 2002).
//!
//! Around a grid point D(d) = D + g'd + d'Hd/2 with g, H from central differences; its extremum is d = -H^-1 g, where
//! D is D + g'd/2. While d leaves the cell, the fit moves on to the neighbouring grid point.
//!
//! Central differences take the third and fourth derivatives for nothing, which at the finest level of an octave (sigma 1.2
//! of its pixels) draws d towards the grid point by up to 0.07 pixels, as much as all other errors of a sharp photograph. So
//! an extremum that is kept is settled by two more steps d <- d - H^-1 g(d), where g(d) is the gradient at d itself: of the
//! polynomial of fourth degree through five columns and rows, and of second degree through three levels.

use nalgebra::{Matrix3, Vector3};

use super::octave::Levels;
use super::options::SiftOptions;
use super::ring::Ring;
use super::simd::stamp;

/// The fit may move this many rows from the grid extremum.
pub(super) const MAX_ROW_STEPS: usize = 3;
/// The fit moves on from a grid point whose extremum is farther than this in some coordinate; slightly more than half, so
/// that an extremum midway between two seldom makes it swing.
pub(super) const MOVE_OFFSET: f32 = 0.6;
/// Where it swings all the same, the last fit counts if its extremum is no farther than this.
pub(super) const MAX_OFFSET: f32 = 1.0;
/// Fits tried per extremum.
const MAX_FITS: usize = 5;
/// Steps that settle a fitted extremum; each leaves about a seventh of the error.
const SETTLING_STEPS: usize = 2;
/// Settling farther than this, in any coordinate, is not believed.
const MAX_SETTLING: f32 = 0.3;
/// The grid test passes values above this part of the threshold, since the refined extremum is higher.
const GRID_PART: f32 = 0.8;
/// Pixels tested together.
const LANES: usize = 16;

/// A refined extremum.
pub(super) struct Extremum {
    /// Column in pixels of the octave (first pixel at 0).
    pub(super) x: f32,
    /// Row likewise.
    pub(super) y: f32,
    /// Fractional level.
    pub(super) level: f32,
    /// The Gaussian level to describe it at.
    pub(super) s: usize,
    /// Absolute difference of Gaussians there.
    pub(super) contrast: f32,
}

/// A quadratic fitted around a grid point, whose extremum is one of contrast and no edge.
pub(super) struct Fit {
    /// Column, row and level of the grid point.
    grid: (usize, usize, usize),
    inverse_hessian: Matrix3<f32>,
    /// From the grid point to the extremum of the quadratic.
    offset: Vector3<f32>,
    contrast: f32,
}

impl Fit {
    /// The extremum of the quadratic.
    pub(super) fn extremum(&self) -> Extremum {
        self.extremum_at(&self.offset)
    }

    /// The extremum where the gradient of a higher polynomial vanishes (see the head of this file).
    pub(super) fn settled(&self, levels: &Levels) -> Extremum {
        self.extremum_at(&settle(levels, self.grid, &self.inverse_hessian, self.offset))
    }

    fn extremum_at(&self, offset: &Vector3<f32>) -> Extremum {
        let (x, y, s) = self.grid;
        let (fx, fy, level) = (x as f32 + offset.x, y as f32 + offset.y, s as f32 + offset.z);
        Extremum { x: fx, y: fy, level, s, contrast: self.contrast }
    }
}

stamp!(
    /// `out = a - b`.
    subtract => subtract_body(a: &[f32], b: &[f32], out: &mut [f32])
);

#[inline(always)]
fn subtract_body<const FMA: bool>(a: &[f32], b: &[f32], out: &mut [f32]) {
    for (out, (a, b)) in out.iter_mut().zip(a.iter().zip(b)) {
        *out = a - b;
    }
}

/// Adds the columns of row `y` whose value in the middle of three differences is an extremum of its 27 that may have a
/// contrast of `least`.
pub(super) fn scan_row(
    isa: super::simd::Isa,
    differences: &[Ring],
    y: usize,
    width: usize,
    least: f32,
    found: &mut Vec<usize>,
) {
    let row = |s: usize, y: usize| differences[s].row(y);
    // Of equal neighbours exactly one counts as the extremum: the last.
    let strict = [row(0, y - 1), row(0, y), row(0, y + 1), row(1, y - 1)];
    let lax = [row(1, y + 1), row(2, y - 1), row(2, y), row(2, y + 1)];
    scan(isa, row(1, y), &strict, &lax, width, GRID_PART * least, found);
}

stamp!(
    /// See [`scan_row`].
    scan => scan_body(
        center: &[f32], strict: &[&[f32]; 4], lax: &[&[f32]; 4], width: usize, threshold: f32, found: &mut Vec<usize>,
    )
);

#[inline(always)]
fn scan_body<const FMA: bool>(
    center: &[f32],
    strict: &[&[f32]; 4],
    lax: &[&[f32]; 4],
    width: usize,
    threshold: f32,
    found: &mut Vec<usize>,
) {
    let mut x = 1;
    while x + 1 < width {
        // The last lanes may reach past the row; they start earlier then and skip what was tested.
        let start = if x + LANES < center.len() { x } else { (center.len() - LANES - 1).max(1) };
        let skip = x - start;
        if let Some(mask) = extremum_lanes(center, strict, lax, start, threshold) {
            for (lane, &hit) in mask.iter().enumerate().skip(skip) {
                if hit && start + lane + 1 < width {
                    found.push(start + lane);
                }
            }
        }
        x = start + LANES;
    }
}

/// Which of the pixels from `x` on are extrema; none when no lane passes the first test.
#[inline(always)]
fn extremum_lanes(
    center: &[f32],
    strict: &[&[f32]; 4],
    lax: &[&[f32]; 4],
    x: usize,
    threshold: f32,
) -> Option<[bool; LANES]> {
    let value: &[f32; LANES] = center[x..x + LANES].try_into().ok()?;
    let left: &[f32; LANES] = center[x - 1..x - 1 + LANES].try_into().ok()?;
    let right: &[f32; LANES] = center[x + 1..x + 1 + LANES].try_into().ok()?;
    let above: &[f32; LANES] = strict[3][x..x + LANES].try_into().ok()?;
    let below: &[f32; LANES] = lax[0][x..x + LANES].try_into().ok()?;
    let mut alive = [0_i32; LANES];
    for i in 0..LANES {
        let v = value[i];
        let high = (v > threshold) & (v > left[i]) & (v > above[i]) & (v >= right[i]) & (v >= below[i]);
        let low = (v < -threshold) & (v < left[i]) & (v < above[i]) & (v <= right[i]) & (v <= below[i]);
        alive[i] = i32::from(high | low);
    }
    if alive.iter().fold(0, |any, &lane| any | lane) == 0 {
        return None;
    }
    // Many blocks come this far; the same pixel of the levels above and below stops most of them before the costly test.
    let finer: &[f32; LANES] = strict[1][x..x + LANES].try_into().ok()?;
    let coarser: &[f32; LANES] = lax[2][x..x + LANES].try_into().ok()?;
    for i in 0..LANES {
        let v = value[i];
        let high = (v > threshold) & (v > finer[i]) & (v >= coarser[i]);
        let low = (v < -threshold) & (v < finer[i]) & (v <= coarser[i]);
        alive[i] &= i32::from(high | low);
    }
    if alive.iter().fold(0, |any, &lane| any | lane) == 0 {
        return None;
    }
    let (mut before_max, mut before_min) = (*left, *left);
    let (mut after_max, mut after_min) = (*right, *right);
    for row in strict {
        for shift in 0..3 {
            let row: &[f32; LANES] = row[x + shift - 1..x + shift - 1 + LANES].try_into().ok()?;
            for i in 0..LANES {
                before_max[i] = if row[i] > before_max[i] { row[i] } else { before_max[i] };
                before_min[i] = if row[i] < before_min[i] { row[i] } else { before_min[i] };
            }
        }
    }
    for row in lax {
        for shift in 0..3 {
            let row: &[f32; LANES] = row[x + shift - 1..x + shift - 1 + LANES].try_into().ok()?;
            for i in 0..LANES {
                after_max[i] = if row[i] > after_max[i] { row[i] } else { after_max[i] };
                after_min[i] = if row[i] < after_min[i] { row[i] } else { after_min[i] };
            }
        }
    }
    let mut hits = [false; LANES];
    for i in 0..LANES {
        let v = value[i];
        hits[i] = (v > threshold) & (v > before_max[i]) & (v >= after_max[i])
            | (v < -threshold) & (v < before_min[i]) & (v <= after_min[i]);
    }
    Some(hits)
}

/// Fits the grid extremum in column `x`, row `y` of difference `s`; none when the fit wanders off, or to a level before
/// `finest`, the contrast is below `least` or the curvatures are those of an edge.
pub(super) fn fit(
    levels: &Levels,
    (mut x, mut y, mut s): (usize, usize, usize),
    finest: usize,
    least: f32,
    options: &SiftOptions,
) -> Option<Fit> {
    let first_y = y;
    for attempt in 1..=MAX_FITS {
        let cube = neighbourhood::<3>(levels, x, y, s);
        let at = |dx: usize, dy: usize, ds: usize| cube[ds][dy][dx];
        let value = at(1, 1, 1);
        let gradient =
            0.5 * Vector3::new(at(2, 1, 1) - at(0, 1, 1), at(1, 2, 1) - at(1, 0, 1), at(1, 1, 2) - at(1, 1, 0));
        let xx = at(2, 1, 1) + at(0, 1, 1) - 2.0 * value;
        let yy = at(1, 2, 1) + at(1, 0, 1) - 2.0 * value;
        let ss = at(1, 1, 2) + at(1, 1, 0) - 2.0 * value;
        let xy = 0.25 * (at(2, 2, 1) + at(0, 0, 1) - at(0, 2, 1) - at(2, 0, 1));
        let xs = 0.25 * (at(2, 1, 2) + at(0, 1, 0) - at(0, 1, 2) - at(2, 1, 0));
        let ys = 0.25 * (at(1, 2, 2) + at(1, 0, 0) - at(1, 0, 2) - at(1, 2, 0));
        let hessian = Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
        let inverse_hessian = hessian.try_inverse()?;
        let offset = -(inverse_hessian * gradient);
        if !offset.iter().all(|component| component.is_finite()) {
            return None;
        }
        if offset.amax() <= if attempt < MAX_FITS { MOVE_OFFSET } else { MAX_OFFSET } {
            let contrast = (value + 0.5 * gradient.dot(&offset)).abs();
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let edge = options.edge_threshold;
            let keeps = contrast > least && trace * trace * edge < (edge + 1.0).powi(2) * determinant;
            return keeps.then_some(Fit { grid: (x, y, s), inverse_hessian, offset, contrast });
        }
        x = step(x, offset.x, 1, levels.width - 2)?;
        y = step(y, offset.y, 1, levels.height - 2)?;
        s = step(s, offset.z, finest, options.levels_per_octave)?;
        if y.abs_diff(first_y) > MAX_ROW_STEPS {
            return None;
        }
    }
    None
}

/// Moves an extremum, found at `offset` from a grid point, to where the gradient of a higher polynomial vanishes; it stays
/// where it is at the border of the image or where the two disagree by [`MAX_SETTLING`].
fn settle(
    levels: &Levels,
    (x, y, s): (usize, usize, usize),
    inverse_hessian: &Matrix3<f32>,
    offset: Vector3<f32>,
) -> Vector3<f32> {
    if x < 2 || y < 2 || x + 2 >= levels.width || y + 2 >= levels.height {
        return offset;
    }
    let cube = neighbourhood::<5>(levels, x, y, s);
    let mut at = offset;
    for _ in 0..SETTLING_STEPS {
        at -= inverse_hessian * gradient_at(&cube, &at);
    }
    if (at - offset).amax() < MAX_SETTLING { at } else { offset }
}

/// The gradient (x, y, level) at an offset from the middle of a cube of differences.
fn gradient_at(cube: &[[[f32; 5]; 5]; 3], at: &Vector3<f32>) -> Vector3<f32> {
    let (values_x, slopes_x) = weights_of_five(at.x);
    let (values_y, slopes_y) = weights_of_five(at.y);
    let t = at.z;
    let (values_s, slopes_s) = ([0.5 * t * (t - 1.0), 1.0 - t * t, 0.5 * t * (t + 1.0)], [t - 0.5, -2.0 * t, t + 0.5]);
    let mut gradient = Vector3::zeros();
    for (plane, (value_s, slope_s)) in cube.iter().zip(values_s.iter().zip(slopes_s)) {
        let (mut value, mut along_x, mut along_y) = (0.0, 0.0, 0.0);
        for (line, (value_y, slope_y)) in plane.iter().zip(values_y.iter().zip(slopes_y)) {
            let (mut line_value, mut line_slope) = (0.0, 0.0);
            for ((difference, value_x), slope_x) in line.iter().zip(values_x).zip(slopes_x) {
                line_value += value_x * difference;
                line_slope += slope_x * difference;
            }
            value += value_y * line_value;
            along_x += value_y * line_slope;
            along_y += slope_y * line_value;
        }
        gradient += Vector3::new(value_s * along_x, value_s * along_y, slope_s * value);
    }
    gradient
}

/// Value and derivative at `t` of the polynomial of fourth degree through values at -2..2, as weights of these values
/// (Lagrange's formula).
fn weights_of_five(t: f32) -> ([f32; 5], [f32; 5]) {
    let (t2, t3, t4) = (t * t, t * t * t, t * t * t * t);
    let values = [
        (t4 - 2.0 * t3 - t2 + 2.0 * t) / 24.0,
        (-t4 + t3 + 4.0 * t2 - 4.0 * t) / 6.0,
        (t4 - 5.0 * t2 + 4.0) / 4.0,
        (-t4 - t3 + 4.0 * t2 + 4.0 * t) / 6.0,
        (t4 + 2.0 * t3 - t2 - 2.0 * t) / 24.0,
    ];
    let slopes = [
        (4.0 * t3 - 6.0 * t2 - 2.0 * t + 2.0) / 24.0,
        (-4.0 * t3 + 3.0 * t2 + 8.0 * t - 4.0) / 6.0,
        (4.0 * t3 - 10.0 * t) / 4.0,
        (-4.0 * t3 - 3.0 * t2 + 8.0 * t + 4.0) / 6.0,
        (4.0 * t3 + 6.0 * t2 - 2.0 * t - 2.0) / 24.0,
    ];
    (values, slopes)
}

/// One grid step towards an offset beyond [`MOVE_OFFSET`]; none when it leaves `[least, most]`.
fn step(at: usize, offset: f32, least: usize, most: usize) -> Option<usize> {
    let next = if offset > MOVE_OFFSET {
        at + 1
    } else if offset < -MOVE_OFFSET {
        at - 1
    } else {
        at
    };
    (least..=most).contains(&next).then_some(next)
}

/// The differences around a pixel by level, row, column: three levels of `SIDE` by `SIDE` pixels.
fn neighbourhood<const SIDE: usize>(levels: &Levels, x: usize, y: usize, s: usize) -> [[[f32; SIDE]; SIDE]; 3] {
    let half = SIDE / 2;
    let mut cube = [[[0.0; SIDE]; SIDE]; 3];
    for (ds, plane) in cube.iter_mut().enumerate() {
        for (dy, line) in plane.iter_mut().enumerate() {
            let upper = &levels.rings[s + ds].row(y + dy - half)[x - half..=x + half];
            let lower = &levels.rings[s + ds - 1].row(y + dy - half)[x - half..=x + half];
            for (difference, (upper, lower)) in line.iter_mut().zip(upper.iter().zip(lower)) {
                *difference = upper - lower;
            }
        }
    }
    cube
}
