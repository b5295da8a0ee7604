//! Tokens are given away neither by the log nor by the time of an answer, which tells nothing about how near a guess
//! was: guesses whose hash agrees with the stored one in all but its last byte are timed against guesses that agree in
//! nothing, by Welch's t-test.
//!
//! `MULTISTAGE_TIMINGS=100000 cargo test --locked --test measured tokens -- --nocapture` makes 100,000 trials.

use std::hint::black_box;
use std::path::Path;
use std::process::Command;
use std::time::Instant;

use multistage::store::db::tokens::{self, TokenRow};
use multistage::store::{Db, find_token};

use crate::program::Program;

/// Trials of an ordinary run.
const TRIALS: usize = 10_000;
/// Two classes of times are told apart beyond this.
const T_LIMIT: f64 = 4.5;
/// Comparisons of one trial, where a single one is too short to be timed.
const REPEATS: usize = 64;
/// Of a hundred times the longest so many are left out, as those of trials that something else interrupted.
const LEFT_OUT_PERCENT: usize = 5;

/// Times of trials with each of two guesses, the far one first; which one a trial gets is drawn.
async fn times<G: Copy>(trials: usize, guesses: [G; 2], mut trial: impl AsyncFnMut(G)) -> [Vec<f64>; 2] {
    let mut times = [Vec::new(), Vec::new()];
    let mut state = 5u64;
    for _ in 0..trials {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        let near = state >> 63 == 1;
        // Taken before the clock starts: which of the two it is must not be decided, nor fetched, while it runs.
        let guess = black_box(guesses[usize::from(near)]);
        let start = Instant::now();
        trial(guess).await;
        times[usize::from(near)].push(start.elapsed().as_nanos() as f64);
    }
    times
}

fn welch_t(mut times: [Vec<f64>; 2]) -> f64 {
    let mut all: Vec<f64> = times.concat();
    all.sort_unstable_by(f64::total_cmp);
    let longest = all[all.len() * (100 - LEFT_OUT_PERCENT) / 100];
    let moments = times.each_mut().map(|times| {
        times.retain(|time| *time <= longest);
        let count = times.len() as f64;
        let mean = times.iter().sum::<f64>() / count;
        (mean, times.iter().map(|time| (time - mean).powi(2)).sum::<f64>() / (count - 1.0) / count)
    });
    (moments[1].0 - moments[0].0) / (moments[0].1 + moments[1].1).sqrt()
}

#[tokio::test]
async fn the_time_does_not_tell_how_near_a_guess_was() {
    let _alone = crate::alone().await;
    let trials = std::env::var("MULTISTAGE_TIMINGS").ok().and_then(|n| n.parse().ok()).unwrap_or(TRIALS);
    let folder = tempfile::tempdir().unwrap();
    let db = Db::open(&folder.path().join("x.db")).await.unwrap();
    let (near, far) = ("msf_guess-that-is-nearly-right", "msf_guess-that-is-not-near-it");
    let mut stored = *blake3::hash(near.as_bytes()).as_bytes();
    stored[31] ^= 1;
    let stored = blake3::Hash::from_bytes(stored);
    let row = TokenRow {
        id: "1".to_owned(),
        name: "right".to_owned(),
        hash: stored.to_hex().to_string(),
        scopes: "read".to_owned(),
        created_ms: 1,
        revoked_ms: None,
        quota_bytes: None,
        quota_jobs: None,
        quota_images: None,
    };
    let mut tx = db.write().await.unwrap();
    tokens::insert(&mut tx, &row).await.unwrap();
    tx.commit().await.unwrap();

    let whole = times(trials, [far, near], async |guess| {
        let found = find_token(&db, guess).await.unwrap();
        assert!(black_box(found).is_none());
    });
    let whole = welch_t(whole.await);
    // Without all that surrounds it, and for comparison one that stops at the first difference, which the test must tell.
    let hashes = [blake3::hash(far.as_bytes()), blake3::hash(near.as_bytes())];
    let alone = times(trials, hashes, async |guess| {
        for _ in 0..REPEATS {
            black_box(black_box(&guess) == black_box(&stored));
        }
    });
    let alone = welch_t(alone.await);
    let early = times(trials, hashes, async |guess| {
        for _ in 0..REPEATS {
            let (guess, right) = (black_box(guess.as_bytes()), black_box(stored.as_bytes()));
            black_box(guess.iter().zip(right).all(|(a, b)| black_box(a) == black_box(b)));
        }
    });
    let early = welch_t(early.await);
    println!(
        "{trials} trials: t {whole:.2} of a look-up, {alone:.2} of a comparison, {early:.0} of one that stops early"
    );
    assert!(whole.abs() < T_LIMIT && alone.abs() < T_LIMIT, "t {whole} and {alone}");
    assert!(early.abs() > T_LIMIT, "the test can't tell: t {early}");
}

/// Hashes of tokens are compared in one place, as values whose comparison takes constant time; neither as texts nor by SQLite.
#[test]
fn hashes_of_tokens_are_compared_by_their_own_type_alone() {
    let source = Path::new(env!("CARGO_MANIFEST_DIR")).join("src");
    let read = |path: &str| std::fs::read_to_string(source.join(path)).unwrap();
    let find = read("store/token.rs");
    assert!(find.contains("blake3::Hash::from_hex(&row.hash).is_ok_and(|known| known == offered)"));
    assert_eq!(find.matches(".hash").count(), 1, "another use of a stored hash");
    let sql = read("store/db/tokens.rs");
    for condition in ["hash =", "hash=", "hash IS", "hash LIKE", "hash IN", "ORDER BY hash"] {
        assert!(!sql.contains(condition), "{condition}");
    }
}

/// Every way a token may come in, right and wrong, to a program that logs all it can.
#[tokio::test(flavor = "multi_thread")]
async fn no_token_is_in_the_log() {
    let _alone = crate::alone().await;
    let folder = tempfile::tempdir().unwrap();
    let (data, log) = (folder.path().join("data"), folder.path().join("log"));
    drop(Program::start(&data));
    let mut create = Command::new(env!("CARGO_BIN_EXE_multistage"));
    let create = create.args(["token", "create", "--name", "a", "--scopes", "read,submit", "--data-dir"]).arg(&data);
    let said = String::from_utf8(create.output().unwrap().stdout).unwrap();
    let token = said.split_whitespace().find(|word| word.starts_with("msf_")).unwrap().to_owned();
    let wrong = format!("{}x", &token[..token.len() - 1]);
    let log_file = std::fs::File::create(&log).unwrap();
    let program = Program::start_logging_at("trace", &data, &["--require-token"], log_file);
    let http = reqwest::Client::new();
    for (secret, right) in [(&token, true), (&wrong, false)] {
        let jobs = format!("{}/api/v1/jobs", program.base);
        let bearer = http.get(&jobs).bearer_auth(secret).send().await.unwrap().status();
        let basic = http.get(&jobs).basic_auth("a", Some(secret)).send().await.unwrap().status();
        assert_eq!((bearer.as_u16(), basic.as_u16()), if right { (200, 200) } else { (401, 401) });
        http.get(format!("{jobs}?token={secret}")).send().await.unwrap();
        let made = http.post(format!("{}/api/v1/datasets", program.base)).bearer_auth(secret).body("{").send().await;
        assert!(made.unwrap().status().is_client_error());
    }
    program.kill();
    let said = std::fs::read_to_string(&log).unwrap();
    assert!(said.contains("/api/v1/jobs") && said.lines().count() > 20, "{said}");
    for secret in [&token, &wrong] {
        assert!(!said.contains(&secret[4..20]), "{}", said.lines().find(|line| line.contains(&secret[4..20])).unwrap());
    }
}
