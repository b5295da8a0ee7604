//! Bundle adjustment.
