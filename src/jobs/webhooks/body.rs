//! What a webhook is told.

use serde_json::{Value, json};

use crate::jobs::JobState;
use crate::store::db::webhooks::{Audience, DueRow};

/// The body of a delivery.
pub(super) fn body(due: &DueRow) -> String {
    let event: Value = serde_json::from_str(&due.data).unwrap_or_default();
    match due.audience {
        Audience::Jobs => json!({
            "webhook_id": due.delivery.webhook_id,
            "event_id": due.delivery.event_id,
            "job_id": due.job_id,
            "name": due.job_name,
            "state": event["state"],
            "at": event["at"],
            "error": event["error"],
        }),
        Audience::NodeOdm => task(due, &event),
    }
    .to_string()
}

/// A task as NodeODM tells of it; options, which the receiver can ask for, are left out.
fn task(due: &DueRow, event: &Value) -> Value {
    let state = event["state"].as_str().and_then(JobState::parse);
    let mut status = json!({ "code": state.map(JobState::nodeodm_code) });
    if let Some(message) = event["error"]["message"].as_str() {
        status["errorMessage"] = message.into();
    }
    let processing_ms = match (due.started_ms, due.finished_ms) {
        (Some(started), Some(finished)) => (finished - started).max(0),
        _ => -1,
    };
    json!({
        "uuid": due.job_id,
        "name": due.job_name,
        "dateCreated": due.created_ms,
        "processingTime": processing_ms,
        "status": status,
        "options": [],
        "imagesCount": due.images,
        "progress": if state == Some(JobState::Succeeded) { 100 } else { 0 },
    })
}
