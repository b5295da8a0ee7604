//! The same photographs, options and seed give the same bytes, whatever the number of threads and the order of files.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;

use super::multistage;
use super::rendered::{NUM_PHOTOGRAPHS, copy, photographs};

/// Copies the photographs in an order of its own, so that folders list them differently.
fn copied(into: &Path, order: impl Iterator<Item = usize>) {
    std::fs::create_dir(into).unwrap();
    let from = photographs();
    for index in order {
        copy(&from, into, &format!("temple_{index:03}.jpg"));
    }
}

/// Every output by its path; the reports without their times, memory and number of threads.
fn reconstructed(images: &Path, out: &Path, threads: usize) -> BTreeMap<String, Vec<u8>> {
    let threads = threads.to_string();
    let paths = [images, out].map(|path| path.to_str().unwrap());
    let run = multistage(&["reconstruct", paths[0], "--out", paths[1], "--threads", &threads, "--seed", "7"]);
    assert!(run.status.success(), "{}", String::from_utf8_lossy(&run.stderr));
    let mut files = BTreeMap::new();
    collect(out, out, &mut files);
    let mut report: Value = serde_json::from_slice(&files["report.json"]).unwrap();
    forget(&mut report, &["wall_s", "cpu_s", "peak_rss_bytes", "threads"]);
    files.insert("report.json".to_owned(), report.to_string().into_bytes());
    // The tiles and the table of stages tell times and memory.
    let page = String::from_utf8(files.remove("report.html").unwrap()).unwrap();
    let timeless = page.lines().filter(|line| !line.contains("class=\"tile\"") && !line.contains("class=\"bars\""));
    files.insert("report.html".to_owned(), timeless.collect::<Vec<_>>().join("\n").into_bytes());
    files
}

fn collect(root: &Path, folder: &Path, files: &mut BTreeMap<String, Vec<u8>>) {
    for entry in std::fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            collect(root, &path, files);
        } else {
            let name = path.strip_prefix(root).unwrap().to_str().unwrap().to_owned();
            files.insert(name, std::fs::read(path).unwrap());
        }
    }
}

/// Takes every field of these names out, however deep.
fn forget(value: &mut Value, names: &[&str]) {
    match value {
        Value::Object(fields) => {
            fields.retain(|name, _| !names.contains(&name.as_str()));
            fields.values_mut().for_each(|value| forget(value, names));
        }
        Value::Array(values) => values.iter_mut().for_each(|value| forget(value, names)),
        _ => {}
    }
}

#[test]
fn threads_and_file_order_do_not_change_a_byte() {
    let folder = tempfile::tempdir().unwrap();
    let (forwards, backwards) = (folder.path().join("forwards"), folder.path().join("backwards"));
    copied(&forwards, 0..NUM_PHOTOGRAPHS);
    copied(&backwards, (0..NUM_PHOTOGRAPHS).rev());
    let first = reconstructed(&forwards, &folder.path().join("out-1"), 1);
    assert!(first.len() > 10 && first["sparse/0/points3D.bin"].len() > 10_000, "a whole model");
    for (images, threads) in [(&forwards, 2), (&forwards, 3), (&backwards, 2)] {
        let out = folder.path().join(format!("out-{threads}-{}", images.file_name().unwrap().to_str().unwrap()));
        let again = reconstructed(images, &out, threads);
        assert_eq!(first.keys().collect::<Vec<_>>(), again.keys().collect::<Vec<_>>());
        for (name, bytes) in &first {
            assert!(*bytes == again[name], "{name} differs with {threads} threads from {}", images.display());
        }
    }
}
