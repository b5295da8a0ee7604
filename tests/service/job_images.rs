//! `/api/v1/jobs/{job_id}/images`

use serde_json::{Value, json};

use crate::service::{Service, file, jpeg, photographs};

#[tokio::test(flavor = "multi_thread")]
async fn every_photograph_gets_its_verdict() {
    let service = Service::start().await;
    let form = photographs(["z.jpg", "a/bad.jpg", "lone.jpg", "b.jpg"]).text("options", r#"{"mode": "hang"}"#);
    let job = service.post_form("/api/v1/jobs", form).await.ok(202);
    let images = job["links"]["images"].as_str().unwrap();
    let before = service.get(images).await.ok(200);
    assert_eq!(before["total"], 4);
    assert!(before["images"].as_array().unwrap().iter().all(|image| image["state"] == "pending"));
    service.wait_hanging(&job).await;
    service.post(job["links"]["cancel"].as_str().unwrap()).await.ok(202);
    service.wait_state(&job, "cancelled").await;
    service.post(job["links"]["resume"].as_str().unwrap()).await.ok(202);
    service.wait_state(&job, "succeeded").await;

    let after = service.get(images).await.ok(200);
    let verdicts: Vec<_> =
        after["images"].as_array().unwrap().iter().map(|i| (&i["n"], &i["name"], &i["state"])).collect();
    let expected = [
        (json!(0), json!("a/bad.jpg"), json!("rejected")),
        (json!(1), json!("b.jpg"), json!("registered")),
        (json!(2), json!("lone.jpg"), json!("unregistered")),
        (json!(3), json!("z.jpg"), json!("registered")),
    ];
    assert_eq!(verdicts, expected.each_ref().map(|(n, name, state)| (n, name, state)));
    let lone = &after["images"][2];
    assert_eq!((&lone["reason"], &lone["model"]), (&json!("too_few_matches"), &Value::Null));
    assert!(lone["advice"].as_str().unwrap().ends_with('.'));
    let page = service.get(&format!("{images}?state=registered&limit=1")).await.ok(200);
    assert_eq!((&page["total"], &page["images"][0]["n"], &page["next_cursor"]), (&json!(2), &json!(1), &json!("1")));
    let rest = service.get(&format!("{images}?state=registered&limit=1&cursor=1")).await.ok(200);
    assert_eq!((&rest["images"][0]["n"], &rest["next_cursor"]), (&json!(3), &Value::Null));
    service.get(&format!("{images}?state=lost")).await.assert_problem(400, "invalid_query");
}

#[tokio::test(flavor = "multi_thread")]
async fn thumbnails_are_small_upright_and_cached() {
    let service = Service::start().await;
    let form = photographs([])
        .part("images", file("a.jpg", &jpeg(800, 400)))
        .part("images", file("b.jpg", &turned(&jpeg(800, 400), 6)))
        .part("images", file("c.jpg", b"no picture"));
    let job = service.post_form("/api/v1/jobs", form).await.ok(202);
    let images = service.get(job["links"]["images"].as_str().unwrap()).await.ok(200);
    let link = |n: usize| images["images"][n]["links"]["thumbnail"].as_str().unwrap().to_owned();
    for (n, sides) in [(0, (320, 160)), (1, (160, 320))] {
        let answer = service.get(&link(n)).await;
        assert_eq!((answer.status.as_u16(), answer.header("content-type")), (200, "image/jpeg"));
        let picture = image::load_from_memory(&answer.body).unwrap();
        assert_eq!((picture.width(), picture.height()), sides);
        let etag = answer.header("etag").to_owned();
        let again = service.request("GET", &link(n)).header("if-none-match", etag);
        assert_eq!(service.send(again).await.status.as_u16(), 304);
    }
    service.get(&link(2)).await.assert_problem(422, "thumbnail_unavailable");
    let beyond = link(0).replace("/0/", "/3/");
    service.get(&beyond).await.assert_problem(404, "image_not_found");
    service.get(&beyond.replace("/3/", "/x/")).await.assert_problem(404, "image_not_found");
}

/// The JPEG with an EXIF block that holds nothing but this orientation.
fn turned(jpeg: &[u8], orientation: u8) -> Vec<u8> {
    let tiff =
        [b"II\x2a\0\x08\0\0\0".as_slice(), &[1, 0, 0x12, 0x01, 3, 0, 1, 0, 0, 0, orientation, 0, 0, 0, 0, 0, 0, 0]]
            .concat();
    let length = (2 + 6 + tiff.len()) as u16;
    [&jpeg[..2], &[0xff, 0xe1], &length.to_be_bytes(), b"Exif\0\0", &tiff, &jpeg[2..]].concat()
}
