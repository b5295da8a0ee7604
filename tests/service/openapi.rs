//! Holds the router to `openapi.yaml`, in both directions. (The tests of the service hold every single answer to it.)

use std::collections::BTreeSet;

use multistage::http::Code;

use crate::service::Service;
use crate::service::contract::Contract;

/// Every route in the source: path and methods, as `get /path`.
fn routes_in_source() -> BTreeSet<String> {
    let folder = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("src/http/routes");
    let mut found = BTreeSet::new();
    for entry in std::fs::read_dir(folder).expect("the routes") {
        let source = std::fs::read_to_string(entry.expect("a file").path()).expect("source");
        for call in source.split(".route(").skip(1) {
            let call = call.trim_start().strip_prefix('"').expect("a path in quotes");
            let (path, rest) = call.split_once('"').expect("a path");
            let handlers = rest.split("\n}").next().unwrap_or(rest);
            for method in ["get", "post", "put", "patch", "delete", "head", "options"] {
                if handlers.contains(&format!("{method}(")) {
                    found.insert(format!("{method} {}", path.replace("{*path}", "{path}")));
                }
            }
        }
    }
    found
}

#[test]
fn every_route_is_documented_and_every_documented_route_is_there() {
    let documented: BTreeSet<String> =
        Contract::load().operations().iter().map(|op| format!("{} {}", op.method, op.path)).collect();
    let routes = routes_in_source();
    assert!(routes.len() > 20, "the routes were not found: {routes:?}");
    assert_eq!(routes, documented);
}

#[test]
fn every_code_is_documented_and_every_documented_code_is_there() {
    let contract = Contract::load();
    let documented: Vec<_> = contract.document()["components"]["schemas"]["ProblemCode"]["enum"]
        .as_array()
        .expect("codes")
        .iter()
        .map(|code| code.as_str().expect("a code").to_owned())
        .collect();
    let codes: Vec<_> = Code::ALL.iter().map(|code| code.as_str().to_owned()).collect();
    assert_eq!(codes, documented);
}

#[test]
fn every_example_is_as_its_schema_says() {
    assert!(Contract::load().check_examples() >= 9);
}

#[test]
fn operation_names_are_unique_and_path_parameters_declared() {
    let contract = Contract::load();
    let mut names = BTreeSet::new();
    for (path, item) in contract.document()["paths"].as_object().expect("paths") {
        for (method, operation) in item.as_object().expect("an item") {
            if method != "parameters" {
                assert!(names.insert(operation["operationId"].as_str().expect("a name").to_owned()), "{path} {method}");
                let declared = format!("{}{}", item["parameters"], operation["parameters"]);
                for name in path.split('{').skip(1).filter_map(|part| part.split('}').next()) {
                    let reference = match name {
                        "job_id" => "JobId",
                        "dataset_id" => "DatasetId",
                        "upload_id" => "UploadId",
                        "webhook_id" => "WebhookId",
                        other => other,
                    };
                    assert!(declared.contains(reference), "{method} {path}: {name} is not declared");
                }
            }
        }
    }
}

/// What the source says is also what the running router does: no documented operation is unknown to it.
#[tokio::test(flavor = "multi_thread")]
async fn the_running_router_knows_every_documented_operation() {
    let service = Service::start().await;
    let nothing = "00000000-0000-7000-8000-000000000000";
    for operation in service.contract.operations() {
        let path = operation
            .path
            .replace("{job_id}", nothing)
            .replace("{dataset_id}", nothing)
            .replace("{upload_id}", nothing)
            .replace("{webhook_id}", nothing)
            .replace("{n}", "0")
            .replace("{path}", "css/base.css");
        let answer = service.send(service.request(&operation.method.to_uppercase(), &path)).await;
        if operation.method == "head" {
            assert!(
                ![404, 405].contains(&answer.status.as_u16()),
                "{path}: an answer without a body has its status only"
            );
        } else if answer.status.is_client_error() {
            let code = answer.json()["code"].as_str().expect("a code").to_owned();
            assert!(
                !["not_found", "method_not_allowed"].contains(&code.as_str()),
                "{} {path}: {code}",
                operation.method
            );
        }
    }
    // And what is not documented is not there.
    service.get("/api/v1").await.assert_problem(404, "not_found");
    service.get("/api/v1/jobs/").await.assert_problem(404, "not_found");
    service.send(service.request("PUT", "/api/v1/jobs")).await.assert_problem(405, "method_not_allowed");
    service.post("/healthz").await.assert_problem(405, "method_not_allowed");
    let answer = service.send(service.request("PATCH", "/api/v1/datasets")).await;
    answer.assert_problem(405, "method_not_allowed");
    assert!(answer.header("allow").contains("POST"));
}
