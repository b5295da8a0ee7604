//! Small numerical building blocks without geometry in them.

mod grouped;
pub mod polynomial;
mod rng;
mod robust_loss;
mod so3;
mod union_find;

pub use grouped::Grouped;
pub use rng::Rng;
pub use robust_loss::RobustLoss;
pub use so3::skew;
pub use union_find::UnionFind;
