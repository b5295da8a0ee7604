//! Synthetic scenes with known truth: for tests, benches, the demo and evaluation; the engine never uses them.
