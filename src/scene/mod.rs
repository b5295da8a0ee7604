//! What the stages pass on: ids, rasters, features, and the reconstruction (cameras, registered images, points, tracks).

mod apart;
mod bare_model;
mod features;
mod ids;
mod raster;
mod reconstruction;
pub mod world_frame;

pub use apart::ApartImages;
pub use bare_model::BareModel;
pub use features::{DESCRIPTOR_LEN, Descriptor, Features, Keypoint};
pub use ids::{CameraId, ImageId, KeypointIdx, Point3dId};
pub use raster::{GrayImage, RgbImage};
pub use reconstruction::{Observation, Point3d, Reconstruction, RegisteredImage};
