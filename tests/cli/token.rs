//! `multistage token` and what the served process makes of it.

use std::io::{BufRead, BufReader};
use std::process::{Child, Command, Stdio};

struct Served {
    child: Child,
    port: String,
}

impl Served {
    fn start(data_dir: &std::path::Path, arguments: &[&str], log: std::fs::File) -> Self {
        let mut child = Command::new(env!("CARGO_BIN_EXE_multistage"))
            .args(["serve", "--data-dir"])
            .arg(data_dir)
            .args(arguments)
            .env("RUST_LOG", "debug")
            .stdout(Stdio::piped())
            .stderr(log)
            .spawn()
            .unwrap();
        let mut line = String::new();
        BufReader::new(child.stdout.take().unwrap()).read_line(&mut line).unwrap();
        let port = line.trim().trim_end_matches('/').rsplit(':').next().unwrap().to_owned();
        Self { child, port }
    }

    async fn status(&self, token: Option<&str>) -> u16 {
        let request = reqwest::Client::new().get(format!("http://127.0.0.1:{}/api/v1/jobs", self.port));
        let request = token.into_iter().fold(request, |request, token| request.bearer_auth(token));
        request.send().await.unwrap().status().as_u16()
    }
}

impl Drop for Served {
    fn drop(&mut self) {
        // Fails only when it is gone.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn token(data_dir: &std::path::Path, arguments: &[&str]) -> (i32, String) {
    let mut command = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let output = command.arg("token").args(arguments).arg("--data-dir").arg(data_dir).output().unwrap();
    (output.status.code().unwrap(), String::from_utf8(output.stdout).unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn beyond_loopback_a_token_is_required_and_never_logged() {
    let folder = tempfile::tempdir().unwrap();
    let (data, log) = (folder.path().join("data"), folder.path().join("log"));
    let served = Served::start(&data, &["--bind", "0.0.0.0:0"], std::fs::File::create(&log).unwrap());
    assert_eq!(served.status(None).await, 401);
    let (status, printed) = token(&data, &["create", "--name", "team", "--scopes", "read"]);
    let secret = printed.trim();
    assert!(status == 0 && secret.len() > 40, "{printed}");
    assert_eq!(token(&data, &["create", "--name", "team"]).0, 2, "the name is taken");
    assert_eq!(token(&data, &["create", "--name", "x", "--scopes", "root"]).0, 2);
    assert_eq!(served.status(Some(secret)).await, 200);
    let (_, list) = token(&data, &["list"]);
    assert!(list.contains("team\tread") && list.contains("valid") && !list.contains(&secret[4..]), "{list}");
    assert_eq!(token(&data, &["revoke", "team"]).0, 0);
    assert_eq!(token(&data, &["revoke", "team"]).0, 2);
    assert_eq!(served.status(Some(secret)).await, 401);
    drop(served);
    let log = std::fs::read_to_string(&log).unwrap();
    assert!(log.contains("answered") && !log.contains(&secret[4..]), "the log holds the token");
}

#[tokio::test(flavor = "multi_thread")]
async fn loopback_is_open_unless_asked_and_insecure_opens_the_rest() {
    for (arguments, status) in [
        (&["--bind", "127.0.0.1:0"][..], 200),
        (&["--bind", "127.0.0.1:0", "--require-token"], 401),
        (&["--bind", "0.0.0.0:0", "--insecure"], 200),
    ] {
        let folder = tempfile::tempdir().unwrap();
        let log = std::fs::File::create(folder.path().join("log")).unwrap();
        let served = Served::start(&folder.path().join("data"), arguments, log);
        assert_eq!(served.status(None).await, status, "{arguments:?}");
    }
}
