//! Archives that bomb, lie or climb.

use std::io::{Cursor, Write};
use std::time::{Duration, Instant};

use multistage::store::{ArchiveLimits, unpack};
use proptest::prelude::*;
use reqwest::multipart::Form;
use zip::write::{SimpleFileOptions, ZipWriter};

use crate::service::{Service, file, files_below};

fn stored(entries: &[(&str, &[u8])]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    let options = SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    for (name, bytes) in entries {
        zip.start_file(*name, options).unwrap();
        zip.write_all(bytes).unwrap();
    }
    zip.finish().unwrap().into_inner()
}

fn deflated(name: &str, bytes: &[u8]) -> Vec<u8> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    zip.start_file(name, SimpleFileOptions::default()).unwrap();
    zip.write_all(bytes).unwrap();
    zip.finish().unwrap().into_inner()
}

/// Replaces every occurrence; both have the same length.
fn replaced(mut bytes: Vec<u8>, from: &[u8], to: &[u8]) -> Vec<u8> {
    assert_eq!(from.len(), to.len());
    for at in 0..bytes.len().saturating_sub(from.len() - 1) {
        if bytes[at..].starts_with(from) {
            bytes[at..at + to.len()].copy_from_slice(to);
        }
    }
    bytes
}

/// Sets bytes of every central directory entry (from its signature on).
fn in_directory(mut bytes: Vec<u8>, offset: usize, value: &[u8]) -> Vec<u8> {
    for at in 0..bytes.len() - 4 {
        if bytes[at..].starts_with(b"PK\x01\x02") {
            bytes[at + offset..at + offset + value.len()].copy_from_slice(value);
        }
    }
    bytes
}

/// Entries that all share the data of one: a few kilobytes that unpack to very much.
fn overlapping(entries: usize) -> Vec<u8> {
    let one = deflated("0000.jpg", &vec![0; 3 << 20]);
    let directory = one.windows(4).position(|word| word == b"PK\x01\x02").unwrap();
    let end = one.windows(4).position(|word| word == b"PK\x05\x06").unwrap();
    let mut bytes = one[..directory].to_vec();
    for number in 0..entries {
        bytes.extend(replaced(one[directory..end].to_vec(), b"0000.jpg", format!("{number:04}.jpg").as_bytes()));
    }
    let mut tail = one[end..].to_vec();
    tail[8..10].copy_from_slice(&(entries as u16).to_le_bytes());
    tail[10..12].copy_from_slice(&(entries as u16).to_le_bytes());
    tail[12..16].copy_from_slice(&((bytes.len() - directory) as u32).to_le_bytes());
    bytes.extend(tail);
    bytes
}

#[tokio::test(flavor = "multi_thread")]
async fn every_hostile_archive_is_refused_within_two_seconds() {
    let service = Service::start().await;
    let good = stored(&[("good.jpg", b"1"), ("zzzz.jpg", b"2")]);
    let long = format!("{}.jpg", "x".repeat(300));
    let many: Vec<String> = (0..5000).map(|n| format!("{n}.jpg")).collect();
    let many: Vec<(&str, &[u8])> = many.iter().map(|name| (name.as_str(), &b""[..])).collect();
    let mut link = ZipWriter::new(Cursor::new(Vec::new()));
    link.add_symlink("a.jpg", "/etc/passwd", SimpleFileOptions::default()).unwrap();
    let half = good[..good.len() / 2].to_vec();
    let hostile: Vec<(&str, Vec<u8>)> = vec![
        ("climbs", stored(&[("good.jpg", b"1"), ("../../evil.jpg", b"2")])),
        ("absolute", stored(&[("/tmp/evil.jpg", b"2")])),
        ("drive letter", stored(&[("C:/evil.jpg", b"2")])),
        ("backslash", stored(&[("..\\evil.jpg", b"2")])),
        ("NUL", replaced(good.clone(), b"zzzz.jpg", b"zz\0z.jpg")),
        ("line break", replaced(good.clone(), b"zzzz.jpg", b"zz\nz.jpg")),
        ("a name of 300 bytes", stored(&[(&long, b"2")])),
        ("a link", link.finish().unwrap().into_inner()),
        ("twice the same name with other bytes", replaced(good.clone(), b"zzzz.jpg", b"good.jpg")),
        ("encrypted", in_directory(good.clone(), 8, &[1, 0])),
        ("a method nobody knows", in_directory(good.clone(), 10, &[77, 0])),
        ("a length that lies upwards", in_directory(good.clone(), 24, &[0xff, 0xff, 0xff, 0x7f])),
        ("data that begins nowhere", in_directory(good.clone(), 42, &[0xff, 0xff, 0xff, 0x7f])),
        ("a bomb", deflated("bomb.jpg", &vec![0; 80 << 20])),
        ("overlapping entries", overlapping(1500)),
        ("too many entries", stored(&many)),
        ("an archive in the archive and nothing else", stored(&[("inner.zip", &good)])),
        ("half an archive", half),
        ("no archive", vec![7; 5000]),
        ("nothing", Vec::new()),
    ];
    for (what, bytes) in hostile {
        let start = Instant::now();
        let form = Form::new().part("archive", file("x.zip", &bytes));
        let answer = service.post_form("/api/v1/jobs", form).await;
        let took = start.elapsed();
        let status = answer.status.as_u16();
        assert!((400..500).contains(&status), "{what}: {status} {}", answer.text());
        assert!(answer.json()["detail"].as_str().is_some_and(|detail| detail.len() > 5), "{what}: {}", answer.text());
        assert!(took < Duration::from_secs(2), "{what}: {took:?}");
    }
    assert_eq!(service.get("/api/v1/jobs").await.ok(200)["jobs"], serde_json::json!([]));
    tokio::time::sleep(Duration::from_millis(300)).await;
    let left: Vec<_> = files_below(service.data_dir()).into_iter().filter(|path| path.ends_with(".jpg")).collect();
    assert_eq!(left, [""; 0], "nothing of them is left");
    assert!(!std::path::Path::new("/tmp/evil.jpg").exists());
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(200))]

    /// Whatever bytes an archive has: unpacking ends with photographs below the folder or with a reason.
    #[test]
    fn mangled_archives_do_no_harm(changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 1..12), cut in any::<prop::sample::Index>(), cuts in any::<bool>()) {
        let mut bytes = deflated("a/b.jpg", &[5; 3000]);
        for (at, value) in changes {
            let at = at.index(bytes.len());
            bytes[at] = value;
        }
        if cuts {
            bytes.truncate(cut.index(bytes.len()));
        }
        let folder = tempfile::tempdir().unwrap();
        let scratch = folder.path().join("scratch");
        std::fs::create_dir(&scratch).unwrap();
        let archive = folder.path().join("x.zip");
        std::fs::write(&archive, bytes).unwrap();
        let limits = ArchiveLimits { max_file_bytes: 1 << 20, max_total_bytes: 1 << 20, ..ArchiveLimits::default() };
        let _ = unpack(&archive, &limits, &scratch, &mut |staged| {
            assert!(staged.staged_at().starts_with(&scratch) && staged.size_bytes <= 1 << 20);
            Ok(())
        });
        prop_assert_eq!(std::fs::read_dir(folder.path()).unwrap().count(), 2);
    }
}
