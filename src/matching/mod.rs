//! Descriptor matching and two-view verification.
