//! Extracts SIFT features of one image and writes them as binary, for `compare_opencv.py`.
//!
//! Usage: sift_extract IMAGE OUT [--max N] [--first-octave N] [--peak X] [--edge X] [--sigma0 X]
//! [--camera-sigma X]. OUT holds a little-endian u32 count, then x, y, scale,
//! orientation as f32 for each keypoint, then 128 bytes each. CPU seconds of the extraction alone go to standard output.

use std::io::Write;

use anyhow::Context;
use multistage::features::{SiftOptions, extract};
use multistage::scene::GrayImage;

fn cpu_s() -> f64 {
    let time = rustix::time::clock_gettime(rustix::time::ClockId::ThreadCPUTime);
    time.tv_sec as f64 + time.tv_nsec as f64 * 1e-9
}

fn main() -> anyhow::Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let [image, out, flags @ ..] = arguments.as_slice() else { anyhow::bail!("usage: sift_extract IMAGE OUT [flags]") };
    let mut options = SiftOptions::default();
    for flag in flags.chunks(2) {
        let [name, value] = flag else { anyhow::bail!("{} needs a value", flag[0]) };
        match name.as_str() {
            "--max" => {
                options.max_features = value.parse()?;
                options.small_image_features = options.max_features;
            }
            "--first-octave" => options.first_octave = value.parse()?,
            "--peak" => {
                options.peak_threshold = value.parse()?;
                options.faint_threshold = options.faint_threshold.min(options.peak_threshold);
            }
            "--edge" => options.edge_threshold = value.parse()?,
            "--sigma0" => options.sigma0 = value.parse()?,
            "--camera-sigma" => options.camera_sigma_px = value.parse()?,
            _ => anyhow::bail!("unknown flag {name}"),
        }
    }
    let gray = image::open(image).with_context(|| format!("reading {image}"))?.into_luma8();
    let gray = GrayImage::new(gray.width() as usize, gray.height() as usize, gray.into_raw());
    let start = cpu_s();
    let features = extract(&gray, &options);
    println!("{:.4} {}", cpu_s() - start, features.len());
    let mut file = std::io::BufWriter::new(std::fs::File::create(out)?);
    file.write_all(&(features.len() as u32).to_le_bytes())?;
    file.write_all(bytemuck::cast_slice(&features.keypoints))?;
    file.write_all(bytemuck::cast_slice(&features.descriptors))?;
    file.flush()?;
    Ok(())
}
