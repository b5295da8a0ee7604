//! Coarse model estimation (paper, section 4).
