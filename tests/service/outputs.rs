//! `/api/v1/jobs/{job_id}/outputs`

use std::io::Read;

use multistage::store::db::job_outputs;
use multistage::store::{DataDir, Db};
use serde_json::{Value, json};

use crate::service::Service;

async fn finished(service: &Service) -> Value {
    let job = service.job("quick").await;
    service.wait_state(&job, "succeeded").await
}

fn points() -> Vec<u8> {
    (0..100_000u32).flat_map(u32::to_le_bytes).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn files_are_listed_and_served_whole() {
    let service = Service::start().await;
    let job = finished(&service).await;
    let list = service.get(job["links"]["outputs"].as_str().unwrap()).await.ok(200);
    let files = list["files"].as_array().unwrap();
    let paths: Vec<_> = files.iter().map(|file| file["path"].as_str().unwrap()).collect();
    assert_eq!(paths, ["ply/0/points.ply", "report.html", "report.json", "sparse/0/images.txt"]);
    assert_eq!(list["total_bytes"], files.iter().map(|file| file["size_bytes"].as_i64().unwrap()).sum::<i64>());
    for listed in files {
        let answer = service.get(listed["links"]["self"].as_str().unwrap()).await;
        assert_eq!(answer.status.as_u16(), 200);
        assert_eq!(answer.header("content-type"), listed["media_type"]);
        assert_eq!(answer.header("etag"), listed["etag"]);
        assert_eq!(answer.header("accept-ranges"), "bytes");
        assert_eq!(json!(answer.body.len()), listed["size_bytes"]);
        assert!(answer.header("content-security-policy").contains("sandbox"));
    }
    let answer = service.get(job["models"][0]["links"]["points"].as_str().unwrap()).await;
    assert_eq!(answer.body, points());
    let outputs = job["links"]["outputs"].as_str().unwrap();
    for path in ["nothing.txt", "..%2freport.json", "%2e%2e/work/intake", "ply", "ply/0/../0/points.ply%00", "%ff"] {
        let answer = service.get(&format!("{outputs}/{path}")).await;
        assert_eq!(answer.status.as_u16(), 404, "{path}: {}", answer.text());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_are_exact() {
    let service = Service::start().await;
    let job = finished(&service).await;
    let link = job["models"][0]["links"]["points"].as_str().unwrap();
    let whole = points();
    let etag = service.get(link).await.header("etag").to_owned();
    let ask = async |headers: &[(&str, &str)]| {
        let request = headers.iter().fold(service.request("GET", link), |r, (name, value)| r.header(*name, *value));
        service.send(request).await
    };
    for (range, from, to) in [
        ("bytes=0-0", 0, 1),
        ("bytes=1000-1999", 1000, 2000),
        ("bytes=399000-", 399_000, 400_000),
        ("bytes=-7", 399_993, 400_000),
    ] {
        let answer = ask(&[("range", range), ("if-range", &etag)]).await;
        assert_eq!(answer.status.as_u16(), 206, "{range}");
        assert_eq!(answer.body, whole[from..to]);
        assert_eq!(answer.header("content-range"), format!("bytes {from}-{}/400000", to - 1));
        assert_eq!(answer.header("content-length"), (to - from).to_string());
    }
    let beyond = ask(&[("range", "bytes=400000-")]).await;
    beyond.assert_problem(416, "range_not_satisfiable");
    assert_eq!(beyond.header("content-range"), "bytes */400000");
    assert_eq!(ask(&[("range", "bytes=0-9"), ("if-range", "\"older\"")]).await.body.len(), 400_000);
    assert_eq!(ask(&[("range", "bytes=0-1,5-6")]).await.status.as_u16(), 200);
    let unchanged = ask(&[("if-none-match", &format!("\"x\", W/{etag}"))]).await;
    assert_eq!((unchanged.status.as_u16(), unchanged.body.len()), (304, 0));
    let head = service.send(service.request("HEAD", link)).await;
    assert_eq!((head.status.as_u16(), head.header("content-length"), head.body.len()), (200, "400000", 0));
    // A client may look at the headers of the whole file, leave, and ask for parts.
    let aborted = service.request("GET", link).send().await.unwrap();
    drop(aborted);
    assert_eq!(ask(&[("range", "bytes=5-5")]).await.body, &whole[5..6]);
}

#[tokio::test(flavor = "multi_thread")]
async fn the_archive_holds_every_file() {
    let service = Service::start().await;
    let job = finished(&service).await;
    let answer = service.get(job["links"]["archive"].as_str().unwrap()).await;
    assert_eq!((answer.status.as_u16(), answer.header("content-type")), (200, "application/zip"));
    assert!(answer.header("content-disposition").starts_with("attachment"));
    let mut zip = zip::ZipArchive::new(std::io::Cursor::new(&answer.body)).unwrap();
    assert_eq!(zip.len(), 4);
    let mut bytes = Vec::new();
    zip.by_name("ply/0/points.ply").unwrap().read_to_end(&mut bytes).unwrap();
    assert_eq!(bytes, points());

    // Any part of it is that part, whatever file it falls into.
    let (link, whole, etag) = (job["links"]["archive"].as_str().unwrap(), &answer.body, answer.header("etag"));
    assert_eq!((answer.header("accept-ranges"), answer.header("content-length")), ("bytes", &*whole.len().to_string()));
    for (from, to) in [(0, 1), (20, 5000), (whole.len() / 2, whole.len()), (whole.len() - 30, whole.len())] {
        let part =
            service.request("GET", link).header("range", format!("bytes={from}-{}", to - 1)).header("if-range", etag);
        let part = service.send(part).await;
        assert_eq!((part.status.as_u16(), part.body.len()), (206, to - from));
        assert!(part.body == whole[from..to], "{from} to {to}");
    }
    let beyond = service.request("GET", link).header("range", format!("bytes={}-", whole.len()));
    service.send(beyond).await.assert_problem(416, "range_not_satisfiable");
    let again = service.send(service.request("GET", link).header("if-none-match", etag)).await;
    assert_eq!(again.status.as_u16(), 304);

    // What an earlier version made has no checksums yet.
    let id = job["id"].as_str().unwrap().parse().unwrap();
    let db = Db::open(&DataDir::database_in(service.data_dir())).await.unwrap();
    let mut outputs = job_outputs::list(db.reader(), id).await.unwrap();
    outputs.iter_mut().for_each(|output| output.crc32 = None);
    let mut tx = db.write().await.unwrap();
    job_outputs::replace(&mut tx, id, &outputs).await.unwrap();
    tx.commit().await.unwrap();
    assert!(service.get(link).await.body == *whole);

    // A file that is gone breaks the archive off instead of shortening it.
    std::fs::remove_file(service.data_dir().join("jobs").join(id.to_string()).join("out/ply/0/points.ply")).unwrap();
    // Maybe so early that not even the head of the answer arrives.
    let broken = async { service.request("GET", link).send().await?.bytes().await };
    assert!(broken.await.is_err());

    let failed = service.job("panic").await;
    service.wait_state(&failed, "failed").await;
    service.get(failed["links"]["archive"].as_str().unwrap()).await.assert_problem(404, "output_not_found");
}
