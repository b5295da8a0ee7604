//! One octave of the scale space, streamed from top to bottom.
//!
//! With L levels per octave it has L + 3 Gaussian levels of sigma `sigma0 2^(s / L)`, s = 0..L+2; extrema are sought among
//! the differences s+1 minus s for s = 1..L. Level s+1 is level s blurred by `sigma0 2^(s/L) sqrt(2^(2/L) - 1)`. A level is
//! a ring of rows; asking for a row of one makes the rows it needs of the levels below. Extrema are sought row by row, and
//! each is oriented and described at once, for which the rings, and the gradient maps that follow them, reach far enough up and
//! down. (To describe later and keep fewer rows of the levels ahead was tried: it gains nothing.)

use super::blur::{BATCH, Kernel, Scratch, blur_rows};
use super::collector::{Class, Collector};
use super::descriptor::{self, Describer};
use super::extrema::{self, Extremum, MAX_ROW_STEPS};
use super::forecast::Forecast;
use super::gradient::Patch;
use super::gradient_map::GradientMap;
use super::options::SiftOptions;
use super::orientation;
use super::ring::Ring;
use super::simd::Isa;
use super::source::Source;
use crate::scene::Keypoint;

/// A whole grey image.
pub(super) struct Plane {
    /// Columns.
    pub(super) width: usize,
    /// Rows.
    pub(super) height: usize,
    /// Row-major values.
    pub(super) data: Vec<f32>,
}

impl Plane {
    /// Row `y`.
    pub(super) fn row(&self, y: usize) -> &[f32] {
        &self.data[y * self.width..(y + 1) * self.width]
    }
}

/// The Gaussian levels of an octave, as far as their rows are still needed.
pub(super) struct Levels {
    /// Columns.
    pub(super) width: usize,
    /// Rows.
    pub(super) height: usize,
    /// One ring a level.
    pub(super) rings: Vec<Ring>,
}

/// An octave at work.
pub(super) struct Octave<'a> {
    isa: Isa,
    options: &'a SiftOptions,
    index: i32,
    source: Source<'a>,
    levels: Levels,
    /// Gradients of the levels in which extrema are sought, the first of level 1.
    gradients: Vec<GradientMap>,
    /// `kernels[s]` makes level s + 1 from level s.
    kernels: Vec<Kernel>,
    scratch: Scratch,
    /// Rows of each level that must exist below the row in which extrema are sought.
    lead: Vec<usize>,
}

impl<'a> Octave<'a> {
    /// Octave `index` from its first level.
    pub(super) fn new(isa: Isa, source: Source<'a>, index: i32, options: &'a SiftOptions) -> Self {
        let per_octave = options.levels_per_octave;
        let (width, height) = source.size();
        let kernels: Vec<Kernel> = (0..per_octave + 2)
            .map(|s| level_sigma(options, s as f32) * (4.0_f32.powf(1.0 / per_octave as f32) - 1.0).sqrt())
            .map(Kernel::gaussian)
            .collect();
        let near = MAX_ROW_STEPS + 2;
        let reach = |s: usize, radius_px: fn(f32) -> f32| {
            if (1..=per_octave).contains(&s) {
                near + radius_px(level_sigma(options, s as f32 + extrema::MAX_OFFSET)).ceil() as usize
            } else {
                near
            }
        };
        let mut lead: Vec<usize> = (0..per_octave + 3).map(|s| reach(s, descriptor::radius_px)).collect();
        for s in (0..kernels.len()).rev() {
            lead[s] = lead[s].max(lead[s + 1] + BATCH - 1 + kernels[s].radius());
        }
        let rings = (0..lead.len())
            .map(|s| {
                let kernel_radius = kernels.get(s).map_or(0, Kernel::radius);
                let back = reach(s, orientation::radius_px).max(kernel_radius);
                Ring::new(width, (lead[s] + BATCH + back + 2).min(height))
            })
            .collect();
        let gradients = (1..=per_octave)
            .map(|s| GradientMap::new(width, (lead[s] + BATCH + reach(s, descriptor::radius_px) + 2).min(height)))
            .collect();
        let radius = kernels.iter().map(Kernel::radius).max().unwrap_or(0).max(source.radius());
        let scratch = Scratch::new(width, radius);
        let levels = Levels { width, height, rings };
        Self { isa, options, index, source, levels, gradients, kernels, scratch, lead }
    }

    /// The largest scale, in original pixels, of a keypoint of octave `index`.
    pub(super) fn max_scale_px(index: i32, options: &SiftOptions) -> f32 {
        level_sigma(options, options.levels_per_octave as f32 + extrema::MAX_OFFSET) * 2.0_f32.powi(index)
    }

    /// Finds and describes the features of the octave, with a forecast only those that it wants, and returns the first level
    /// of the next. Levels that the forecast has passed are only blurred from there on: their extrema, which are the most, are
    /// not even sought.
    pub(super) fn run(mut self, collector: &mut Collector<'_>, mut forecast: Option<&mut Forecast>) -> Plane {
        let (width, height) = (self.levels.width, self.levels.height);
        let per_octave = self.options.levels_per_octave;
        let mut next = Plane { width: width.div_ceil(2), height: height.div_ceil(2), data: Vec::new() };
        let wants_next = self.index >= 0;
        if wants_next {
            next.data.reserve_exact(next.width * next.height);
        }
        let mut differences: Vec<Ring> = (0..per_octave + 2).map(|_| Ring::new(width, 3.min(height))).collect();
        let (mut candidates, mut extrema) = (Vec::new(), Vec::new());
        let mut worker = Worker { describer: Describer::new(), patch: Patch::new() };
        // The first level whose extrema may still be wanted.
        let mut finest = 1;
        for y in 0..height {
            for s in 0..self.levels.rings.len() {
                self.ensure(s, y + self.lead[s]);
            }
            for (map, level) in self.gradients.iter_mut().zip(&self.levels.rings[1..]).skip(finest - 1) {
                map.follow(self.isa, level);
            }
            if wants_next && y.is_multiple_of(2) {
                next.data.extend(self.levels.rings[per_octave].row(y)[..width].iter().step_by(2));
            }
            for (s, ring) in differences.iter_mut().enumerate().skip(finest - 1) {
                extrema::subtract(self.isa, self.levels.rings[s + 1].row(y), self.levels.rings[s].row(y), ring.push());
            }
            // Row y completes the neighbourhood of the row above it.
            if y < 2 {
                continue;
            }
            extrema.clear();
            let takes_faint =
                collector.has_room_for_faint() && forecast.as_ref().is_none_or(|told| told.has_room_for_faint());
            let least = if takes_faint { self.options.faint_threshold } else { self.options.peak_threshold };
            for s in finest..=per_octave {
                candidates.clear();
                extrema::scan_row(self.isa, &differences[s - 1..=s + 1], y - 1, width, least, &mut candidates);
                let (levels, options) = (&self.levels, self.options);
                let fits =
                    candidates.iter().filter_map(|&x| extrema::fit(levels, (x, y - 1, s), finest, least, options));
                let wanted = fits.filter(|fit| {
                    let extremum = fit.extremum();
                    let (scale, (x, y)) = (self.scale_px(&extremum), self.place_px(&extremum));
                    let class = self.class(&extremum);
                    collector.wants_at(x, y)
                        && forecast.as_mut().is_none_or(|forecast| forecast.wants(class, scale))
                        && collector.wants(class, scale)
                });
                // To settle an extremum takes as long as to fit it, and of a picture full of them most are not wanted.
                extrema.extend(wanted.map(|fit| fit.settled(&self.levels)));
            }
            if let Some(forecast) = &mut forecast {
                forecast.finish_row(y, self.step_px());
                while finest <= per_octave && forecast.has_passed(self.max_scale_of_level_px(finest)) {
                    finest += 1;
                }
            }
            for extremum in &extrema {
                self.describe(extremum, &mut worker, collector);
            }
        }
        next
    }

    /// The first level of the next octave, without looking for features.
    pub(super) fn next_seed(mut self) -> Plane {
        let (width, height) = (self.levels.width, self.levels.height);
        let mut next = Plane { width: width.div_ceil(2), height: height.div_ceil(2), data: Vec::new() };
        next.data.reserve_exact(next.width * next.height);
        let s = self.options.levels_per_octave;
        for y in (0..height).step_by(2) {
            self.ensure(s, y);
            next.data.extend(self.levels.rings[s].row(y)[..width].iter().step_by(2));
        }
        next
    }

    /// Makes the rows of level `s` up to row `last` or the last of the image.
    fn ensure(&mut self, s: usize, last: usize) {
        let size = (self.levels.width, self.levels.height);
        let last = last.min(size.1 - 1);
        while self.levels.rings[s].next() <= last {
            let y = self.levels.rings[s].next();
            let count = BATCH.min(size.1 - y);
            if s == 0 {
                let mut outs = self.levels.rings[0].push_rows(count);
                self.source.fill(self.isa, y, &mut self.scratch, &mut outs);
            } else {
                self.ensure(s - 1, y + count - 1 + self.kernels[s - 1].radius());
                let (below, above) = self.levels.rings.split_at_mut(s);
                let (kernel, mut outs) = (&self.kernels[s - 1], above[0].push_rows(count));
                blur_rows(self.isa, kernel, &below[s - 1], size, y, &mut self.scratch, &mut outs);
            }
        }
    }

    /// Original pixels to a pixel of the octave.
    fn step_px(&self) -> f32 {
        2.0_f32.powi(self.index)
    }

    /// The largest scale, in original pixels, of an extremum found on the grid of level `s`, but for the few that the fit
    /// takes to a coarser level.
    fn max_scale_of_level_px(&self, s: usize) -> f32 {
        level_sigma(self.options, s as f32 + extrema::MOVE_OFFSET) * self.step_px()
    }

    /// The scale of an extremum in original pixels.
    fn scale_px(&self, extremum: &Extremum) -> f32 {
        level_sigma(self.options, extremum.level) * self.step_px()
    }

    /// How well an extremum stands out.
    fn class(&self, extremum: &Extremum) -> Class {
        if extremum.contrast > self.options.peak_threshold { Class::Distinct } else { Class::Faint }
    }

    /// The place of an extremum in original pixels (first pixel centre at 0.5, 0.5).
    fn place_px(&self, extremum: &Extremum) -> (f32, f32) {
        let step = self.step_px();
        // Doubled pixels tile the original ones; from octave 0 on, every second pixel is kept, starting with the first.
        let offset = if self.index < 0 { 0.5 * step } else { 0.5 };
        (extremum.x * step + offset, extremum.y * step + offset)
    }

    /// Turns an extremum into features.
    fn describe(&self, extremum: &Extremum, worker: &mut Worker, collector: &mut Collector<'_>) {
        let sigma = level_sigma(self.options, extremum.level);
        let scale = self.scale_px(extremum);
        let class = self.class(extremum);
        if !collector.wants(class, scale) {
            return;
        }
        let (x, y) = self.place_px(extremum);
        let (ring, gradients) = (&self.levels.rings[extremum.s], &self.gradients[extremum.s - 1]);
        let size = (self.levels.width, self.levels.height);
        let (at, patch) = ((extremum.x, extremum.y), &mut worker.patch);
        for orientation in orientation::find(self.isa, ring, size, at, sigma, self.options.max_orientations, patch) {
            let keypoint = Keypoint { x, y, scale, orientation };
            let descriptor = worker.describer.describe(self.isa, gradients, size, at, sigma, orientation);
            collector.push(class, keypoint, descriptor);
        }
    }
}

/// Buffers used for one keypoint after the other.
struct Worker {
    describer: Describer,
    patch: Patch,
}

/// Sigma of a (fractional) level in pixels of its octave.
fn level_sigma(options: &SiftOptions, level: f32) -> f32 {
    options.sigma0 * 2.0_f32.powf(level / options.levels_per_octave as f32)
}
