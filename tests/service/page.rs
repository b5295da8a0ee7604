//! The page, health and figures.

use crate::service::Service;

#[tokio::test(flavor = "multi_thread")]
async fn the_page_comes_with_its_files_and_fences() {
    let service = Service::start().await;
    let page = service.get("/").await;
    assert_eq!(page.status.as_u16(), 200);
    assert!(page.text().starts_with("<!doctype html>"));
    assert_eq!(page.header("content-type"), "text/html; charset=utf-8");
    assert!(page.header("content-security-policy").contains("default-src 'self'"));
    let etag = page.header("etag").to_owned();
    let again = service.send(service.request("GET", "/").header("if-none-match", etag)).await;
    assert_eq!(again.status.as_u16(), 304);
    assert_eq!(service.get("/static/css/base.css").await.header("content-type"), "text/css; charset=utf-8");
    assert_eq!(service.get("/static/js/main.js").await.header("content-type"), "text/javascript; charset=utf-8");
    assert_eq!(service.get("/static/js/viewer/panel.js").await.status.as_u16(), 200);
    for path in ["/static/package.json", "/static/vendor.mjs"] {
        service.get(path).await.assert_problem(404, "not_found");
    }
    for path in ["/static/nothing.js", "/static/../Cargo.toml", "/static/%2e%2e/Cargo.toml", "/static//etc/passwd"] {
        service.get(path).await.assert_problem(404, "not_found");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn health_and_figures() {
    let service = Service::start().await;
    assert_eq!(service.get("/healthz").await.ok(200)["status"], "ok");
    assert_eq!(service.get("/readyz").await.ok(200)["status"], "ok");
    let job = service.job("quick").await;
    service.wait_state(&job, "succeeded").await;
    service.get("/nowhere").await.assert_problem(404, "not_found");
    let text = service.get("/metrics").await.text();
    assert!(text.contains("multistage_jobs{state=\"succeeded\"} 1\n"), "{text}");
    assert!(text.contains("multistage_upload_images_total 3\n"), "{text}");
    assert!(text.contains("multistage_http_responses_total{class=\"4xx\"} 1\n"), "{text}");
    assert!(service.get("/openapi.yaml").await.text().contains("openapi: 3.1.0"));
}
