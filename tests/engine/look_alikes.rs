//! Photographs of places that exist twice: no point may be seen from photographs of both.

use std::collections::{BTreeMap, BTreeSet};
use std::fs::File;
use std::path::Path;

use multistage::formats::colmap::{read_images_bin, read_points3d_bin};
use multistage::formats::report::Report;

use super::multistage;

/// Two ranges of photographs, by the stems of their names, that see different copies.
struct ApartRanges([(String, String); 2]);

/// The lines `first..last | first..last` of a file.
fn read_ranges(text: &str) -> Vec<ApartRanges> {
    let range = |range: &str| {
        let (first, last) = range.trim().split_once("..").unwrap();
        (first.to_owned(), last.to_owned())
    };
    text.lines()
        .filter(|line| !line.trim().is_empty() && !line.starts_with('#'))
        .map(|line| {
            let (a, b) = line.split_once('|').unwrap();
            ApartRanges([range(a), range(b)])
        })
        .collect()
}

/// Reconstructs a set and checks that all photographs are in one model that folds nothing.
fn check(set: &str) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/datasets").join(set);
    if !folder.is_dir() {
        return println!("skipped: there are no test photographs at ../shared/datasets/{set}");
    }
    let out = tempfile::tempdir().unwrap();
    let (images, out) = (folder.join("images"), out.path());
    let run = multistage(&["reconstruct", images.to_str().unwrap(), "--out", out.to_str().unwrap()]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));

    let report: Report = serde_json::from_slice(&std::fs::read(out.join("report.json")).unwrap()).unwrap();
    assert_eq!(report.models[0].images, report.input.images);
    assert!(!report.look_alikes.is_empty());
    assert!(report.notes.iter().any(|note| note.contains("look")), "{:?}", report.notes);

    let open = |name: &str| File::open(out.join("sparse/0").join(name)).unwrap();
    let stems: BTreeMap<u32, String> = read_images_bin(&mut open("images.bin"))
        .unwrap()
        .into_iter()
        .map(|(id, image)| (id, Path::new(&image.name).file_stem().unwrap().to_str().unwrap().to_owned()))
        .collect();
    let points = read_points3d_bin(&mut open("points3D.bin")).unwrap();
    for ApartRanges([a, b]) in read_ranges(&std::fs::read_to_string(folder.join("gt/apart.txt")).unwrap()) {
        let within = |(first, last): &(String, String)| -> BTreeSet<u32> {
            stems.iter().filter(|(_, stem)| *stem >= first && *stem <= last).map(|(&id, _)| id).collect()
        };
        let (see_a, see_b) = (within(&a), within(&b));
        let folded = points.values().filter(|point| {
            let sees = |images: &BTreeSet<u32>| point.track.iter().any(|(image, _)| images.contains(image));
            sees(&see_a) && sees(&see_b)
        });
        assert_eq!(folded.count(), 0, "{set}: points seen from {a:?} and {b:?}");
    }
}

#[test]
fn three_look_alike_houses_stay_three() {
    check("dup-street");
}

#[test]
fn two_copies_of_a_book_stay_two() {
    check("dup-books");
}
