//! Multistage: photographs of a monument, site or object to camera poses and a coloured 3D point cloud, by the multistage,
//! coarse-to-fine structure from motion of Shah, Deshpande and Narayanan.
//!
//! The modules are layers; each uses only those that stand below it in this list (`tests/architecture.rs` holds them to it).
//!
//! | layer | what it is |
//! | --- | --- |
//! | [`cli`] | one file per command |
//! | [`http`] | the web service: router, problems, routes |
//! | [`jobs`] | states, queue, executor, recovery |
//! | [`config`] | settings of the process |
//! | [`pipeline`] | stage order, units of work, options, progress |
//! | [`store`] | SQLite tables and the artifact store |
//! | [`formats`] | bytes to domain types: photographs, EXIF, PLY, Bundler, COLMAP, reports |
//! | [`synthetic`] | scenes, noise, renderer; for tests, benches and the demo, never the engine |
//! | [`add_points`] | the paper's section 6 |
//! | [`add_cameras`] | the paper's section 5 |
//! | [`coarse`] | the paper's section 4 |
//! | [`bundle`] | bundle adjustment |
//! | [`matching`] | descriptor kernels, two-view verification |
//! | [`features`] | SIFT |
//! | [`ransac`], [`solvers`] | robust estimation, minimal solvers |
//! | [`scene`] | ids, features, reconstruction |
//! | [`camera`], [`geometry`], [`math`] | intrinsics, transforms, numbers |

pub mod add_cameras;
pub mod add_points;
pub mod bundle;
pub mod camera;
pub mod cli;
pub mod coarse;
pub mod config;
pub mod features;
pub mod formats;
pub mod geometry;
pub mod http;
pub mod jobs;
pub mod matching;
pub mod math;
pub mod pipeline;
pub mod ransac;
pub mod scene;
pub mod solvers;
pub mod store;
pub mod synthetic;
