//! Adding cameras to the model (paper, section 5).
