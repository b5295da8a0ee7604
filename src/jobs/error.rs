//! Why a request about jobs is refused.

use super::JobState;
use super::queue::{MAX_NAME_CHARS, MAX_PRIORITY};
use super::webhooks::InvalidTarget;
use crate::store::StoreError;

/// Why a move was refused.
#[derive(Debug, thiserror::Error)]
pub enum JobsError {
    /// There is no such job.
    #[error("there is no such job")]
    JobNotFound,
    /// There is no such dataset.
    #[error("there is no such dataset")]
    DatasetNotFound,
    /// The dataset is empty.
    #[error("there are no photographs")]
    NoImages,
    /// The name is too long.
    #[error("a name has at most {MAX_NAME_CHARS} letters")]
    InvalidName,
    /// The priority is out of bounds.
    #[error("a priority is from -{MAX_PRIORITY} to {MAX_PRIORITY}")]
    InvalidPriority,
    /// The engine refuses the options.
    #[error("invalid options: {}", .0.join("; "))]
    InvalidOptions(Vec<String>),
    /// A webhook's address or secret is refused, or there are too many.
    #[error("{0}")]
    InvalidWebhook(String),
    /// It runs.
    #[error("the job is running; cancel it first")]
    Running,
    /// It is over.
    #[error("the job is over: {0}")]
    NotActive(JobState),
    /// It does not wait any more.
    #[error("only the priority of a waiting job can be changed; this one is {0}")]
    NotQueued(JobState),
    /// It is not over, or succeeded.
    #[error("only a failed or cancelled job can be resumed; this one is {0}")]
    NotResumable(JobState),
    /// What the store said.
    #[error(transparent)]
    Store(#[from] StoreError),
}

impl From<InvalidTarget> for JobsError {
    fn from(error: InvalidTarget) -> Self {
        Self::InvalidWebhook(error.to_string())
    }
}

impl From<sqlx::Error> for JobsError {
    fn from(error: sqlx::Error) -> Self {
        Self::Store(error.into())
    }
}
