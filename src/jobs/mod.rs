//! Jobs: states, queue, executor, recovery.
