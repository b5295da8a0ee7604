//! SIFT features: scale space, detection, orientation, description (paper, section 3).
//!
//! The method is Lowe's ("Distinctive image features from scale-invariant keypoints", IJCV 2004) with RootSIFT
//! descriptors (Arandjelovic and Zisserman, "Three things everyone should know to improve object retrieval", CVPR 2012).
//! What is done differently, for speed and memory:
//!
//! - No level of the scale space is ever held whole. An octave is a chain of row-wise blurs, each level a ring of the
//!   rows that later steps still need (`octave`), so memory grows with the width of an image, not its area.
//! - The doubled image of octave -1 comes from one Gaussian interpolation of the original pixels (`source`) instead of a
//!   linear interpolation and a blur; it adds no blur of its own and shifts nothing.
//! - Octave 0 starts from the original image, so the coarse octaves come first and the finest, which costs three times
//!   the others together, only describes what still fits under the cap (`collector`).
//!
//! Everything is single precision and single-threaded; the kernels are stamped out for several instruction sets (`simd`)
//! from one body, whose portable version is the oracle of the others.

mod blur;
mod collector;
mod descriptor;
mod extrema;
mod gradient;
mod octave;
mod options;
mod orientation;
mod ring;
mod simd;
mod source;
#[cfg(test)]
mod tests;

pub use options::SiftOptions;

use crate::scene::{Features, GrayImage};
use collector::Collector;
use octave::Octave;
use simd::Isa;
use source::Source;

/// Smallest side of an octave in its own pixels; below it no extremum has a neighbourhood worth describing.
const MIN_OCTAVE_SIDE: usize = 8;

/// The SIFT features of an image, at most [`SiftOptions::limit`] and those of the largest scales.
///
/// Images too small to hold a keypoint give no features. The result depends on nothing but the input and the machine's
/// instruction set.
pub fn extract(image: &GrayImage, options: &SiftOptions) -> Features {
    extract_where(image, options, &|_, _| true)
}

/// [`extract`], with only those features whose pixel `(x, y)` `keeps` accepts; the others do not count towards the limit.
pub fn extract_where(image: &GrayImage, options: &SiftOptions, keeps: &dyn Fn(f32, f32) -> bool) -> Features {
    extract_with(Isa::detect(), image, options, keeps)
}

fn extract_with(isa: Isa, image: &GrayImage, options: &SiftOptions, keeps: &dyn Fn(f32, f32) -> bool) -> Features {
    let limit = options.limit(image.width, image.height);
    let mut collector = Collector::new(limit, keeps);
    if image.width == 0 || image.height == 0 || limit == 0 {
        return collector.finish();
    }
    let mut octave_index = 0;
    let mut seed = None;
    loop {
        let source = match seed.take() {
            None => Source::original(image, options),
            Some(plane) => Source::seed(plane),
        };
        let (width, height) = source.size();
        if width.min(height) < MIN_OCTAVE_SIDE {
            break;
        }
        seed = Some(Octave::new(isa, source, octave_index, options).run(&mut collector));
        octave_index += 1;
    }
    let doubled = options.first_octave < 0 && 2 * image.width.min(image.height) >= MIN_OCTAVE_SIDE;
    if doubled && collector.wants(Octave::max_scale_px(-1, options)) {
        Octave::new(isa, Source::doubled(image, options), -1, options).run(&mut collector);
    }
    collector.finish()
}
