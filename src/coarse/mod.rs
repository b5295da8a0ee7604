//! Coarse model estimation (paper, section 4).

pub mod hybrid_match;
pub mod pair_selection;
pub mod selection;
