//! Progress as server-sent events.

use std::collections::VecDeque;
use std::convert::Infallible;

use axum::Router;
use axum::extract::State;
use axum::http::{HeaderMap, HeaderValue, StatusCode};
use axum::response::sse::{Event, KeepAlive, Sse};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use futures_util::stream;
use tokio::sync::watch;
use uuid::Uuid;

use crate::http::extract::JobId;
use crate::http::problem::Problem;
use crate::http::{AppState, wire};
use crate::jobs::view::CurrentStage;
use crate::jobs::{estimate, state_of};
use crate::store::db::{job_events, job_stages, jobs, now_ms};

pub(in crate::http) fn router() -> Router<AppState> {
    Router::new().route("/api/v1/jobs/{job_id}/events", get(events))
}

/// One client's view of a job's events.
struct Feed {
    state: AppState,
    job: Uuid,
    /// The last event that was sent.
    last: i64,
    changes: watch::Receiver<u64>,
    waiting: VecDeque<Event>,
    progress: Option<CurrentStage>,
    started: bool,
    over: bool,
}

async fn events(State(state): State<AppState>, JobId(job): JobId, headers: HeaderMap) -> Result<Response, Problem> {
    let row = state.jobs.find(job).await?;
    // An id this service never gave means nothing: such a client gets everything.
    let seen = headers.get("last-event-id").and_then(|value| value.to_str().ok()).and_then(|id| id.trim().parse().ok());
    let last = seen.unwrap_or(0);
    if state_of(&row).is_final() && job_events::list_after(state.jobs.store.db.reader(), job, last).await?.is_empty() {
        return Ok(StatusCode::NO_CONTENT.into_response());
    }
    let keep_alive = KeepAlive::new().interval(state.config.keep_alive);
    let feed = Feed {
        changes: state.jobs.hub.changes(),
        state,
        job,
        last,
        waiting: VecDeque::new(),
        progress: None,
        started: false,
        over: false,
    };
    let mut response = Sse::new(stream::unfold(feed, next)).keep_alive(keep_alive).into_response();
    // Proxies that collect an answer before they pass it on must not do so with this one.
    response.headers_mut().insert("x-accel-buffering", HeaderValue::from_static("no"));
    Ok(response)
}

async fn next(mut feed: Feed) -> Option<(Result<Event, Infallible>, Feed)> {
    loop {
        if let Some(event) = feed.waiting.pop_front() {
            return Some((Ok(event), feed));
        }
        if feed.over {
            return None;
        }
        if feed.started {
            tokio::select! {
                changed = feed.changes.changed() => changed.ok()?,
                () = feed.state.shutdown.cancelled() => return None,
            }
        }
        feed.started = true;
        if let Err(error) = feed.refill().await {
            tracing::warn!(job = %feed.job, %error, "an event stream ended because the store failed");
            return None;
        }
    }
}

impl Feed {
    /// Reads what is new. The job's row is read before its events, so that a final state is never seen without its event.
    async fn refill(&mut self) -> sqlx::Result<()> {
        self.changes.mark_unchanged();
        let reader = self.state.jobs.store.db.reader();
        let Some(row) = jobs::find(reader, self.job).await? else {
            self.over = true;
            return Ok(());
        };
        for event in job_events::list_after(reader, self.job, self.last).await? {
            self.last = event.id;
            self.waiting.push_back(Event::default().id(event.id.to_string()).event(event.kind).data(event.data));
        }
        self.over = state_of(&row).is_final();
        if self.over {
            return Ok(());
        }
        let stages = job_stages::list(reader, self.job).await?;
        if let Some(stage) = CurrentStage::among(&stages)
            && self.progress.as_ref() != Some(&stage)
        {
            self.progress = Some(stage.clone());
            let data = wire::ProgressEvent { stage, eta_s: estimate(&stages, now_ms()) };
            if let Ok(data) = serde_json::to_string(&data) {
                self.waiting.push_back(Event::default().event("progress").data(data));
            }
        }
        Ok(())
    }
}
