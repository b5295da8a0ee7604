//! Databases of every earlier schema come up to date with all they hold, also when the program is killed over it.

use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

use multistage::store::{DataDir, Db};
use sqlx::SqlitePool;
use sqlx::migrate::Migrator;
use sqlx::sqlite::SqliteConnectOptions;

use crate::program::Program;
use crate::service::Service;

const DATASET: &str = "01999999-0000-7000-8000-00000000000d";
const JOB: &str = "01999999-0000-7000-8000-00000000000a";
const TOKEN: &str = "01999999-0000-7000-8000-00000000000b";

fn migrations() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("migrations");
    let mut files: Vec<_> = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path()).collect();
    files.sort();
    files
}

/// A database as the first `count` migrations leave it, with a row in every table they make.
async fn old_database(path: &Path, count: usize) {
    let chosen = tempfile::tempdir().unwrap();
    for file in &migrations()[..count] {
        std::fs::copy(file, chosen.path().join(file.file_name().unwrap())).unwrap();
    }
    let options = SqliteConnectOptions::new().filename(path).create_if_missing(true).foreign_keys(true);
    let pool = SqlitePool::connect_with(options).await.unwrap();
    Migrator::new(chosen.path()).await.unwrap().run(&pool).await.unwrap();
    let image = "'a.jpg', 5, 'cee8c5b5ba2b3d3ee0ebc5bfd5c4f0e1b4d9c1d6d2e1d4c1f0e1b4d9c1d6d2e1'";
    let mut rows = vec![
        format!("INSERT INTO datasets (id, seq, name, created_ms) VALUES ('{DATASET}', 1, 'old', 1000)"),
        format!("INSERT INTO dataset_images (dataset_id, path, size_bytes, sha256) VALUES ('{DATASET}', {image})"),
        format!(
            "INSERT INTO jobs (id, seq, name, state, created_ms, started_ms, finished_ms, dataset_id, options, models)
             VALUES ('{JOB}', 1, 'old job', 'succeeded', 1000, 2000, 3000, '{DATASET}', '{{}}', '[]')"
        ),
        format!(
            "INSERT INTO job_stages (job_id, ord, name, state, done, counts) VALUES ('{JOB}', 0, 'intake', 'done', 1, '{{}}')"
        ),
        format!("INSERT INTO job_events (job_id, id, kind, data) VALUES ('{JOB}', 1, 'state', '{{}}')"),
        format!(
            "INSERT INTO job_images (job_id, n, path, size_bytes, sha256, state) VALUES ('{JOB}', 0, {image}, 'pending')"
        ),
        format!("INSERT INTO job_outputs (job_id, path, size_bytes, blake3) VALUES ('{JOB}', 'report.json', 2, 'ab')"),
    ];
    if count >= 2 {
        rows.push(
            "INSERT INTO uploads (id, created_ms, expires_ms, kind, metadata) VALUES ('u', 1, 99999999999999, 'partial', '')"
                .to_owned(),
        );
    }
    if count >= 3 {
        rows.push(format!(
            "INSERT INTO tokens (id, name, hash, scopes, created_ms) VALUES ('{TOKEN}', 'team', 'ff', 'read', 1)"
        ));
    }
    for row in rows {
        sqlx::query(sqlx::AssertSqlSafe(row)).execute(&pool).await.unwrap();
    }
    pool.close().await;
}

#[tokio::test(flavor = "multi_thread")]
async fn every_earlier_schema_comes_up_to_date_with_its_rows() {
    let all = migrations().len();
    assert!(all >= 6, "the migrations were not found");
    for count in 1..=all {
        let folder = tempfile::tempdir().unwrap();
        old_database(&DataDir::database_in(folder.path()), count).await;
        let images = folder.path().join(format!("datasets/{DATASET}/images"));
        std::fs::create_dir_all(&images).unwrap();
        std::fs::write(images.join("a.jpg"), b"a.jpg").unwrap();
        let service = Service::start_in(folder, |_| {}).await;
        let job = service.get(&format!("/api/v1/jobs/{JOB}")).await.ok(200);
        assert_eq!(
            (&job["name"], &job["state"], &job["priority"]),
            (&"old job".into(), &"succeeded".into(), &0.into())
        );
        assert_eq!(job["stages"][0]["name"], "intake");
        let dataset = service.get(&format!("/api/v1/datasets/{DATASET}")).await.ok(200);
        assert_eq!((&dataset["images"], &dataset["size_bytes"]), (&1.into(), &5.into()));
        // New work on what is old.
        let body = serde_json::json!({"dataset_id": DATASET});
        let new = service.post_json("/api/v1/jobs", &body).await.ok(202);
        service.wait_state(&new, "succeeded").await;
        let folder = service.stop().await;
        let db = Db::open(&DataDir::database_in(folder.path())).await.unwrap();
        let verdict: String = sqlx::query_scalar("PRAGMA integrity_check").fetch_one(db.reader()).await.unwrap();
        assert_eq!(verdict, "ok");
        let loose: Vec<(String,)> =
            sqlx::query_as("SELECT \"table\" FROM pragma_foreign_key_check").fetch_all(db.reader()).await.unwrap();
        assert!(loose.is_empty(), "{loose:?}");
        if count >= 3 {
            let tokens = multistage::store::db::tokens::list(db.reader()).await.unwrap();
            assert_eq!(tokens.iter().map(|token| token.name.as_str()).collect::<Vec<_>>(), ["team"]);
        }
        db.close().await;
    }
}

/// Rows that make a migration take its time.
const MANY: i64 = 60_000;
/// Kills while a database is migrated.
const KILLS: u32 = 24;

/// Rows of every table, and migrations that are done, in a database as the last process left it.
async fn rows_and_migrations(data_dir: &Path) -> ([i64; 4], i64) {
    let options = SqliteConnectOptions::new().filename(DataDir::database_in(data_dir));
    let pool = SqlitePool::connect_with(options).await.unwrap();
    let verdict: String = sqlx::query_scalar("PRAGMA integrity_check").fetch_one(&pool).await.unwrap();
    assert_eq!(verdict, "ok");
    let count = async |table: &str| -> i64 {
        let sql = sqlx::AssertSqlSafe(format!("SELECT COUNT(*) FROM {table}"));
        sqlx::query_scalar(sql).fetch_one(&pool).await.unwrap()
    };
    let rows = [
        count("datasets").await,
        count("dataset_images").await,
        count("jobs WHERE state = 'succeeded'").await,
        count("job_events").await,
    ];
    let migrations = count("_sqlx_migrations WHERE success").await;
    pool.close().await;
    (rows, migrations)
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kill_in_the_middle_of_a_migration_loses_nothing() {
    let folder = tempfile::tempdir().unwrap();
    let old = folder.path().join("old.db");
    old_database(&old, 1).await;
    let pool = SqlitePool::connect_with(SqliteConnectOptions::new().filename(&old)).await.unwrap();
    for many in [
        "INSERT INTO datasets (id, seq, name, created_ms) SELECT 'd' || n, n + 1, 'many', 1000 FROM numbers".to_owned(),
        format!(
            "INSERT INTO dataset_images (dataset_id, path, size_bytes, sha256) SELECT '{DATASET}', 'm' || n, 5, 'ab' FROM numbers"
        ),
        format!(
            "INSERT INTO jobs (id, seq, name, state, created_ms, started_ms, finished_ms, dataset_id, options, models)
             SELECT 'j' || n, n + 1, 'many', 'succeeded', 1000, 2000, 3000, '{DATASET}', '{{}}', '[]' FROM numbers"
        ),
        "INSERT INTO job_events (job_id, id, kind, data) SELECT 'j' || n, 1, 'state', '{}' FROM numbers".to_owned(),
    ] {
        let numbers = "WITH RECURSIVE numbers (n) AS (SELECT 1 UNION ALL SELECT n + 1 FROM numbers WHERE n < ?) ";
        let sql = sqlx::AssertSqlSafe(format!("{numbers}{many}"));
        sqlx::query(sql).bind(MANY).execute(&pool).await.unwrap();
    }
    pool.close().await;
    let all = i64::try_from(migrations().len()).unwrap();
    let fresh = |name: &str| {
        let data = folder.path().join(name);
        std::fs::create_dir(&data).unwrap();
        std::fs::copy(&old, DataDir::database_in(&data)).unwrap();
        data
    };
    let undisturbed = fresh("undisturbed");
    let start = Instant::now();
    Program::start(&undisturbed).kill();
    let takes = start.elapsed();
    let (expected, done) = rows_and_migrations(&undisturbed).await;
    assert_eq!((expected, done), ([MANY + 1; 4], all));

    let mut left_at = std::collections::BTreeMap::new();
    let mut data = fresh("killed-0");
    for kill in 0..KILLS {
        let mut program = Program::spawn(&data);
        // Moments all over the time that it takes, in another order than that of time.
        let share = f64::from((kill * 7) % KILLS) / f64::from(KILLS);
        std::thread::sleep(Duration::from_millis(2) + takes.mul_f64(share));
        program.kill().unwrap();
        program.wait().unwrap();
        let (rows, done) = rows_and_migrations(&data).await;
        assert_eq!(rows, expected, "after kill {kill}");
        *left_at.entry(done).or_insert(0) += 1;
        if done == all || kill % 3 == 2 {
            // It comes up from where the kill left it.
            Program::start(&data).kill();
            assert_eq!(rows_and_migrations(&data).await, (expected, all), "after kill {kill}");
            data = fresh(&format!("killed-{}", kill + 1));
        }
    }
    println!("migrating takes {takes:.2?}; migrations done when it was killed, and how often: {left_at:?}");
    let halfway: i32 = left_at.iter().filter(|(done, _)| (1..all).contains(*done)).map(|(_, count)| count).sum();
    assert!(halfway >= 3, "too few kills came in the middle: {left_at:?}");
}
