//! Why a run ended without a result.

use std::path::PathBuf;

use super::Stage;

/// Why a run ended without a result. That photographs gave no model is no error: the report says why.
#[derive(Debug, thiserror::Error)]
pub enum PipelineError {
    /// Somebody asked the run to stop.
    #[error("the run was cancelled")]
    Cancelled,
    /// The options contradict themselves; every violation is listed.
    #[error("invalid options: {}", .0.join("; "))]
    InvalidOptions(Vec<String>),
    /// The input folder can't be used as a whole.
    #[error("the input {path} can't be used: {message}")]
    InvalidInput {
        /// The folder.
        path: PathBuf,
        /// What is wrong.
        message: String,
    },
    /// A file could not be read or written.
    #[error("{stage}: {path}: {source}", stage = .stage.name(), path = .path.display())]
    Io {
        /// During which stage.
        stage: Stage,
        /// Which file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

impl PipelineError {
    /// A stable, machine-readable code.
    pub fn code(&self) -> &'static str {
        match self {
            Self::Cancelled => "cancelled",
            Self::InvalidOptions(_) => "invalid_options",
            Self::InvalidInput { .. } => "invalid_input",
            Self::Io { source, .. } if source.kind() == std::io::ErrorKind::StorageFull => "disk_full",
            Self::Io { source, .. } if source.kind() == std::io::ErrorKind::QuotaExceeded => "disk_full",
            Self::Io { source, .. } if source.raw_os_error() == Some(rustix::io::Errno::IO.raw_os_error()) => {
                "disk_error"
            }
            Self::Io { .. } => "io_error",
        }
    }
}
