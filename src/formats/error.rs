//! Why a model file can't be read.

/// Why a model file can't be read.
#[derive(Debug, thiserror::Error)]
pub enum FormatError {
    /// Its bytes can't be had.
    #[error(transparent)]
    Io(#[from] std::io::Error),
    /// Its content contradicts the format.
    #[error("{file}: {message}")]
    Malformed {
        /// Which kind of file it should be.
        file: &'static str,
        /// What is wrong and where.
        message: String,
    },
    /// It is right, but uses something that is not supported here.
    #[error("{file}: {message}")]
    Unsupported {
        /// Which kind of file it is.
        file: &'static str,
        /// What it uses.
        message: String,
    },
}

impl FormatError {
    pub(super) fn malformed(file: &'static str, message: impl Into<String>) -> Self {
        Self::Malformed { file, message: message.into() }
    }
}
