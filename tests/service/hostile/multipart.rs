//! Requests whose multipart form is not one.

use std::time::Duration;

use proptest::prelude::*;
use proptest::test_runner::TestRunner;

use crate::service::{Answer, Service};

const HEAD: &str = "content-disposition: form-data; name=\"images\"; filename=\"a.jpg\"";

async fn post(service: &Service, boundary: &str, body: Vec<u8>) -> Answer {
    let request = service.request("POST", "/api/v1/jobs").header("content-type", boundary).body(body);
    service.send(request.timeout(Duration::from_secs(20))).await
}

#[tokio::test(flavor = "multi_thread")]
async fn broken_forms_are_refused() {
    let service = Service::start().await;
    let form = "multipart/form-data; boundary=x";
    let huge_header = format!("--x\r\n{HEAD}\r\nx-long: {}\r\n\r\n1\r\n--x--\r\n", "y".repeat(8 << 20));
    let many_headers = format!("--x\r\n{HEAD}\r\n{}\r\n1\r\n--x--\r\n", "x-a: b\r\n".repeat(5_000));
    for (what, boundary, body) in [
        ("no boundary", "multipart/form-data", "--x\r\n".to_owned()),
        ("an empty boundary", "multipart/form-data; boundary=", "--\r\n".to_owned()),
        ("nothing", form, String::new()),
        ("no end", form, format!("--x\r\n{HEAD}\r\n\r\n1")),
        ("no head", form, "--x\r\n\r\n1\r\n--x--\r\n".to_owned()),
        ("another boundary", form, format!("--y\r\n{HEAD}\r\n\r\n1\r\n--y--\r\n")),
        ("no parts", form, "--x--\r\n".to_owned()),
        (
            "a file without a name",
            form,
            "--x\r\ncontent-disposition: form-data; name=\"images\"\r\n\r\n1\r\n--x--\r\n".to_owned(),
        ),
        (
            "a part nobody knows",
            form,
            "--x\r\ncontent-disposition: form-data; name=\"evil\"\r\n\r\n1\r\n--x--\r\n".to_owned(),
        ),
        ("a very long header", form, huge_header),
        ("very many headers", form, many_headers),
        (
            "options that are no JSON",
            form,
            "--x\r\ncontent-disposition: form-data; name=\"options\"\r\n\r\n{\r\n--x--\r\n".to_owned(),
        ),
        (
            "options in depth",
            form,
            format!(
                "--x\r\ncontent-disposition: form-data; name=\"options\"\r\n\r\n{}\r\n--x--\r\n",
                "[".repeat(100_000)
            ),
        ),
    ] {
        let answer = post(&service, boundary, body.into_bytes()).await;
        let status = answer.status.as_u16();
        assert!((400..500).contains(&status), "{what}: {status} {}", answer.text());
        assert!(answer.json()["code"] != "bad_request", "{what}: {}", answer.text());
    }
    service.get("/healthz").await.ok(200);
}

#[tokio::test(flavor = "multi_thread")]
async fn odd_names_are_kept_or_refused_by_name() {
    let service = Service::start().await;
    for (name, taken) in [
        ("e\u{301}te\u{301}.jpg", true),
        ("\u{e9}t\u{e9}.jpg", true),
        ("\u{202e}gpj.evil.jpg", true),
        ("名前 と 空白.jpg", true),
        ("A.JPG/../../x.jpg", false),
        ("a\\b.jpg", false),
        ("con\u{7f}.jpg", false),
    ] {
        let body = format!(
            "--x\r\ncontent-disposition: form-data; name=\"images\"; filename*=utf-8''{}\r\n\r\n{name}\r\n--x--\r\n",
            percent_encoding::utf8_percent_encode(name, percent_encoding::NON_ALPHANUMERIC)
        );
        let answer = post(&service, "multipart/form-data; boundary=x", body.into_bytes()).await;
        if taken {
            let job = answer.ok(202);
            let images = service.get(job["links"]["images"].as_str().unwrap()).await.ok(200);
            assert_eq!(images["images"][0]["name"], name, "kept as it came");
        } else {
            answer.assert_problem(422, "invalid_file_name");
            assert_eq!(answer.json()["path"], name);
        }
    }
}

#[test]
fn mangled_forms_never_break_the_service() {
    let runtime = tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().unwrap();
    let service = runtime.block_on(Service::start());
    let good = format!(
        "--x\r\n{HEAD}\r\ncontent-type: image/jpeg\r\n\r\n12345\r\n--x\r\ncontent-disposition: form-data; name=\"options\"\r\n\r\n\
         {{\"mode\": \"quick\"}}\r\n--x\r\ncontent-disposition: form-data; name=\"name\"\r\n\r\nTemple\r\n--x--\r\n"
    )
    .into_bytes();
    let change = (any::<prop::sample::Index>(), any::<u8>(), 0..3u8);
    let mut runner = TestRunner::new(ProptestConfig::with_cases(250));
    runner
        .run(&prop::collection::vec(change, 1..10), |changes| {
            let mut body = good.clone();
            for (at, value, kind) in changes {
                let at = at.index(body.len());
                match kind {
                    0 => body[at] = value,
                    1 => body.insert(at, value),
                    _ => {
                        body.remove(at);
                    }
                }
            }
            let answer = runtime.block_on(post(&service, "multipart/form-data; boundary=x", body.clone()));
            prop_assert!(!answer.status.is_server_error(), "{} {}", answer.text(), String::from_utf8_lossy(&body));
            Ok(())
        })
        .unwrap();
}
