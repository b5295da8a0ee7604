//! The states of a job and the legal moves between them.

use std::fmt;

use serde::{Deserialize, Serialize};

/// Where a job stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JobState {
    /// It waits for its turn.
    Queued,
    /// The engine works on it.
    Running,
    /// It made at least one model.
    Succeeded,
    /// It ended without a model; the error says why.
    Failed,
    /// Somebody stopped it.
    Cancelled,
}

impl JobState {
    /// Every state.
    pub const ALL: [Self; 5] = [Self::Queued, Self::Running, Self::Succeeded, Self::Failed, Self::Cancelled];

    /// The name on the wire and in the database.
    pub fn as_str(self) -> &'static str {
        match self {
            Self::Queued => "queued",
            Self::Running => "running",
            Self::Succeeded => "succeeded",
            Self::Failed => "failed",
            Self::Cancelled => "cancelled",
        }
    }

    /// The state with this name.
    pub fn parse(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|state| state.as_str() == name)
    }

    /// The number that clients of NodeODM know the state by.
    pub fn nodeodm_code(self) -> u32 {
        match self {
            Self::Queued => 10,
            Self::Running => 20,
            Self::Failed => 30,
            Self::Succeeded => 40,
            Self::Cancelled => 50,
        }
    }

    /// Whether nothing will happen to the job any more unless somebody asks.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Succeeded | Self::Failed | Self::Cancelled)
    }

    /// Whether a job may go from here to `next`.
    pub fn may_become(self, next: Self) -> bool {
        match self {
            Self::Queued => matches!(next, Self::Running | Self::Cancelled),
            // Back to the queue when the process ends under it.
            Self::Running => matches!(next, Self::Succeeded | Self::Failed | Self::Cancelled | Self::Queued),
            // Once more, when somebody asks; taken back, it counts as cancelled.
            Self::Succeeded | Self::Failed => matches!(next, Self::Queued | Self::Cancelled),
            Self::Cancelled => next == Self::Queued,
        }
    }
}

impl fmt::Display for JobState {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.as_str())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_kept_and_what_is_over_starts_through_the_queue() {
        for state in JobState::ALL {
            assert_eq!(JobState::parse(state.as_str()), Some(state));
            assert!(!state.may_become(state));
            assert!(!state.is_final() || !state.may_become(JobState::Running), "only the queue starts a job");
            assert!(!state.is_final() || !state.may_become(JobState::Succeeded), "only a run makes models");
        }
        assert_eq!(JobState::parse("done"), None);
    }
}
