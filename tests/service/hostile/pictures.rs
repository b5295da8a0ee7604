//! Pictures that promise more than any memory holds, or whose structure leads in circles.

use std::time::{Duration, Instant};

use multistage::formats::photograph::{Photograph, PhotographLimits, inspect};
use serde_json::Value;

use crate::service::{Service, file, jpeg, photographs};

/// A JPEG with its size replaced.
fn jpeg_of_size(width: u16, height: u16) -> Vec<u8> {
    let mut bytes = jpeg(16, 16);
    let frame = bytes.windows(2).position(|marker| marker == [0xff, 0xc0]).unwrap();
    bytes[frame + 5..frame + 7].copy_from_slice(&height.to_be_bytes());
    bytes[frame + 7..frame + 9].copy_from_slice(&width.to_be_bytes());
    bytes
}

fn png_of_size(width: u32, height: u32) -> Vec<u8> {
    let mut bytes = Vec::new();
    image::GrayImage::new(16, 16).write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Png).unwrap();
    bytes[16..20].copy_from_slice(&width.to_be_bytes());
    bytes[20..24].copy_from_slice(&height.to_be_bytes());
    let mut crc = u32::MAX;
    for byte in &bytes[12..29] {
        crc ^= u32::from(*byte);
        for _ in 0..8 {
            crc = (crc >> 1) ^ if crc & 1 == 1 { 0xedb8_8320 } else { 0 };
        }
    }
    bytes[29..33].copy_from_slice(&(!crc).to_be_bytes());
    bytes
}

/// A TIFF whose directory names itself as the next one.
fn looping_tiff() -> Vec<u8> {
    let entry = |tag: u16, value: u32| [&tag.to_le_bytes()[..], &[4, 0, 1, 0, 0, 0], &value.to_le_bytes()].concat();
    let entries = [entry(256, 100), entry(257, 100), entry(0x8769, 8)].concat();
    [&b"II\x2a\0\x08\0\0\0"[..], &[3, 0], &entries, &8u32.to_le_bytes()].concat()
}

fn bombs() -> Vec<(&'static str, Vec<u8>)> {
    let truncated = jpeg(800, 600)[..200].to_vec();
    vec![
        ("jpeg of 65,500 x 65,500", jpeg_of_size(65_500, 65_500)),
        ("png of 100,000 x 100,000", png_of_size(100_000, 100_000)),
        ("png of 2^31 - 1 squared", png_of_size(i32::MAX as u32, i32::MAX as u32)),
        ("tiff in a circle", looping_tiff()),
        ("truncated", truncated),
        ("noise", (0..10_000u32).map(|at| (at.wrapping_mul(2_654_435_761) >> 24) as u8).collect()),
        ("nothing", Vec::new()),
    ]
}

/// The most memory this process ever had, in bytes.
fn peak_rss_bytes() -> u64 {
    let status = std::fs::read_to_string("/proc/self/status").unwrap();
    let line = status.lines().find_map(|line| line.strip_prefix("VmHWM:")).unwrap();
    line.trim().trim_end_matches(" kB").parse::<u64>().unwrap() << 10
}

#[test]
fn bombs_are_refused_from_the_header_in_no_time_and_memory() {
    for (what, bytes) in bombs() {
        let before = peak_rss_bytes();
        let start = Instant::now();
        let refused = inspect(&bytes, &PhotographLimits::default()).is_err()
            || Photograph::open(&bytes, &PhotographLimits::default()).and_then(|p| p.decode_rgb(Some(320))).is_err();
        let took = start.elapsed();
        assert!(refused, "{what}");
        assert!(took < Duration::from_millis(50), "{what}: {took:?}");
        // Tests beside this one take memory too, but none that much.
        let grew = peak_rss_bytes() - before;
        assert!(grew < 64 << 20, "{what}: {grew} bytes");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_job_with_bombs_goes_on_without_them() {
    let service = Service::start().await;
    let names: Vec<String> = (0..bombs().len()).map(|n| format!("{n}.jpg")).collect();
    let form = bombs()
        .iter()
        .zip(&names)
        .fold(photographs([]), |form, ((_, bytes), name)| form.part("images", file(name, bytes)));
    let job = service.post_form("/api/v1/jobs", form).await.ok(202);
    let images: Value = service.get(job["links"]["images"].as_str().unwrap()).await.ok(200);
    for image in images["images"].as_array().unwrap() {
        let answer = service.get(image["links"]["thumbnail"].as_str().unwrap()).await;
        answer.assert_problem(422, "thumbnail_unavailable");
    }
    service.get("/healthz").await.ok(200);
}
