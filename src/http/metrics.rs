//! Counters of the process, in the Prometheus text format.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Mutex, MutexGuard, PoisonError};
use std::time::Instant;

use axum::http::StatusCode;

use super::problem::Code;
use crate::jobs::{JobState, StageSums, Sums};
use crate::store::db::write::{CLASSES_MS, WriteFigures};

/// What the process counts.
#[derive(Debug)]
pub struct Metrics {
    started: Instant,
    /// By the first digit of the status, from 1.
    responses: [AtomicU64; 5],
    upload_bytes: AtomicU64,
    upload_images: AtomicU64,
    /// By the problem's code.
    problems: Mutex<BTreeMap<&'static str, u64>>,
}

/// What is read from elsewhere for the figures.
pub(super) struct Readings {
    /// Jobs by state.
    pub(super) jobs: BTreeMap<String, i64>,
    /// Seconds that the longest waiting job has waited; none when nothing waits.
    pub(super) oldest_wait_s: Option<f64>,
    /// What jobs took.
    pub(super) sums: Sums,
    /// What writes to the database took.
    pub(super) writes: WriteFigures,
    /// Room on the disk, where it tells.
    pub(super) disk_free_bytes: Option<u64>,
}

impl Default for Metrics {
    fn default() -> Self {
        Self {
            started: Instant::now(),
            responses: Default::default(),
            upload_bytes: AtomicU64::new(0),
            upload_images: AtomicU64::new(0),
            problems: Mutex::default(),
        }
    }
}

impl Metrics {
    /// An answer was given.
    pub(super) fn answered(&self, status: StatusCode) {
        let class = usize::from(status.as_u16() / 100).saturating_sub(1);
        if let Some(count) = self.responses.get(class) {
            count.fetch_add(1, Ordering::Relaxed);
        }
    }

    /// A problem was the answer.
    pub(super) fn refused(&self, code: Code) {
        *self.problems().entry(code.as_str()).or_default() += 1;
    }

    fn problems(&self) -> MutexGuard<'_, BTreeMap<&'static str, u64>> {
        // A panic elsewhere can't leave the counts half changed.
        self.problems.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// An upload was stored.
    pub(super) fn uploaded(&self, bytes: u64, images: usize) {
        self.upload_bytes.fetch_add(bytes, Ordering::Relaxed);
        self.upload_images.fetch_add(images as u64, Ordering::Relaxed);
    }

    /// Everything as text.
    pub(super) fn text(&self, readings: &Readings) -> String {
        let Readings { jobs, oldest_wait_s, sums, writes, disk_free_bytes } = readings;
        let mut text = String::new();
        let mut family = |name: &str, kind: &str, help: &str, samples: &[(String, String)]| {
            // Writing into a string can't fail.
            let _ = write!(text, "# HELP {name} {help}\n# TYPE {name} {kind}\n");
            for (labels, value) in samples {
                let _ = writeln!(text, "{name}{labels} {value}");
            }
        };
        let plain = |value: String| [(String::new(), value)];
        let version = format!("{{version=\"{}\"}}", env!("CARGO_PKG_VERSION"));
        family("multistage_build_info", "gauge", "The version that runs.", &[(version, "1".to_owned())]);
        let uptime_s = plain(format!("{:.3}", self.started.elapsed().as_secs_f64()));
        family("multistage_uptime_seconds", "gauge", "Time since the start.", &uptime_s);
        let responses: Vec<_> = (1..)
            .zip(&self.responses)
            .map(|(class, count)| (format!("{{class=\"{class}xx\"}}"), count.load(Ordering::Relaxed).to_string()))
            .collect();
        family("multistage_http_responses_total", "counter", "Answers by class of their status.", &responses);
        let bytes = plain(self.upload_bytes.load(Ordering::Relaxed).to_string());
        family("multistage_upload_bytes_total", "counter", "Bytes of photographs and archives received.", &bytes);
        let images = plain(self.upload_images.load(Ordering::Relaxed).to_string());
        family("multistage_upload_images_total", "counter", "Photographs stored.", &images);
        let states: Vec<_> = JobState::ALL
            .iter()
            .map(|state| {
                let count = jobs.get(state.as_str()).copied().unwrap_or(0);
                (format!("{{state=\"{state}\"}}"), count.to_string())
            })
            .collect();
        family("multistage_jobs", "gauge", "Jobs by state.", &states);
        let wait_s = plain(format!("{:.3}", oldest_wait_s.unwrap_or(0.0)));
        family(
            "multistage_queue_oldest_wait_seconds",
            "gauge",
            "Time that the longest waiting job has waited.",
            &wait_s,
        );
        let labelled = |label: &str, counts: &mut dyn Iterator<Item = (&str, u64)>| -> Vec<(String, String)> {
            counts.map(|(name, count)| (format!("{{{label}=\"{name}\"}}"), count.to_string())).collect()
        };
        let ended = labelled("state", &mut sums.ended.iter().map(|(state, count)| (*state, *count)));
        family("multistage_job_runs_total", "counter", "Runs by the state that they left the job in.", &ended);
        let failed = labelled("code", &mut sums.failed.iter().map(|(code, count)| (code.as_str(), *count)));
        family("multistage_job_errors_total", "counter", "Failed runs by their error.", &failed);
        let of_stages = |value: fn(&StageSums) -> String| -> Vec<_> {
            sums.stages.iter().map(|(stage, sums)| (format!("{{stage=\"{stage}\"}}"), value(sums))).collect()
        };
        let runs = of_stages(|sums| sums.runs.to_string());
        family("multistage_stage_runs_total", "counter", "Stages that ran to their end.", &runs);
        let wall_s = of_stages(|sums| format!("{:.3}", sums.wall_s));
        family("multistage_stage_wall_seconds_total", "counter", "Wall-clock time of stages.", &wall_s);
        let cpu_s = of_stages(|sums| format!("{:.3}", sums.cpu_s));
        family("multistage_stage_cpu_seconds_total", "counter", "CPU time of stages.", &cpu_s);
        let reused = plain(sums.stages_reused.to_string());
        family("multistage_stages_reused_total", "counter", "Stages whose results were re-used.", &reused);
        let images = plain(sums.images.to_string());
        family("multistage_job_images_total", "counter", "Photographs of runs that came to a report.", &images);
        let seconds = plain(format!("{:.3}", sums.seconds));
        family("multistage_job_seconds_total", "counter", "Wall-clock time of those runs.", &seconds);
        let rate = if sums.seconds > 0.0 { sums.images as f64 / sums.seconds } else { 0.0 };
        let rate = plain(format!("{rate:.4}"));
        family("multistage_job_images_per_second", "gauge", "Photographs per second of those runs.", &rate);
        let problems = labelled("code", &mut self.problems().iter().map(|(code, count)| (*code, *count)));
        family("multistage_http_problems_total", "counter", "Problems answered, by code.", &problems);
        family(
            "multistage_store_write_seconds",
            "histogram",
            "Time of writes to the database, in their queue too, without the disk's syncs.",
            &histogram(writes),
        );
        let syncs = plain(format!("{:.3}", writes.syncs.as_secs_f64()));
        family(
            "multistage_store_sync_seconds_total",
            "counter",
            "Time in which a commit to the database waited for the disk.",
            &syncs,
        );
        if let Some(free) = disk_free_bytes {
            family("multistage_disk_free_bytes", "gauge", "Room on the disk.", &plain(free.to_string()));
        }
        text
    }
}

/// The samples of a histogram, by what follows its name.
fn histogram(writes: &WriteFigures) -> Vec<(String, String)> {
    let mut count = 0;
    let ends = CLASSES_MS.iter().map(|end_ms| (*end_ms as f64 / 1000.0).to_string()).chain(["+Inf".to_owned()]);
    let mut samples: Vec<_> = ends
        .zip(&writes.counts)
        .map(|(end, more)| {
            count += more;
            (format!("_bucket{{le=\"{end}\"}}"), count.to_string())
        })
        .collect();
    samples.push(("_sum".to_owned(), format!("{:.6}", writes.time.as_secs_f64())));
    samples.push(("_count".to_owned(), count.to_string()));
    samples
}
