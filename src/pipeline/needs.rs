//! What a run will take of memory and disk, estimated from the headers of its photographs before it starts.
//!
//! Measured peaks: eleven photographs of 6.3 megapixels 111 MB with two threads, 128 of 1.1 megapixels 262 MB, 300 of 14,000
//! features each 534 MB; the estimate is meant to lie above them, so that a job which is let in does not die of what was
//! foreseeable.

use std::fs::File;
use std::io::{self, Read};
use std::path::Path;

use super::options::ReconstructionOptions;
use crate::formats::photograph;

/// Bytes of a file that hold its header, as a rule; the whole file is read where they do not.
const HEADER_BYTES: u64 = 256 << 10;
/// Memory of the program itself, and of what does not depend on the photographs.
const BASE_BYTES: u64 = 48 << 20;
/// Memory that finding features takes per pixel of the picture one thread works on: the decoded picture and the octaves.
const THREAD_BYTES_PER_PIXEL: u64 = 6;
/// A feature in memory: key point and descriptor, padded.
const FEATURE_BYTES: u64 = 144;
/// Share of all features whose positions and tracks a model holds at once, in bytes per feature.
const MODEL_BYTES_PER_FEATURE: u64 = 112;
/// Features of photographs in memory at most; more are read back from disk.
const FEATURES_IN_MEMORY_BYTES: u64 = super::run::FEATURE_CACHE_BYTES as u64;
/// What a stage keeps on disk per feature besides the feature: models after every stage, matches.
const KEPT_BYTES_PER_FEATURE: u64 = 160;
/// Outputs per feature, in all formats together.
const OUTPUT_BYTES_PER_FEATURE: u64 = 240;
/// Reports with their small pictures, per photograph.
const REPORT_BYTES_PER_IMAGE: u64 = 64 << 10;

/// What a run will take.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Needs {
    /// Photographs whose headers could be read.
    pub images: usize,
    /// On disk: results of stages and outputs.
    pub disk_bytes: u64,
    /// In memory, whatever the number of threads.
    pub shared_memory_bytes: u64,
    /// In memory, for every thread.
    pub thread_memory_bytes: u64,
}

impl Needs {
    /// Memory of a run with so many threads.
    pub fn memory_bytes(&self, threads: usize) -> u64 {
        self.shared_memory_bytes.saturating_add(self.thread_memory_bytes.saturating_mul(threads as u64))
    }

    /// The most threads, up to `wanted`, that fit into so much memory; none when not even one does.
    pub fn threads_within(&self, memory_bytes: u64, wanted: usize) -> Option<usize> {
        (1..=wanted).rev().find(|threads| self.memory_bytes(*threads) <= memory_bytes)
    }
}

/// Estimates a run on photographs, each given by its path. What can't be read takes nothing: intake will refuse it.
///
/// # Errors
/// What the system said.
pub fn estimate(
    images: impl IntoIterator<Item = impl AsRef<Path>>,
    options: &ReconstructionOptions,
) -> io::Result<Needs> {
    let mut sizes = Vec::new();
    for path in images {
        sizes.extend(size_of(path.as_ref(), options)?);
    }
    Ok(of_sizes(&sizes, options))
}

/// Estimates a run on photographs of these widths and heights.
pub fn of_sizes(sizes: &[(u32, u32)], options: &ReconstructionOptions) -> Needs {
    let (mut features, mut largest_pixels) = (0u64, 0u64);
    for &(width, height) in sizes {
        let shrink = f64::from(options.intake.max_long_side_px) / f64::from(width.max(height).max(1));
        let scaled = |side: u32| (f64::from(side) * shrink.min(1.0)).ceil() as usize;
        features += options.features.limit(scaled(width), scaled(height)) as u64;
        largest_pixels = largest_pixels.max((scaled(width) * scaled(height)) as u64);
    }
    let in_memory = (features * FEATURE_BYTES).min(FEATURES_IN_MEMORY_BYTES);
    Needs {
        images: sizes.len(),
        disk_bytes: features * (FEATURE_BYTES + KEPT_BYTES_PER_FEATURE + OUTPUT_BYTES_PER_FEATURE)
            + sizes.len() as u64 * REPORT_BYTES_PER_IMAGE,
        shared_memory_bytes: BASE_BYTES + in_memory + features * MODEL_BYTES_PER_FEATURE,
        thread_memory_bytes: largest_pixels * THREAD_BYTES_PER_PIXEL,
    }
}

/// Width and height of a photograph, none when it has none that could be read.
fn size_of(path: &Path, options: &ReconstructionOptions) -> io::Result<Option<(u32, u32)>> {
    let mut file = File::open(path)?;
    let mut bytes = Vec::new();
    file.by_ref().take(HEADER_BYTES).read_to_end(&mut bytes)?;
    let size =
        |bytes: &[u8]| photograph::inspect(bytes, &options.intake.limits()).ok().map(|info| (info.width, info.height));
    if let Some(size) = size(&bytes) {
        return Ok(Some(size));
    }
    file.read_to_end(&mut bytes)?;
    Ok(size(&bytes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn needs_grow_with_number_size_and_threads() {
        let options = ReconstructionOptions::default();
        let of = |count: usize, side: u32| of_sizes(&vec![(side, side); count], &options);
        let (few, many, large) = (of(10, 1000), of(100, 1000), of(10, 3000));
        assert!(few.disk_bytes < many.disk_bytes && few.disk_bytes < large.disk_bytes);
        assert!(few.memory_bytes(4) > few.memory_bytes(1) && large.thread_memory_bytes > few.thread_memory_bytes);
        assert!(many.thread_memory_bytes == few.thread_memory_bytes);
        assert_eq!(few.threads_within(few.memory_bytes(3), 8), Some(3));
        assert_eq!(few.threads_within(few.memory_bytes(1) - 1, 8), None);
    }
}
