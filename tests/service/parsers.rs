//! Feeds everything that reads bytes of others with mangled files: bytes changed, cut, doubled and put together from two.
//!
//! `MULTISTAGE_CORPUS=FOLDER cargo test --locked --test service parsers::corpus` feeds every file of a folder to every
//! reader, such as what a fuzzer found (see `fuzz/README.md`); with `MULTISTAGE_SEEDS=FOLDER` the whole files are
//! written there, for a fuzzer to begin with.

mod targets;

use std::io::{Cursor, Write};

use image::{DynamicImage, ImageFormat, RgbImage};
use multistage::features::{SiftOptions, extract};
use multistage::formats::photograph::{Photograph, PhotographLimits};
use multistage::formats::{bundler, colmap, features};
use multistage::synthetic::{SceneOptions, generate};
use proptest::prelude::*;
use proptest::sample::Index;
use targets::PARSERS;

/// Whole files of every kind.
fn seeds() -> Vec<Vec<u8>> {
    let picture = RgbImage::from_fn(80, 60, |x, y| image::Rgb([(x * 3) as u8, (y * 4) as u8, ((x * y) % 255) as u8]));
    let picture = DynamicImage::ImageRgb8(picture);
    let encode = |format| {
        let mut bytes = Cursor::new(Vec::new());
        picture.write_to(&mut bytes, format).unwrap();
        bytes.into_inner()
    };
    let formats = [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP];
    let mut seeds: Vec<Vec<u8>> = formats.into_iter().map(encode).collect();
    let limits = PhotographLimits { min_side_px: 1, max_megapixels: 1.0 };
    let gray = Photograph::open(&seeds[0], &limits).unwrap().decode_gray(None).unwrap();
    seeds.push(features::to_bytes(&extract(&gray.image, &SiftOptions::default())));
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    for name in ["a/b.jpg", "notes.txt"] {
        zip.start_file(name, zip::write::SimpleFileOptions::default()).unwrap();
        zip.write_all(&seeds[0]).unwrap();
    }
    seeds.push(zip.finish().unwrap().into_inner());
    let model = generate(&SceneOptions { num_images: 3, num_points: 12, ..SceneOptions::default() }).truth;
    let mut write = |writer: &dyn Fn(&mut Vec<u8>)| {
        let mut bytes = Vec::new();
        writer(&mut bytes);
        seeds.push(bytes);
    };
    write(&|out| colmap::write_cameras_bin(&model, out).unwrap());
    write(&|out| colmap::write_points3d_bin(&model, out).unwrap());
    write(&|out| bundler::write_bundle(&model, out).unwrap());
    write(&|out| out.extend(br#"{"intake": {"max_long_side_px": 1000}, "iterations": 1}"#));
    write(&|out| out.extend(b"https://user@[::ffff:7f00:1]:8080/a/../b?c#d"));
    write(&|out| {
        out.extend(
            b"--X\r\nContent-Disposition: form-data; name=\"images\"; filename=\"a/\xc3\xbc.jpg\"\r\n\r\nbytes\r\n",
        );
        out.extend(
            b"--X\r\nContent-Disposition: form-data; name=\"archive\"; filename*=UTF-8''b%2ezip\r\n\r\nPK\r\n--X--\r\n",
        );
    });
    // The dataset `00000000-0000-0000-0000-000000000001`, the path `a.jpg`, and the SHA-1 of `hello`.
    let metadata = "dataset MDAwMDAwMDAtMDAwMC0wMDAwLTAwMDAtMDAwMDAwMDAwMDAx,path YS5qcGc=";
    let checksum = "sha1 qvTGHdzF6KLavt4PO0gs2a6pQ00=";
    write(&|out| out.extend(format!("5\n{metadata}\n\n\n{checksum}\n0\nhello").bytes()));
    write(&|out| out.extend(b"3\n\npartial\n1\n\n0\nabc"));
    seeds
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(300))]

    /// Every reader gets every kind of file, not only its own.
    #[test]
    fn mangled_files_are_read_or_refused(
        first in any::<Index>(),
        second in any::<Index>(),
        joint in any::<Index>(),
        joined in any::<bool>(),
        flips in prop::collection::vec((any::<Index>(), any::<u8>()), 0..10),
        doubled in prop::option::of((any::<Index>(), 1usize..64)),
        keep in prop::option::of(any::<Index>()),
    ) {
        let seeds = SEEDS.with(Clone::clone);
        let mut bytes = first.get(&seeds).clone();
        if joined {
            let other = second.get(&seeds);
            bytes.truncate(joint.index(bytes.len() + 1));
            bytes.extend(&other[joint.index(other.len() + 1)..]);
        }
        if let Some((at, length)) = doubled {
            let at = at.index(bytes.len() + 1);
            let run = bytes[at..(at + length).min(bytes.len())].to_vec();
            bytes.splice(at..at, run);
        }
        for (at, value) in flips {
            if !bytes.is_empty() {
                let at = at.index(bytes.len());
                bytes[at] = value;
            }
        }
        if let Some(keep) = keep {
            bytes.truncate(keep.index(bytes.len() + 1));
        }
        for (_, parse) in PARSERS {
            parse(&bytes);
        }
    }
}

thread_local! {
    static SEEDS: std::rc::Rc<Vec<Vec<u8>>> = std::rc::Rc::new(seeds());
}

#[test]
fn every_seed_is_read_by_somebody_and_nobody_fails_on_others() {
    let folder = std::env::var("MULTISTAGE_SEEDS");
    for (n, seed) in seeds().into_iter().enumerate() {
        assert!(!seed.is_empty());
        if let Ok(folder) = &folder {
            std::fs::write(format!("{folder}/{n}"), &seed).unwrap();
        }
        for (_, parse) in PARSERS {
            parse(&seed);
        }
    }
}

/// Without the variable there is nothing to feed.
#[test]
fn corpus() {
    let Ok(folder) = std::env::var("MULTISTAGE_CORPUS") else { return };
    let mut fed = 0;
    for entry in std::fs::read_dir(folder).unwrap() {
        let bytes = std::fs::read(entry.unwrap().path()).unwrap();
        for (name, parse) in PARSERS {
            let outcome = std::panic::catch_unwind(|| parse(&bytes));
            assert!(outcome.is_ok(), "{name} failed");
        }
        fed += 1;
    }
    println!("{fed} files");
}
