//! `multistage token` and what the served process makes of it.

use std::path::Path;
use std::process::Command;

use crate::program::Program;

async fn status(program: &Program, token: Option<&str>) -> u16 {
    let request = reqwest::Client::new().get(format!("{}/api/v1/jobs", program.base));
    let request = token.into_iter().fold(request, |request, token| request.bearer_auth(token));
    request.send().await.unwrap().status().as_u16()
}

fn token(data_dir: &Path, arguments: &[&str]) -> (i32, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let output = command.arg("token").args(arguments).arg("--data-dir").arg(data_dir).output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_loopback_a_token_is_required_and_never_logged() {
    let folder = tempfile::tempdir().unwrap();
    let (data, log) = (folder.path().join("data"), folder.path().join("log"));
    let served =
        Program::start_logging_at("debug", &data, &["--bind", "0.0.0.0:0"], std::fs::File::create(&log).unwrap());
    assert_eq!(status(&served, None).await, 401);
    let (code, printed) = token(&data, &["create", "--name", "team", "--scopes", "read"]);
    let secret = printed.trim();
    assert!(code == 0 && secret.len() > 40, "{printed}");
    assert_eq!(token(&data, &["create", "--name", "team"]).0, 2, "the name is taken");
    assert_eq!(token(&data, &["create", "--name", "x", "--scopes", "root"]).0, 2);
    assert_eq!(status(&served, Some(secret)).await, 200);
    let (_, list) = token(&data, &["list"]);
    assert!(list.contains("team\tread") && list.contains("valid") && !list.contains(&secret[4..]), "{list}");
    assert_eq!(token(&data, &["revoke", "team"]).0, 0);
    assert_eq!(token(&data, &["revoke", "team"]).0, 2);
    assert_eq!(status(&served, Some(secret)).await, 401);
    drop(served);
    let log = std::fs::read_to_string(&log).unwrap();
    assert!(log.contains("answered") && !log.contains(&secret[4..]), "the log holds the token");
}

#[tokio::test(flavor = "multi_thread")]
async fn loopback_is_open_unless_asked_and_insecure_opens_the_rest() {
    for (arguments, expected) in
        [(&[][..], 200), (&["--require-token"], 401), (&["--bind", "0.0.0.0:0", "--insecure"], 200)]
    {
        let folder = tempfile::tempdir().unwrap();
        let served = Program::start_with(&folder.path().join("data"), arguments);
        assert_eq!(status(&served, None).await, expected, "{arguments:?}");
    }
}
