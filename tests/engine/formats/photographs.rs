//! Photographs: every accepted kind decodes to the same picture, and whatever is odd is refused by its reason.

use std::io::Cursor;
use std::path::Path;

use image::{DynamicImage, ImageBuffer, ImageFormat, Rgb};
use multistage::formats::photograph::{Photograph, PhotographError, PhotographLimits, inspect};
use proptest::prelude::*;

const WIDTH: u32 = 120;
const HEIGHT: u32 = 80;

/// A smooth picture, so that lossy formats keep it within a few levels.
fn picture() -> ImageBuffer<Rgb<u8>, Vec<u8>> {
    ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| Rgb([(2 * x) as u8, (3 * y) as u8, (x + y) as u8]))
}

fn encode(image: &DynamicImage, format: ImageFormat) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    image.write_to(&mut bytes, format).unwrap();
    bytes.into_inner()
}

fn open(bytes: &[u8]) -> Result<Photograph<'_>, PhotographError> {
    Photograph::open(bytes, &PhotographLimits::default())
}

fn code_of(bytes: &[u8]) -> &'static str {
    open(bytes).map_or_else(|error| error.code(), |_| "accepted")
}

fn expected_gray(x: usize, y: usize) -> f64 {
    0.299 * (2 * x) as f64 + 0.587 * (3 * y) as f64 + 0.114 * (x + y) as f64
}

fn assert_shows_the_picture(bytes: &[u8], tolerance: f64) {
    let photograph = open(bytes).unwrap();
    assert_eq!((photograph.info().width, photograph.info().height), (WIDTH, HEIGHT));
    let gray = photograph.decode_gray(None).unwrap();
    assert_eq!(gray.to_original, [1.0, 1.0]);
    let rgb = photograph.decode_rgb(None).unwrap().image;
    // Grey and colour from one reading: the same grey to the bit, the same colours but for rounding.
    let (same_gray, colors) = photograph.decode_gray_and_colors(None, None).unwrap();
    assert_eq!(same_gray, gray);
    let at = |x: usize, y: usize| (x as f64 + 0.5, y as f64 + 0.5);
    let close = |a: [u8; 3], b: [u8; 3]| a.iter().zip(&b).all(|(a, b)| a.abs_diff(*b) <= 3);
    for (x, y) in (0..HEIGHT as usize).flat_map(|y| (0..WIDTH as usize).map(move |x| at(x, y))) {
        assert!(close(colors.at(x, y), rgb.at(x, y)), "colour at ({x}, {y})");
    }
    // Of 120 columns a third, as the next whole number would leave fewer than were asked for.
    let small = photograph.decode_gray_and_colors(None, Some(35)).unwrap().1;
    assert_eq!(small.size(), (40, 26));
    assert!(close(small.at(61.5, 41.5), rgb.at(61.5, 41.5)));
    assert!(close(colors.thumbnail(40).at(20.5, 13.5), rgb.at(61.5, 40.5)));
    for y in 0..HEIGHT as usize {
        for x in 0..WIDTH as usize {
            let found = f64::from(gray.image.data[y * WIDTH as usize + x]);
            assert!((found - expected_gray(x, y)).abs() <= tolerance, "grey of ({x}, {y}): {found}");
            let color = rgb.at(x as f64 + 0.5, y as f64 + 0.5);
            assert!((f64::from(color[0]) - 2.0 * x as f64).abs() <= 3.0 * tolerance, "red of ({x}, {y}): {color:?}");
            assert!((f64::from(color[1]) - 3.0 * y as f64).abs() <= 3.0 * tolerance, "green of ({x}, {y}): {color:?}");
        }
    }
}

#[test]
fn every_format_shows_the_same_picture() {
    let eight = DynamicImage::ImageRgb8(picture());
    for format in [ImageFormat::Png, ImageFormat::Tiff, ImageFormat::WebP] {
        assert_shows_the_picture(&encode(&eight, format), 1.0);
        assert_shows_the_picture(&encode(&eight.to_rgba8().into(), format), 1.0);
    }
    for format in [ImageFormat::Png, ImageFormat::Tiff] {
        assert_shows_the_picture(&encode(&eight.to_rgb16().into(), format), 1.0);
        assert_shows_the_picture(&encode(&eight.to_rgba16().into(), format), 1.0);
    }
    let mut jpeg = Vec::new();
    image::codecs::jpeg::JpegEncoder::new_with_quality(&mut jpeg, 95).encode_image(&eight).unwrap();
    assert_shows_the_picture(&jpeg, 6.0);
}

#[test]
fn grey_files_of_8_and_16_bits_keep_their_levels() {
    let gray = ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| image::Luma([(x + y) as u8]));
    let wide = ImageBuffer::from_fn(WIDTH, HEIGHT, |x, y| image::Luma([257 * (x + y) as u16]));
    let files = [
        encode(&DynamicImage::ImageLuma8(gray.clone()), ImageFormat::Png),
        encode(&DynamicImage::ImageLuma16(wide.clone()), ImageFormat::Png),
        encode(&DynamicImage::ImageLuma16(wide), ImageFormat::Tiff),
    ];
    for file in files {
        assert_eq!(&open(&file).unwrap().decode_gray(None).unwrap().image.data, gray.as_raw());
    }
    let jpeg = encode(&DynamicImage::ImageLuma8(gray.clone()), ImageFormat::Jpeg);
    let decoded = open(&jpeg).unwrap().decode_gray(None).unwrap().image.data;
    assert!(decoded.iter().zip(gray.as_raw()).all(|(a, b)| a.abs_diff(*b) <= 4));
}

/// A baseline JPEG of four components, each of one value, marked as Adobe's (inverted) CMYK. Quantisation by 8 makes a DC
/// coefficient of `v - 128`; the Huffman codes are `0` for "no difference" and end of block, and `10` for six-bit differences.
fn cmyk_jpeg(values: [u8; 4], side: u16) -> Vec<u8> {
    let mut file = vec![0xff, 0xd8];
    let mut segment = |marker: u8, content: &[u8]| {
        file.extend([0xff, marker]);
        file.extend((content.len() as u16 + 2).to_be_bytes());
        file.extend(content);
    };
    segment(0xee, b"Adobe\0\x64\0\0\0\0\0");
    segment(0xdb, &[&[0u8][..], &[8; 64]].concat());
    let [high, low] = side.to_be_bytes();
    let components: Vec<u8> = (1..=4).flat_map(|id| [id, 0x11, 0]).collect();
    segment(0xc0, &[&[8, high, low, high, low, 4][..], &components].concat());
    let mut counts = [0; 16];
    counts[0] = 1;
    segment(0xc4, &[&[0x10][..], &counts, &[0]].concat());
    counts[1] = 1;
    segment(0xc4, &[&[0x00][..], &counts, &[0, 6]].concat());
    segment(0xda, &[4, 1, 0, 2, 0, 3, 0, 4, 0, 0, 63, 0]);
    let mut bits = String::new();
    for block in 0..usize::from(side / 8).pow(2) {
        for value in values {
            let difference = i32::from(value) - 128;
            let coded = if difference > 0 { difference } else { difference + 63 };
            bits += &if block == 0 { format!("10{coded:06b}0") } else { "00".to_owned() };
        }
    }
    while !bits.len().is_multiple_of(8) {
        bits.push('1');
    }
    for chunk in bits.as_bytes().chunks(8) {
        let byte = chunk.iter().fold(0, |byte, bit| 2 * byte + (bit - b'0'));
        file.push(byte);
        if byte == 0xff {
            file.push(0);
        }
    }
    file.extend([0xff, 0xd9]);
    file
}

#[test]
fn a_cmyk_jpeg_decodes() {
    let file = cmyk_jpeg([190, 160, 90, 170], 64);
    let photograph = open(&file).unwrap();
    let expected = [190, 160, 90].map(|ink: i32| ink * 170 / 255);
    let color = photograph.decode_rgb(None).unwrap().image.at(30.0, 30.0);
    for (found, expected) in color.iter().zip(expected) {
        assert!((i32::from(*found) - expected).abs() <= 2, "{color:?}, not {expected:?}");
    }
    let gray = photograph.decode_gray(None).unwrap().image.data[0];
    let luma = 0.299 * f64::from(expected[0]) + 0.587 * f64::from(expected[1]) + 0.114 * f64::from(expected[2]);
    assert!((f64::from(gray) - luma).abs() <= 3.0);
}

#[test]
fn shrinking_keeps_shape_and_place() {
    let file = encode(&DynamicImage::ImageRgb8(picture()), ImageFormat::Png);
    let photograph = open(&file).unwrap();
    let small = photograph.decode_gray(Some(60)).unwrap();
    assert_eq!((small.image.width, small.image.height), (60, 40));
    assert_eq!(small.to_original, [2.0, 2.0]);
    for (x, y) in [(10, 10), (30, 20), (50, 30)] {
        // The centre of a small pixel lies on the corner of four original ones.
        let expected = (expected_gray(2 * x, 2 * y) + expected_gray(2 * x + 1, 2 * y + 1)) / 2.0;
        assert!((f64::from(small.image.data[y * 60 + x]) - expected).abs() <= 1.5);
    }
    let odd = photograph.decode_rgb(Some(50)).unwrap();
    assert_eq!((odd.image.width, odd.image.height), (50, 33));
    assert_eq!(odd.to_original, [120.0 / 50.0, 80.0 / 33.0]);
    assert_eq!(photograph.decode_gray(Some(4000)).unwrap().image.width, 120);
}

#[test]
fn what_is_no_photograph_is_refused_by_its_reason() {
    assert_eq!(code_of(b""), "unreadable");
    assert_eq!(code_of(b"Dear diary, this is not a picture.\n"), "unreadable");
    assert_eq!(code_of(&[0; 5000]), "unreadable");
    assert_eq!(code_of(b"GIF89a\x01\x00\x01\x00"), "unsupported_format");
    assert_eq!(code_of(b"\0\0\0\x18ftypheic\0\0\0\0"), "unsupported_format");
    let tiny = DynamicImage::ImageRgb8(ImageBuffer::new(1, 1));
    assert_eq!(code_of(&encode(&tiny, ImageFormat::Png)), "too_small");
    assert_eq!(code_of(&encode(&tiny, ImageFormat::Jpeg)), "too_small");
    let bytes = encode(&DynamicImage::ImageRgb8(picture()), ImageFormat::Png);
    let strict = PhotographLimits { max_megapixels: 0.005, ..PhotographLimits::default() };
    assert_eq!(inspect(&bytes, &strict).unwrap_err().code(), "too_large");
}

#[test]
fn a_header_that_claims_a_giant_is_refused_without_decoding() {
    let mut png = encode(&DynamicImage::ImageRgb8(picture()), ImageFormat::Png);
    png[16..24].copy_from_slice(&[0, 1, 0, 0, 0, 1, 0, 0]);
    assert!(matches!(code_of(&png), "too_large" | "unreadable"));
    let mut jpeg = cmyk_jpeg([190, 160, 90, 170], 64);
    let frame = jpeg.windows(2).position(|pair| pair == [0xff, 0xc0]).unwrap();
    jpeg[frame + 5..frame + 9].fill(0xff);
    assert_eq!(code_of(&jpeg), "too_large");
}

#[test]
fn every_cut_of_a_file_is_refused() {
    let image = DynamicImage::ImageRgb8(picture());
    for format in [ImageFormat::Jpeg, ImageFormat::Png, ImageFormat::WebP, ImageFormat::Tiff] {
        let file = encode(&image, format);
        for part in 1..20 {
            let cut = &file[..file.len() * part / 20];
            match open(cut) {
                Err(error) => assert!(matches!(error.code(), "truncated" | "unreadable"), "{format:?}: {error}"),
                Ok(photograph) => {
                    let error = photograph.decode_gray(None).expect_err("a cut file decodes");
                    assert!(matches!(error.code(), "truncated" | "unreadable"), "{format:?}: {error}");
                }
            }
        }
    }
    let jpeg = encode(&image, ImageFormat::Jpeg);
    assert_eq!(code_of(&jpeg[..jpeg.len() * 2 / 3]), "truncated");
    assert_eq!(code_of(&jpeg[..jpeg.len() - 2]), "truncated");
}

#[test]
fn the_test_photographs_open() {
    let datasets = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets");
    if !datasets.is_dir() {
        println!("skipped: there is no folder of test photographs at ../shared/datasets");
        return;
    }
    let mut opened = 0;
    for set in std::fs::read_dir(&datasets).unwrap() {
        let Ok(images) = std::fs::read_dir(set.unwrap().path().join("images")) else { continue };
        for entry in images {
            let path = entry.unwrap().path();
            let bytes = std::fs::read(&path).unwrap();
            let info = inspect(&bytes, &PhotographLimits::default());
            assert!(info.is_ok(), "{}: {info:?}", path.display());
            opened += 1;
        }
    }
    println!("{opened} photographs opened");
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(60))]

    /// Whatever happens to a file's bytes, opening and decoding it ends with a picture or an error.
    #[test]
    fn mangled_files_never_panic(
        kind in 0usize..5,
        flips in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12),
    ) {
        let image = DynamicImage::ImageRgb8(picture());
        let mut file = match kind {
            0 => encode(&image, ImageFormat::Jpeg),
            1 => encode(&image, ImageFormat::Png),
            2 => encode(&image, ImageFormat::Tiff),
            3 => encode(&image, ImageFormat::WebP),
            _ => cmyk_jpeg([190, 160, 90, 170], 64),
        };
        for (at, value) in flips {
            // Most of the trouble is in the headers.
            let at = if value % 2 == 0 { at.index(file.len().min(700)) } else { at.index(file.len()) };
            file[at] = value;
        }
        let limits = PhotographLimits { max_megapixels: 1.0, ..PhotographLimits::default() };
        if let Ok(photograph) = Photograph::open(&file, &limits) {
            let _ = photograph.decode_gray(Some(50));
            let _ = photograph.decode_rgb(None);
        }
    }
}
