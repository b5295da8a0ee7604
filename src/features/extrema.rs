//! Extrema of the difference of Gaussians: found on the grid, then refined by fitting a quadratic (Brown and Lowe,
//! "Invariant features from interest point groups", BMVC 2002).
//!
//! Around a grid point D(d) = D + g'd + d'Hd/2 with g, H from central differences; its extremum is d = -H^-1 g, where
//! D is D + g'd/2. While d leaves the cell, the fit moves on to the neighbouring grid point.

use nalgebra::{Matrix3, Vector3};

use super::octave::Levels;
use super::options::SiftOptions;
use super::ring::Ring;
use super::simd::stamp;

/// The fit may move this many rows from the grid extremum.
pub(super) const MAX_ROW_STEPS: usize = 3;
/// The fit moves on from a grid point whose extremum is farther than this in some coordinate; slightly more than half, so
/// that an extremum midway between two seldom makes it swing.
const MOVE_OFFSET: f32 = 0.6;
/// Where it swings all the same, the last fit counts if its extremum is no farther than this.
pub(super) const MAX_OFFSET: f32 = 1.0;
/// Fits tried per extremum.
const MAX_FITS: usize = 5;
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

/// Adds the columns of row `y` whose value in the middle of three differences is an extremum of its 27.
pub(super) fn scan_row(
    isa: super::simd::Isa,
    differences: &[Ring],
    y: usize,
    width: usize,
    options: &SiftOptions,
    found: &mut Vec<usize>,
) {
    let row = |s: usize, y: usize| differences[s].row(y);
    // Of equal neighbours exactly one counts as the extremum: the last.
    let strict = [row(0, y - 1), row(0, y), row(0, y + 1), row(1, y - 1)];
    let lax = [row(1, y + 1), row(2, y - 1), row(2, y), row(2, y + 1)];
    scan(isa, row(1, y), &strict, &lax, width, GRID_PART * options.peak_threshold, found);
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

/// Refines the grid extremum in column `x`, row `y` of difference `s`; none when the fit wanders off, the contrast is
/// below the threshold or the curvatures are those of an edge.
pub(super) fn refine(levels: &Levels, x: usize, y: usize, s: usize, options: &SiftOptions) -> Option<Extremum> {
    let (mut x, mut y, mut s, first_y) = (x, y, s, y);
    for fit in 1..=MAX_FITS {
        let cube = neighbourhood(levels, x, y, s);
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
        let offset = -(hessian.try_inverse()? * gradient);
        if !offset.iter().all(|component| component.is_finite()) {
            return None;
        }
        if offset.amax() <= if fit < MAX_FITS { MOVE_OFFSET } else { MAX_OFFSET } {
            let contrast = value + 0.5 * gradient.dot(&offset);
            let (trace, determinant) = (xx + yy, xx * yy - xy * xy);
            let edge = options.edge_threshold;
            let keeps =
                contrast.abs() > options.peak_threshold && trace * trace * edge < (edge + 1.0).powi(2) * determinant;
            let (fx, fy, level) = (x as f32 + offset.x, y as f32 + offset.y, s as f32 + offset.z);
            return keeps.then_some(Extremum { x: fx, y: fy, level, s });
        }
        x = step(x, offset.x, 1, levels.width - 2)?;
        y = step(y, offset.y, 1, levels.height - 2)?;
        s = step(s, offset.z, 1, options.levels_per_octave)?;
        if y.abs_diff(first_y) > MAX_ROW_STEPS {
            return None;
        }
    }
    None
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

/// The 27 differences around a pixel, by level, row, column.
fn neighbourhood(levels: &Levels, x: usize, y: usize, s: usize) -> [[[f32; 3]; 3]; 3] {
    let mut cube = [[[0.0; 3]; 3]; 3];
    for (ds, plane) in cube.iter_mut().enumerate() {
        for (dy, line) in plane.iter_mut().enumerate() {
            let upper = &levels.rings[s + ds].row(y + dy - 1)[x - 1..x + 2];
            let lower = &levels.rings[s + ds - 1].row(y + dy - 1)[x - 1..x + 2];
            for dx in 0..3 {
                line[dx] = upper[dx] - lower[dx];
            }
        }
    }
    cube
}
