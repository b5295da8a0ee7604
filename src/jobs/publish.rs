//! A run's result on its way into the store: outputs first, then the rows that speak of them.

use std::collections::BTreeMap;
use std::fs::File;
use std::io;

use sqlx::SqliteConnection;
use uuid::Uuid;

use super::view::ModelSummary;
use crate::formats::report::{ImageReport, ImageState, Report};
use crate::store::db::job_images;
use crate::store::db::job_outputs::JobOutputRow;
use crate::store::{Checksums, DataDir, StoreError, atomic};

/// Makes the outputs that a run left in its partial folder durable and puts them in the place of older ones, all at once.
/// Blocking.
pub(super) fn publish(data: &DataDir, job: Uuid) -> io::Result<Vec<JobOutputRow>> {
    let out = data.out(job);
    // An earlier attempt may have come as far as the rename.
    let partial = if data.partial(job).exists() { data.partial(job) } else { out.clone() };
    let mut outputs = Vec::new();
    for path in atomic::list_files(&partial)? {
        let mut file = File::open(partial.join(&path))?;
        let sums = Checksums::of(&mut file)?;
        file.sync_all()?;
        outputs.push(JobOutputRow {
            path,
            size_bytes: i64::try_from(sums.size_bytes).unwrap_or(i64::MAX),
            blake3: sums.blake3,
            crc32: Some(sums.crc32),
        });
    }
    atomic::sync_folders(&partial)?;
    if partial != out {
        data.discard(&out)?;
        std::fs::rename(&partial, &out)?;
    }
    atomic::sync_parent(&out)?;
    // The job's own folder is as new as what is in it.
    atomic::sync_parent(out.parent().unwrap_or(&out))?;
    Ok(outputs)
}

/// The report's models as they are kept with the job.
pub(super) fn models_json(report: &Report) -> String {
    let models: Vec<ModelSummary> = report.models.iter().map(ModelSummary::of).collect();
    serde_json::to_string(&models).unwrap_or_else(|_| "[]".to_owned())
}

/// Writes the report's verdict on every photograph of the job.
pub(super) async fn write_verdicts(tx: &mut SqliteConnection, job: Uuid, report: &Report) -> Result<(), StoreError> {
    let verdicts: BTreeMap<&str, &ImageReport> =
        report.images.iter().map(|image| (image.name.as_str(), image)).collect();
    for image in job_images::list(&mut *tx, job, None, -1, u32::MAX).await? {
        let Some(verdict) = verdicts.get(image.path.as_str()) else {
            tracing::warn!(%job, image = image.path, "the report says nothing about a photograph");
            job_images::set_verdict(tx, job, image.n, "rejected", None).await?;
            continue;
        };
        let state = match verdict.state {
            ImageState::Registered => "registered",
            ImageState::Unregistered => "unregistered",
            ImageState::Rejected => "rejected",
        };
        let json = serde_json::to_string(verdict).map_err(|error| sqlx::Error::Encode(error.into()))?;
        job_images::set_verdict(tx, job, image.n, state, Some(&json)).await?;
    }
    Ok(())
}
