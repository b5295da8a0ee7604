//! Everything the database says about files, and what SQLite says about the database.

use std::collections::BTreeSet;

use sqlx::{FromRow, SqlitePool};

/// A file that must be there.
#[derive(Clone, Debug, FromRow)]
pub struct KnownFile {
    /// The dataset or job it belongs to.
    pub folder: String,
    /// Its path there.
    pub path: String,
    /// Its length.
    pub size_bytes: i64,
    /// Of its bytes, in hexadecimal.
    pub hash: String,
}

/// All files of one moment.
#[derive(Clone, Debug, Default)]
pub struct Inventory {
    /// Ids of datasets.
    pub datasets: BTreeSet<String>,
    /// Ids of jobs.
    pub jobs: BTreeSet<String>,
    /// Photographs, hashed by SHA-256.
    pub images: Vec<KnownFile>,
    /// Outputs, hashed by BLAKE3.
    pub outputs: Vec<KnownFile>,
    /// Open uploads with the bytes that came.
    pub uploads: Vec<(String, i64)>,
}

impl Inventory {
    /// Reads it, all in one transaction.
    ///
    /// # Errors
    /// What SQLite said.
    pub async fn read(pool: &SqlitePool) -> sqlx::Result<Self> {
        let mut tx = pool.begin().await?;
        let datasets: Vec<String> = sqlx::query_scalar("SELECT id FROM datasets").fetch_all(&mut *tx).await?;
        let jobs: Vec<String> = sqlx::query_scalar("SELECT id FROM jobs").fetch_all(&mut *tx).await?;
        let images = "SELECT dataset_id AS folder, path, size_bytes, sha256 AS hash FROM dataset_images";
        let outputs = "SELECT job_id AS folder, path, size_bytes, blake3 AS hash FROM job_outputs";
        Ok(Self {
            datasets: datasets.into_iter().collect(),
            jobs: jobs.into_iter().collect(),
            images: sqlx::query_as(images).fetch_all(&mut *tx).await?,
            outputs: sqlx::query_as(outputs).fetch_all(&mut *tx).await?,
            uploads: sqlx::query_as("SELECT id, offset FROM uploads WHERE stored = 0 AND offset > 0")
                .fetch_all(&mut *tx)
                .await?,
        })
    }
}

/// What SQLite finds wrong with the file and with references between rows; nothing when all is well.
///
/// # Errors
/// What SQLite said.
pub async fn integrity(pool: &SqlitePool) -> sqlx::Result<Vec<String>> {
    let mut wrong: Vec<String> = sqlx::query_scalar("PRAGMA integrity_check").fetch_all(pool).await?;
    wrong.retain(|line| line != "ok");
    let loose: Vec<(String,)> =
        sqlx::query_as("SELECT DISTINCT \"table\" FROM pragma_foreign_key_check").fetch_all(pool).await?;
    wrong.extend(loose.into_iter().map(|(table,)| format!("a row of {table} refers to one that is not there")));
    Ok(wrong)
}

/// Writes the database as it is at one moment into a new file.
///
/// # Errors
/// What SQLite said.
pub async fn snapshot(pool: &SqlitePool, path: &std::path::Path) -> sqlx::Result<()> {
    sqlx::query("VACUUM INTO ?").bind(path.to_string_lossy().into_owned()).execute(pool).await?;
    Ok(())
}
