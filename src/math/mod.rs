//! Small numerical building blocks without geometry in them.

pub mod polynomial;
mod rng;
mod union_find;

pub use rng::Rng;
pub use union_find::UnionFind;
