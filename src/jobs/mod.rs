//! Jobs: states, queue, executor, recovery.
//!
//! The database is the only truth. Requests change it ([`Jobs`]), one executor takes jobs out of it ([`Executor`]), and
//! start-up puts it in order ([`recover`]); between them goes nothing but wake-ups ([`Hub`]).

mod again;
mod deletion;
mod ending;
mod engine;
mod error;
mod eta;
mod executor;
mod figures;
mod hub;
mod progress;
mod publish;
mod queue;
mod recovery;
mod resources;
mod retention;
mod schedule;
mod state;
pub mod view;
pub mod webhooks;

pub use engine::{Engine, PipelineEngine};
pub use error::JobsError;
pub use eta::{Eta, estimate, share_done};
pub use executor::{Executor, Tick};
pub use figures::{Figures, StageSums, Sums};
pub use hub::Hub;
pub use queue::{Jobs, MAX_NAME_CHARS, MAX_PRIORITY, NewJob, state_of};
pub use recovery::{Recovered, recover};
pub use resources::{Fit, Hold, Machine, fit};
pub use retention::{Stale, find_stale, remove_stale};
pub use schedule::QueuePlace;
pub use state::JobState;
