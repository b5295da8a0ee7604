//! Coarse model estimation (paper, section 4): select and match the features of the largest scales, cut pairs that join
//! look-alike places out of the match graph, then reconstruct it incrementally, one model per connected component.

mod filter;
pub mod hybrid_match;
mod intrinsics;
pub mod look_alikes;
mod mapper;
mod match_graph;
pub mod pair_selection;
pub mod rotation_cycles;
pub mod selection;
mod tracks;

pub use filter::{KeepLimits, filter};
pub use intrinsics::{
    IntrinsicsOptions, PrincipalPoint, add_camera, cameras_to_share, focal_priors, free_intrinsics,
    merge_agreeing_cameras,
};
pub use mapper::{
    Checkpoint, Checkpoints, CoarseModels, MapperImage, MapperInput, MapperOptions, MapperRun, Unregistered,
    reconstruct,
};
pub use match_graph::MatchGraph;
pub use tracks::Tracks;
