//! Uploads put together from parts.

use super::client::Tus;

async fn part(tus: &Tus, bytes: &[u8]) -> String {
    let length = bytes.len().to_string();
    let upload = tus.create(&[("upload-concat", "partial"), ("upload-length", &length), ("upload-metadata", "")]).await;
    tus.patch(&upload, 0, bytes).await.expect(204);
    upload
}

fn path(address: &str) -> String {
    reqwest::Url::parse(address).unwrap().path().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_are_put_together_in_the_order_of_the_list() {
    let tus = Tus::start().await;
    let (world, hello) = (part(&tus, b" world").await, part(&tus, b"hello").await);
    let list = format!("final;{} {}", path(&hello), path(&world));
    let upload = tus.create(&[("upload-concat", &list)]).await;
    let head = tus.head(&upload).await.expect_one_of(&[200, 204]);
    assert_eq!((head.offset(), head.header("upload-length")), (11, Some("11")));
    if tus.own.is_some() {
        assert_eq!(tus.stored("picture-0.jpg").unwrap(), b"hello world");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn the_list_may_hold_whole_addresses() {
    let tus = Tus::start().await;
    let (one, two) = (part(&tus, b"a").await, part(&tus, b"b").await);
    let upload = tus.create(&[("upload-concat", &format!("final;{one} {two}"))]).await;
    assert_eq!(tus.head(&upload).await.offset(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn head_tells_what_an_upload_is_for() {
    let tus = Tus::start().await;
    let one = part(&tus, b"a").await;
    assert_eq!(tus.head(&one).await.header("upload-concat"), Some("partial"));
    let list = format!("final;{}", path(&one));
    let upload = tus.create(&[("upload-concat", &list)]).await;
    assert_eq!(tus.head(&upload).await.header("upload-concat"), Some(list.as_str()));
    let whole = tus.create(&[("upload-length", "1")]).await;
    assert_eq!(tus.head(&whole).await.header("upload-concat"), None);
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_put_together_takes_no_bytes() {
    let tus = Tus::start().await;
    let one = part(&tus, b"a").await;
    let upload = tus.create(&[("upload-concat", &format!("final;{}", path(&one)))]).await;
    tus.patch(&upload, 1, b"b").await.expect(403);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_part_may_serve_again() {
    let tus = Tus::start().await;
    let one = path(&part(&tus, b"ab").await);
    let upload = tus.create(&[("upload-concat", &format!("final;{one} {one} {one}"))]).await;
    assert_eq!(tus.head(&upload).await.offset(), 6);
    let again = tus.create(&[("upload-concat", &format!("final;{one}"))]).await;
    assert_eq!(tus.head(&again).await.offset(), 2);
}

#[tokio::test(flavor = "multi_thread")]
async fn unfinished_and_missing_parts_are_refused() {
    let tus = Tus::start().await;
    let whole = part(&tus, b"ab").await;
    let open = tus.create(&[("upload-concat", "partial"), ("upload-length", "5"), ("upload-metadata", "")]).await;
    let missing = format!("{}/00000000-0000-7000-8000-000000000000", tus.endpoint);
    for wrong in [&open, &missing] {
        let list = format!("final;{} {}", path(&whole), path(wrong));
        let answer = tus.post(&[("upload-concat", &list)], None).await;
        assert!((400..500).contains(&answer.status), "{answer:?}");
    }
    for wrong in ["final;", "final", "parts;/a", "final;/x/nothing"] {
        tus.post(&[("upload-concat", wrong)], None).await.expect_one_of(&[400, 404]);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_part_can_not_be_put_together() {
    let tus = Tus::start().await;
    let whole = tus.create(&[("upload-length", "1")]).await;
    tus.patch(&whole, 0, b"a").await.expect(204);
    let answer = tus.post(&[("upload-concat", &format!("final;{}", path(&whole)))], None).await;
    assert!((400..500).contains(&answer.status), "{answer:?}");
}

#[tokio::test(flavor = "multi_thread")]
async fn parts_bring_no_metadata_along() {
    let tus = Tus::start().await;
    let named =
        tus.create(&[("upload-concat", "partial"), ("upload-length", "1"), ("upload-metadata", "secret YQ==")]).await;
    tus.patch(&named, 0, b"a").await.expect(204);
    let upload = tus.create(&[("upload-concat", &format!("final;{}", path(&named)))]).await;
    assert!(!tus.head(&upload).await.header("upload-metadata").unwrap_or("").contains("secret"));
}
