//! Synthetic scenes with known truth: for tests, benches, the demo and evaluation; the engine never uses them.

mod compare;
mod layout;
mod photographer;
mod scene;
mod temple;
mod temple_solids;
mod temple_stone;

pub use compare::{ModelDifference, compare};
pub use layout::Layout;
pub use photographer::{Photographer, Picture};
pub use scene::{PairMatches, SceneOptions, SyntheticScene, generate, perturbed};
pub use temple::{Temple, TempleOptions};
