//! Twenty files, six of them no good: the model of the rest, and a plain verdict on each of the six.

use std::collections::BTreeMap;

use image::{GrayImage, Luma, Rgb, RgbImage};
use multistage::formats::report::{ImageReport, ImageState, Report};
use multistage::math::Rng;

use super::multistage;
use super::rendered::{NUM_PHOTOGRAPHS, copy, photographs};

/// A picture of something else: blots of several sizes, as rich in features as the photographs.
fn something_else() -> RgbImage {
    let mut rng = Rng::from_parts(&[0x656c_7365]);
    let mut sum = GrayImage::from_pixel(640, 480, Luma([128]));
    for cells in [20, 40, 80, 160] {
        let coarse = GrayImage::from_fn(cells, 3 * cells / 4, |_, _| Luma([rng.below(96) as u8]));
        let layer = image::imageops::resize(&coarse, 640, 480, image::imageops::FilterType::CatmullRom);
        for (sum, layer) in sum.pixels_mut().zip(layer.pixels()) {
            sum.0[0] = sum.0[0].saturating_add(layer.0[0]).saturating_sub(48);
        }
    }
    RgbImage::from_fn(640, 480, |x, y| Rgb([sum.get_pixel(x, y).0[0]; 3]))
}

#[test]
fn six_bad_pictures_of_twenty_are_named_and_the_rest_gives_the_model() {
    let folder = tempfile::tempdir().unwrap();
    let (images, out) = (folder.path().join("images"), folder.path().join("out"));
    std::fs::create_dir(&images).unwrap();
    let good = photographs();
    for index in 0..NUM_PHOTOGRAPHS {
        copy(&good, &images, &format!("temple_{index:03}.jpg"));
    }
    std::fs::write(images.join("notes.jpg"), "Shopping list: film, batteries, a tripod.\n").unwrap();
    let whole = std::fs::read(good.join("temple_005.jpg")).unwrap();
    std::fs::write(images.join("cut.jpg"), &whole[..whole.len() / 2]).unwrap();
    RgbImage::from_pixel(1, 1, Rgb([90, 90, 90])).save(images.join("dot.png")).unwrap();
    RgbImage::new(640, 480).save(images.join("lens_cap.jpg")).unwrap();
    std::fs::write(images.join("zz_copy_of_005.jpg"), &whole).unwrap();
    something_else().save(images.join("else.png")).unwrap();

    let paths = [&images, &out].map(|path| path.to_str().unwrap().to_owned());
    let run = multistage(&["reconstruct", &paths[0], "--out", &paths[1], "--threads", "2"]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let report: Report = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report.input.images, 20);
    let verdicts: BTreeMap<&str, &ImageReport> =
        report.images.iter().map(|image| (image.name.as_str(), image)).collect();
    assert_eq!(verdicts.len(), 20);

    assert_eq!(report.models.len(), 1);
    assert_eq!(report.models[0].images, NUM_PHOTOGRAPHS);
    for index in 0..NUM_PHOTOGRAPHS {
        let verdict = verdicts[format!("temple_{index:03}.jpg").as_str()];
        assert_eq!((verdict.state, verdict.model), (ImageState::Registered, Some(0)), "{verdict:?}");
        assert!(verdict.reason.is_none() && verdict.advice.is_none(), "{verdict:?}");
    }

    // The file, its state and reason, and what a person must be able to read in the advice.
    let expected: [(&str, ImageState, &str, &[&str]); 6] = [
        ("notes.jpg", ImageState::Rejected, "unreadable", &["not that of a picture"]),
        ("cut.jpg", ImageState::Rejected, "truncated", &["copy it again"]),
        ("dot.png", ImageState::Rejected, "too_small", &["1 x 1", "original"]),
        ("lens_cap.jpg", ImageState::Unregistered, "too_few_features", &["black"]),
        ("zz_copy_of_005.jpg", ImageState::Rejected, "duplicate", &["temple_005.jpg"]),
        ("else.png", ImageState::Unregistered, "no_matching_image", &["belongs"]),
    ];
    for (name, state, reason, words) in expected {
        let verdict = verdicts[name];
        assert_eq!((verdict.state, verdict.reason.as_deref()), (state, Some(reason)), "{verdict:?}");
        let advice = verdict.advice.as_deref().unwrap();
        for word in words {
            assert!(advice.contains(word), "{name}: {advice:?} does not say {word:?}");
        }
        assert!(advice.starts_with(|first: char| first.is_uppercase()) && advice.ends_with('.'), "{name}: {advice}");
        assert!(verdict.model.is_none(), "{verdict:?}");
    }
    let page = std::fs::read_to_string(out.join("report.html")).unwrap();
    for (name, ..) in expected {
        assert!(page.contains(name), "{name} is not on the page");
    }
}
