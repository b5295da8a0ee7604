//! SIFT features: scale space, detection, orientation, description (paper, section 3).
