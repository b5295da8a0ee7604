//! Tells addresses of a job's changes of state: signed, in order, again and again until they answer or it is given up.
//! What is to be told stands in the database, written with the change itself, so it survives the end of the process.

mod body;
mod client;
mod target;

pub use target::{InvalidTarget, Target, is_public};

use std::time::Duration;

use futures_util::future::join_all;
use hmac::{Hmac, KeyInit, Mac};
use sha2::Sha256;
use tokio_util::sync::CancellationToken;
use uuid::Uuid;

use self::body::body;
use self::client::{Message, SendError, SystemResolver, Trust, send};
use super::{Jobs, JobsError};
use crate::config::WebhookPolicy;
use crate::store::db::webhooks::{self, Audience, DueRow, WebhookRow};
use crate::store::db::{jobs, now_ms};

/// Webhooks of one job.
const MAX_WEBHOOKS: usize = 10;
/// Letters of a secret: few are guessed, many are a mistake.
const SECRET_CHARS: std::ops::RangeInclusive<usize> = 16..=200;
/// Requests under way at once.
const PARALLEL: u32 = 16;
/// After a failure the time until the next attempt grows by this factor, up to [`LONGEST_PAUSE`].
const PAUSE_FACTOR: u32 = 3;
const LONGEST_PAUSE: Duration = Duration::from_secs(6 * 3600);
/// The table is looked into so often even if nobody says that something changed.
const IDLE_POLL: Duration = Duration::from_secs(60);
/// Between attempts to read or write the table while the database fails.
const STORE_RETRY: Duration = Duration::from_secs(2);

/// Time until the next attempt after so many.
fn pause(policy: &WebhookPolicy, attempts: u32) -> Duration {
    let factor = PAUSE_FACTOR.saturating_pow(attempts.saturating_sub(1));
    policy.first_pause.saturating_mul(factor).min(LONGEST_PAUSE)
}

/// A webhook to be.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct NewWebhook {
    target: Target,
    secret: String,
    audience: Audience,
}

impl NewWebhook {
    /// Checks an address and a secret.
    ///
    /// # Errors
    /// Why they are refused.
    pub fn parse(url: &str, secret: &str, policy: &WebhookPolicy) -> Result<Self, JobsError> {
        let target = Target::parse(url, &policy.allowed)?;
        let fits = SECRET_CHARS.contains(&secret.chars().count());
        if !fits {
            let (least, most) = (SECRET_CHARS.start(), SECRET_CHARS.end());
            return Err(JobsError::InvalidWebhook(format!("a webhook's secret has from {least} to {most} letters")));
        }
        Ok(Self { target, secret: secret.to_owned(), audience: Audience::Jobs })
    }

    /// Checks the address of a client of NodeODM, which is told of its task's end alone and unsigned.
    ///
    /// # Errors
    /// Why it is refused.
    pub fn of_task(url: &str, policy: &WebhookPolicy) -> Result<Self, JobsError> {
        let target = Target::parse(url, &policy.allowed)?;
        Ok(Self { target, secret: String::new(), audience: Audience::NodeOdm })
    }

    /// Its address.
    pub fn url(&self) -> &str {
        self.target.url().as_str()
    }

    /// The row of a webhook of this job.
    pub(super) fn row(&self, job: Uuid) -> WebhookRow {
        WebhookRow {
            id: Uuid::now_v7().to_string(),
            job_id: job.to_string(),
            url: self.target.url().to_string(),
            secret: self.secret.clone(),
            created_ms: now_ms(),
            audience: self.audience,
        }
    }
}

impl Jobs {
    /// Has an address told of a job's later changes of state.
    ///
    /// # Errors
    /// [`JobsError::InvalidWebhook`] when the job has too many, [`JobsError::JobNotFound`].
    pub async fn add_webhook(&self, job: Uuid, new: &NewWebhook) -> Result<WebhookRow, JobsError> {
        let mut tx = self.store.db.write().await?;
        jobs::find(&mut *tx, job).await?.ok_or(JobsError::JobNotFound)?;
        if webhooks::list(&mut *tx, job).await?.len() >= MAX_WEBHOOKS {
            return Err(JobsError::InvalidWebhook(format!("a job has at most {MAX_WEBHOOKS} webhooks")));
        }
        let row = new.row(job);
        webhooks::insert(&mut tx, &row).await?;
        tx.commit().await?;
        Ok(row)
    }

    /// Calls webhooks until `shutdown`.
    pub async fn call_webhooks(self, policy: WebhookPolicy, shutdown: CancellationToken) {
        let (mut changes, trust) = (self.hub.changes(), Trust::default());
        loop {
            changes.mark_unchanged();
            let pause = match self.call_due(&policy, &trust).await {
                Ok(pause) => pause,
                Err(error) => {
                    tracing::warn!(%error, "webhooks can't be called");
                    STORE_RETRY
                }
            };
            tokio::select! {
                () = tokio::time::sleep(pause) => {}
                changed = changes.changed() => if changed.is_err() { return },
                () = shutdown.cancelled() => return,
            }
        }
    }

    /// Calls every webhook that is due and tells how long to wait for the next.
    async fn call_due(&self, policy: &WebhookPolicy, trust: &Trust) -> sqlx::Result<Duration> {
        let db = &self.store.db;
        let due = webhooks::due(db.reader(), now_ms(), PARALLEL).await?;
        if due.is_empty() {
            let next = webhooks::next_due_ms(db.reader()).await?;
            let wait = next.map_or(IDLE_POLL, |next| Duration::from_millis((next - now_ms()).max(0).unsigned_abs()));
            return Ok(wait.min(IDLE_POLL));
        }
        let calls = join_all(due.iter().map(|delivery| call(policy, trust, delivery))).await;
        let mut tx = db.write().await?;
        for (due, answer) in due.into_iter().zip(calls) {
            webhooks::update_delivery(&mut tx, &after(policy, due, answer)).await?;
        }
        tx.commit().await?;
        Ok(Duration::ZERO)
    }
}

/// `t=<seconds since 1970>,v1=<HMAC-SHA256 of "<seconds>.<body>" in hexadecimal>`.
fn signature(secret: &str, seconds: i64, body: &str) -> String {
    // A key of any length is taken.
    let Ok(mut mac) = Hmac::<Sha256>::new_from_slice(secret.as_bytes()) else { return String::new() };
    mac.update(format!("{seconds}.{body}").as_bytes());
    let code: String = mac.finalize().into_bytes().iter().map(|byte| format!("{byte:02x}")).collect();
    format!("t={seconds},v1={code}")
}

async fn call(policy: &WebhookPolicy, trust: &Trust, due: &DueRow) -> Result<u16, SendError> {
    // The list of allowed addresses may have changed since it was made.
    let target = Target::parse(&due.url, &policy.allowed)?;
    let body = body(due);
    let headers = match due.audience {
        Audience::Jobs => vec![
            ("x-multistage-event", "job.state".to_owned()),
            ("x-multistage-delivery", format!("{}/{}", due.delivery.webhook_id, due.delivery.event_id)),
            ("x-multistage-signature", signature(&due.secret, jiff::Timestamp::now().as_second(), &body)),
        ],
        Audience::NodeOdm => Vec::new(),
    };
    let message = Message { headers, body };
    Ok(send(&SystemResolver, trust, &target, policy, message).await?.as_u16())
}

/// The row of a delivery after an attempt.
fn after(policy: &WebhookPolicy, due: DueRow, answer: Result<u16, SendError>) -> webhooks::DeliveryRow {
    let mut row = due.delivery;
    row.attempts += 1;
    row.last_ms = Some(now_ms());
    row.last_status = answer.as_ref().ok().map(|status| i64::from(*status));
    row.last_error = match answer {
        Ok(status) if (200..300).contains(&status) => None,
        Ok(300..400) => Some("redirects are not followed".to_owned()),
        Ok(status) => Some(format!("the answer was {status}")),
        Err(error) => Some(error.to_string()),
    };
    let attempts = u32::try_from(row.attempts).unwrap_or(u32::MAX);
    if row.last_error.is_none() {
        row.state = "delivered".to_owned();
    } else if attempts >= policy.max_attempts {
        row.state = "given_up".to_owned();
    } else {
        let pause = i64::try_from(pause(policy, attempts).as_millis()).unwrap_or(i64::MAX / 2);
        row.next_ms = now_ms() + pause;
    }
    row
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Against Python's `hmac.new(b"0123456789abcdef", b"1700000000.{}", "sha256").hexdigest()`.
    #[test]
    fn signatures_are_those_of_others() {
        let expected = "t=1700000000,v1=e4f8e2ecae2295b2ddb2f0b5584c8275e226c0ebe9b3b819e70156bb67122e3e";
        assert_eq!(signature("0123456789abcdef", 1_700_000_000, "{}"), expected);
    }

    #[test]
    fn pauses_grow_and_end_within_days() {
        let policy = WebhookPolicy::default();
        let pauses: Vec<_> = (1..policy.max_attempts).map(|attempts| pause(&policy, attempts)).collect();
        assert!(pauses.is_sorted() && pauses[0] == policy.first_pause && pauses[12] == LONGEST_PAUSE);
        let all: Duration = pauses.iter().sum();
        assert!(all > Duration::from_secs(24 * 3600) && all < Duration::from_secs(48 * 3600), "{all:?}");
    }
}
