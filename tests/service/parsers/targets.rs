//! Everything that reads bytes of others, one function each, which may refuse but neither panic nor run away. The tests
//! feed them mangled files, the fuzzers in `fuzz/` whatever they think of.

#[path = "requests.rs"]
mod requests;

use std::io::{BufReader, Write};

use multistage::config::IpNetwork;
use multistage::formats::exif::Exif;
use multistage::formats::photograph::{Photograph, PhotographLimits};
use multistage::formats::{bundler, colmap, features, poses};
use multistage::jobs::webhooks::Target;
use multistage::pipeline::ReconstructionOptions;
use multistage::store::{ArchiveLimits, ImagePath, unpack};

/// A reader by its name.
pub type Parser = (&'static str, fn(&[u8]));

/// Every reader.
pub const PARSERS: [Parser; 12] = [
    ("photograph", photograph),
    ("exif", exif),
    ("archive", archive),
    ("feature_file", feature_file),
    ("colmap_binary", colmap_binary),
    ("colmap_text", colmap_text),
    ("bundler", bundler_files),
    ("pose_lists", pose_lists),
    ("options", options),
    ("names", names),
    ("form", requests::form),
    ("tus_headers", requests::tus_headers),
];

fn photograph(bytes: &[u8]) {
    let limits = PhotographLimits { min_side_px: 1, max_megapixels: 1.0 };
    if let Ok(photograph) = Photograph::open(bytes, &limits) {
        let _ = photograph.decode_gray_and_colors(Some(64), Some(32));
    }
}

fn exif(bytes: &[u8]) {
    let exif = Exif::read(bytes);
    let _ = exif.focal_px(4000, 3000);
}

fn archive(bytes: &[u8]) {
    let Ok(folder) = tempfile::tempdir() else { return };
    let file = folder.path().join("upload.zip");
    if std::fs::File::create(&file).and_then(|mut file| file.write_all(bytes)).is_err() {
        return;
    }
    let limits = ArchiveLimits { max_total_bytes: 1 << 20, max_entries: 1000, ..ArchiveLimits::default() };
    let mut unpacked = 0;
    let _ = unpack(&file, &limits, folder.path(), &mut |file| {
        unpacked += file.size_bytes;
        Ok(())
    });
    assert!(unpacked <= limits.max_total_bytes, "{unpacked} bytes came out");
}

fn feature_file(bytes: &[u8]) {
    for limit in [None, Some(3)] {
        if let Ok(features) = features::from_bytes(bytes, limit) {
            let _ = features::check_order(&features);
        }
    }
}

fn colmap_binary(bytes: &[u8]) {
    let _ = colmap::read_cameras_bin(&mut &bytes[..]);
    let _ = colmap::read_images_bin(&mut &bytes[..]);
    let _ = colmap::read_points3d_bin(&mut &bytes[..]);
}

fn colmap_text(bytes: &[u8]) {
    let _ = colmap::read_cameras_txt(&mut BufReader::new(bytes));
    let _ = colmap::read_images_txt(&mut BufReader::new(bytes));
    let _ = colmap::read_points3d_txt(&mut BufReader::new(bytes));
}

fn bundler_files(bytes: &[u8]) {
    let _ = bundler::read_bundle_poses(&mut BufReader::new(bytes));
    let _ = bundler::read_list(&mut BufReader::new(bytes));
}

fn pose_lists(bytes: &[u8]) {
    let _ = poses::read_pose_list(&mut BufReader::new(bytes));
    let _ = poses::read_strecha_camera(&mut BufReader::new(bytes));
    let _ = poses::read_nvm_poses(&mut BufReader::new(bytes));
}

fn options(bytes: &[u8]) {
    if let Ok(json) = serde_json::from_slice(bytes) {
        let _ = ReconstructionOptions::from_json(&json);
    }
}

fn names(bytes: &[u8]) {
    let text = String::from_utf8_lossy(bytes);
    if let Ok(path) = ImagePath::parse(&text) {
        assert!(!path.as_str().starts_with('/') && !path.as_str().split('/').any(|part| part == ".."), "{path}");
    }
    let _ = text.parse::<IpNetwork>();
    let _ = Target::parse(&text, &[]);
}

/// One reader by its name.
#[allow(dead_code, reason = "the fuzzers run one, the tests all")]
pub fn run(name: &str, bytes: &[u8]) {
    let parser = PARSERS.iter().find(|(known, _)| *known == name);
    let (_, parse) = parser.unwrap_or_else(|| panic!("no reader is called {name}"));
    parse(bytes);
}
