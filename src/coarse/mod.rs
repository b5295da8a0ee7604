//! Coarse model estimation (paper, section 4): select and match the features of the largest scales, then reconstruct the
//! match graph incrementally, one model per connected component.

mod filter;
pub mod hybrid_match;
mod intrinsics;
mod mapper;
mod match_graph;
pub mod pair_selection;
pub mod selection;
mod tracks;

pub use filter::{KeepLimits, filter};
pub use intrinsics::{
    IntrinsicsOptions, PrincipalPoint, add_camera, cameras_to_share, free_intrinsics, merge_agreeing_cameras,
};
pub use mapper::{CoarseModels, MapperImage, MapperInput, MapperOptions, Unregistered, reconstruct};
pub use match_graph::MatchGraph;
pub use tracks::Tracks;
