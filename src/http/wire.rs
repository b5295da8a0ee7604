//! The JSON shapes of `openapi.yaml`.

use serde::Serialize;
use uuid::Uuid;

use crate::formats::report::ImageReport;
use crate::jobs::view::{CurrentStage, ErrorView, ModelSummary, StageView, time_text};
use crate::jobs::{Eta, JobState, QueuePlace, estimate, state_of};
use crate::store::db::dataset_images::DatasetImageRow;
use crate::store::db::datasets::DatasetRow;
use crate::store::db::job_images::{JobImageCounts, JobImageRow};
use crate::store::db::job_outputs::JobOutputRow;
use crate::store::db::job_stages::JobStageRow;
use crate::store::db::jobs::JobRow;
use crate::store::db::now_ms;
use crate::store::db::webhooks::{DeliveryRow, WebhookRow};

/// The address of a job.
pub(super) fn job_link(id: &str) -> String {
    format!("/api/v1/jobs/{id}")
}

/// The address of an output of a job.
fn output_link(job: &str, path: &str) -> String {
    use percent_encoding::{AsciiSet, NON_ALPHANUMERIC, utf8_percent_encode};
    const KEPT: &AsciiSet = &NON_ALPHANUMERIC.remove(b'/').remove(b'.').remove(b'-').remove(b'_').remove(b'~');
    format!("{}/outputs/{}", job_link(job), utf8_percent_encode(path, KEPT))
}

#[derive(Serialize)]
pub(super) struct Job {
    id: String,
    name: String,
    state: JobState,
    cancel_requested: bool,
    created_at: String,
    started_at: Option<String>,
    finished_at: Option<String>,
    dataset_id: String,
    options: serde_json::Value,
    priority: i64,
    queue: Option<QueuePlace>,
    resources: Option<Resources>,
    images: ImageCounts,
    stage: Option<CurrentStage>,
    stages: Vec<StageView>,
    eta_s: Option<Eta>,
    models: Vec<Model>,
    error: Option<ErrorView>,
    links: JobLinks,
}

/// What a job was given.
#[derive(Serialize)]
struct Resources {
    threads: i64,
    memory_bytes: Option<i64>,
    disk_bytes: Option<i64>,
    note: Option<String>,
}

#[derive(Serialize)]
struct ImageCounts {
    uploaded: i64,
    ignored: Option<i64>,
    registered: Option<i64>,
    unregistered: Option<i64>,
    rejected: Option<i64>,
}

#[derive(Serialize)]
struct Model {
    #[serde(flatten)]
    summary: ModelSummary,
    links: ModelLinks,
}

#[derive(Serialize)]
struct ModelLinks {
    points: String,
    cameras: String,
}

#[derive(Serialize)]
struct JobLinks {
    #[serde(rename = "self")]
    this: String,
    events: String,
    cancel: String,
    resume: String,
    images: String,
    outputs: String,
    archive: String,
    report: String,
    dataset: String,
    webhooks: String,
}

impl Job {
    /// `place` is where a waiting job stands.
    pub(super) fn new(row: JobRow, stages: &[JobStageRow], images: JobImageCounts, place: Option<QueuePlace>) -> Self {
        let state = state_of(&row);
        let running = state == JobState::Running;
        let models: Option<Vec<ModelSummary>> = row.models.as_deref().and_then(|json| serde_json::from_str(json).ok());
        let known = |count: i64| models.is_some().then_some(count);
        let link = job_link(&row.id);
        Self {
            state,
            cancel_requested: row.cancel_requested,
            created_at: time_text(row.created_ms),
            started_at: row.started_ms.map(time_text),
            finished_at: row.finished_ms.map(time_text),
            options: serde_json::from_str(&row.options).unwrap_or_default(),
            images: ImageCounts {
                uploaded: images.uploaded,
                ignored: row.ignored,
                registered: known(images.registered),
                unregistered: known(images.unregistered),
                rejected: known(images.rejected),
            },
            stage: if running { CurrentStage::among(stages) } else { None },
            stages: stages.iter().map(StageView::of).collect(),
            priority: row.priority,
            queue: place,
            resources: row.threads.filter(|threads| *threads > 0).map(|threads| Resources {
                threads,
                memory_bytes: row.memory_bytes,
                disk_bytes: row.needed_bytes,
                note: row.resource_note.clone(),
            }),
            eta_s: if running { estimate(stages, now_ms()) } else { place.and_then(|place| place.done_in_s) },
            error: ErrorView::of(&row),
            models: models
                .unwrap_or_default()
                .into_iter()
                .map(|summary| Model {
                    links: ModelLinks {
                        points: output_link(&row.id, &format!("ply/{}/points.ply", summary.id)),
                        cameras: output_link(&row.id, &format!("ply/{}/cameras.ply", summary.id)),
                    },
                    summary,
                })
                .collect(),
            links: JobLinks {
                events: format!("{link}/events"),
                cancel: format!("{link}/cancel"),
                resume: format!("{link}/resume"),
                images: format!("{link}/images"),
                outputs: format!("{link}/outputs"),
                archive: format!("{link}/outputs.zip"),
                report: format!("{link}/outputs/report.html"),
                dataset: format!("/api/v1/datasets/{}", row.dataset_id),
                webhooks: format!("{link}/webhooks"),
                this: link,
            },
            id: row.id,
            name: row.name,
            dataset_id: row.dataset_id,
        }
    }
}

#[derive(Serialize)]
pub(super) struct JobPage {
    pub(super) jobs: Vec<Job>,
    pub(super) next_cursor: Option<String>,
}

#[derive(Serialize)]
pub(super) struct ProgressEvent {
    pub(super) stage: CurrentStage,
    pub(super) eta_s: Option<Eta>,
}

#[derive(Serialize)]
pub(super) struct JobImage {
    n: i64,
    name: String,
    size_bytes: i64,
    sha256: String,
    state: String,
    width: Option<u32>,
    height: Option<u32>,
    model: Option<usize>,
    features: Option<usize>,
    registered_in: Option<String>,
    inliers: Option<usize>,
    mean_reprojection_error_px: Option<f64>,
    focal_px: Option<f64>,
    reason: Option<String>,
    advice: Option<String>,
    links: JobImageLinks,
}

#[derive(Serialize)]
struct JobImageLinks {
    thumbnail: String,
}

impl JobImage {
    pub(super) fn new(job: Uuid, row: JobImageRow) -> Self {
        let verdict: Option<ImageReport> = row.verdict.as_deref().and_then(|json| serde_json::from_str(json).ok());
        let verdict = verdict.as_ref();
        // A photograph the engine said nothing about; the executor logs it.
        let unknown = verdict.is_none() && row.state == "rejected";
        Self {
            n: row.n,
            links: JobImageLinks { thumbnail: format!("{}/images/{}/thumbnail", job_link(&job.to_string()), row.n) },
            name: row.path,
            size_bytes: row.size_bytes,
            sha256: row.sha256,
            state: row.state,
            width: verdict.and_then(|v| v.width),
            height: verdict.and_then(|v| v.height),
            model: verdict.and_then(|v| v.model),
            features: verdict.and_then(|v| v.features),
            registered_in: verdict.and_then(|v| v.registered_in.clone()),
            inliers: verdict.and_then(|v| v.inliers),
            mean_reprojection_error_px: verdict.and_then(|v| v.mean_reprojection_error_px),
            focal_px: verdict.and_then(|v| v.focal_px),
            reason: verdict.and_then(|v| v.reason.clone()).or_else(|| unknown.then(|| "not_examined".to_owned())),
            advice: verdict
                .and_then(|v| v.advice.clone())
                .or_else(|| unknown.then(|| "The engine did not look at this file.".to_owned())),
        }
    }
}

#[derive(Serialize)]
pub(super) struct JobImagePage {
    pub(super) images: Vec<JobImage>,
    pub(super) total: i64,
    pub(super) next_cursor: Option<String>,
}

#[derive(Serialize)]
pub(super) struct OutputList {
    files: Vec<Output>,
    total_bytes: i64,
    links: OutputListLinks,
}

#[derive(Serialize)]
struct Output {
    path: String,
    size_bytes: i64,
    media_type: &'static str,
    etag: String,
    links: SelfLink,
}

#[derive(Serialize)]
struct SelfLink {
    #[serde(rename = "self")]
    this: String,
}

#[derive(Serialize)]
struct OutputListLinks {
    archive: String,
}

impl OutputList {
    pub(super) fn new(job: Uuid, rows: Vec<JobOutputRow>) -> Self {
        let job = job.to_string();
        Self {
            total_bytes: rows.iter().map(|row| row.size_bytes).sum(),
            links: OutputListLinks { archive: format!("{}/outputs.zip", job_link(&job)) },
            files: rows
                .into_iter()
                .map(|row| Output {
                    media_type: super::download::media_type_of(&row.path),
                    etag: super::download::etag(&row.blake3),
                    links: SelfLink { this: output_link(&job, &row.path) },
                    size_bytes: row.size_bytes,
                    path: row.path,
                })
                .collect(),
        }
    }
}

#[derive(Serialize)]
pub(super) struct WebhookList {
    pub(super) webhooks: Vec<Webhook>,
}

/// A webhook without its secret.
#[derive(Serialize)]
pub(super) struct Webhook {
    id: String,
    url: String,
    created_at: String,
    deliveries: Vec<Delivery>,
    links: SelfLink,
}

#[derive(Serialize)]
struct Delivery {
    event_id: i64,
    state: String,
    attempts: i64,
    next_attempt_at: Option<String>,
    last_attempt_at: Option<String>,
    last_status: Option<i64>,
    last_error: Option<String>,
}

impl Webhook {
    pub(super) fn new(row: WebhookRow, deliveries: Vec<DeliveryRow>) -> Self {
        let delivery = |row: DeliveryRow| Delivery {
            event_id: row.event_id,
            attempts: row.attempts,
            // One that was never tried is tried at once.
            next_attempt_at: (row.state == "pending" && row.next_ms > 0).then(|| time_text(row.next_ms)),
            state: row.state,
            last_attempt_at: row.last_ms.map(time_text),
            last_status: row.last_status,
            last_error: row.last_error,
        };
        Self {
            links: SelfLink { this: format!("{}/webhooks/{}", job_link(&row.job_id), row.id) },
            id: row.id,
            url: row.url,
            created_at: time_text(row.created_ms),
            deliveries: deliveries.into_iter().map(delivery).collect(),
        }
    }
}

#[derive(Serialize)]
pub(super) struct Dataset {
    id: String,
    name: String,
    created_at: String,
    images: i64,
    size_bytes: i64,
    links: DatasetLinks,
}

#[derive(Serialize)]
struct DatasetLinks {
    #[serde(rename = "self")]
    this: String,
    images: String,
}

impl Dataset {
    pub(super) fn new(row: DatasetRow) -> Self {
        let link = format!("/api/v1/datasets/{}", row.id);
        Self {
            links: DatasetLinks { images: format!("{link}/images"), this: link },
            id: row.id,
            name: row.name,
            created_at: time_text(row.created_ms),
            images: row.images,
            size_bytes: row.size_bytes,
        }
    }
}

#[derive(Serialize)]
pub(super) struct DatasetPage {
    pub(super) datasets: Vec<Dataset>,
    pub(super) next_cursor: Option<String>,
}

#[derive(Serialize)]
pub(super) struct DatasetImage {
    path: String,
    size_bytes: i64,
    sha256: String,
}

impl DatasetImage {
    pub(super) fn new(row: DatasetImageRow) -> Self {
        Self { path: row.path, size_bytes: row.size_bytes, sha256: row.sha256 }
    }
}

#[derive(Serialize)]
pub(super) struct DatasetImagePage {
    pub(super) images: Vec<DatasetImage>,
    pub(super) next_cursor: Option<String>,
}

#[derive(Serialize)]
pub(super) struct UploadResult {
    pub(super) stored: usize,
    pub(super) unchanged: usize,
    pub(super) ignored: Vec<String>,
    pub(super) dataset: Dataset,
}

#[derive(Serialize)]
pub(super) struct Health {
    pub(super) status: &'static str,
    pub(super) version: &'static str,
}
