//! Robust estimation: a loop that knows no geometry, and its estimators.
