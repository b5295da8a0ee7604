//! Adding points to the model (paper, section 6).
