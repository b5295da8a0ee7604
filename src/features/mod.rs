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
//! - Descriptors are not made of pixels but of gradients that neighbouring keypoints share (`gradient_map`).
//! - Octave 0 starts from the original image, so the coarse octaves come first and the finest, which costs three times
//!   the others together, only describes what still fits under the cap (`collector`, `forecast`). Its levels that are all
//!   below what fits are not even searched: a twelfth of the time of pictures of 2.5 megapixels.
//!
//! Where the time goes (2.5 megapixels, 26,624 features, one core with AVX2): a third into blurs and differences, of which the
//! blur along rows is limited by loads that straddle cache lines; a fifth into finding extrema and refining them; a seventh
//! into orientations, limited by waiting for pixels and by roots and divisions; a fifth into descriptors, of which half is
//! the arithmetic of sharing samples out and half fetching them, and a twentieth into the gradients they share. With
//! AVX-512 descriptors are a seventh, as sharing out is about a cycle a sample there.
//!
//! Everything is single precision and single-threaded; the kernels are stamped out for several instruction sets (`simd`)
//! from one body, whose portable version is the oracle of the others.

mod blur;
mod collector;
mod descriptor;
mod extrema;
mod forecast;
mod gradient;
mod gradient_map;
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
use collector::{Class, Collector};
use forecast::Forecast;
use octave::Octave;
use simd::Isa;
use source::Source;

/// Smallest side of an octave in its own pixels; below it no extremum has a neighbourhood worth describing.
const MIN_OCTAVE_SIDE: usize = 8;

/// Features a pixel that octave 0 may well have. Where that is more than are kept, octave 0 comes after the coarser ones, which
/// foretell what is worth describing in it; making their first level then costs its first blurs twice.
const OCTAVE_0_DENSITY: f64 = 0.006;

/// An octave is searched again where the features of scales that its forecast let through in every row make up less than this
/// share of the wanted number.
const MIN_FORETOLD_SHARE: f64 = 0.9;

/// The SIFT features of an image: at most [`SiftOptions::limit`] distinct ones, those of the largest scales, and where
/// there are fewer than [`SiftOptions::faint_up_to`], so many with faint ones.
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
    let mut collector = Collector::new(limit, options.faint_up_to.min(limit), keeps);
    if image.width == 0 || image.height == 0 || limit == 0 {
        return collector.finish();
    }
    let octave_0 = || Octave::new(isa, Source::original(image, options), 0, options);
    let crowded = (image.width * image.height) as f64 * OCTAVE_0_DENSITY > limit as f64;
    let has_octave_0 = image.width.min(image.height) >= MIN_OCTAVE_SIDE;
    let mut seed = match (has_octave_0, crowded) {
        (false, _) => None,
        (true, true) => Some(octave_0().next_seed()),
        (true, false) => Some(octave_0().run(&mut collector, None)),
    };
    for octave_index in 1.. {
        let Some(plane) = seed.take().filter(|plane| plane.width.min(plane.height) >= MIN_OCTAVE_SIDE) else { break };
        seed = Some(Octave::new(isa, Source::seed(plane), octave_index, options).run(&mut collector, None));
    }
    if has_octave_0 && crowded {
        run_foretold(octave_0, &mut collector);
    }
    let doubled = options.first_octave < 0 && 2 * image.width.min(image.height) >= MIN_OCTAVE_SIDE;
    if doubled && collector.wants(Class::Distinct, Octave::max_scale_px(-1, options)) {
        let octave = || Octave::new(isa, Source::doubled(image, options), -1, options);
        run_foretold(octave, &mut collector);
    }
    collector.finish()
}

/// Runs an octave with a forecast from the coarser ones, and again without one where far too few were kept for it.
fn run_foretold<'a>(octave: impl Fn() -> Octave<'a>, collector: &mut Collector<'_>) {
    let before = collector.clone();
    let mut forecast = Forecast::new(|class| collector.keypoints(class), collector.limit(), collector.faint_up_to());
    octave().run(collector, Some(&mut forecast));
    let is_wrong = [Class::Distinct, Class::Faint].into_iter().any(|class| {
        let complete_from = forecast.complete_from(class);
        complete_from > 0.0 && collector.share_from(class, complete_from) < MIN_FORETOLD_SHARE
    });
    if is_wrong {
        *collector = before;
        octave().run(collector, None);
    }
}
