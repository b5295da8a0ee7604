//! Counters of the process, in the Prometheus text format.

use std::collections::BTreeMap;
use std::fmt::Write;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Instant;

use axum::http::StatusCode;

use crate::jobs::JobState;

/// What the process counts.
#[derive(Debug)]
pub struct Metrics {
    started: Instant,
    /// By the first digit of the status, from 1.
    responses: [AtomicU64; 5],
    upload_bytes: AtomicU64,
    upload_images: AtomicU64,
}

impl Default for Metrics {
    fn default() -> Self {
        Self {
            started: Instant::now(),
            responses: Default::default(),
            upload_bytes: AtomicU64::new(0),
            upload_images: AtomicU64::new(0),
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

    /// An upload was stored.
    pub(super) fn uploaded(&self, bytes: u64, images: usize) {
        self.upload_bytes.fetch_add(bytes, Ordering::Relaxed);
        self.upload_images.fetch_add(images as u64, Ordering::Relaxed);
    }

    /// Everything as text, with the jobs per state.
    pub(super) fn text(&self, jobs: &BTreeMap<String, i64>) -> String {
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
        text
    }
}
