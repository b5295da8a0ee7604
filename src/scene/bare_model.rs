//! A model without the positions of its keypoints: what is kept of one that still grows.

use std::borrow::Cow;
use std::collections::BTreeMap;
use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::{ApartImages, CameraId, ImageId, Observation, Point3d, Reconstruction};
use crate::camera::{Camera, Pixel};
use crate::geometry::Rigid3;

/// All of a model but the positions of keypoints, which are most of its bytes while it grows and never change.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct BareModel<'a> {
    cameras: Cow<'a, BTreeMap<CameraId, Camera>>,
    apart: Cow<'a, ApartImages>,
    images: Vec<(ImageId, CameraId, Rigid3)>,
    /// By id, gaps included, so that ids stay what they are.
    points: Cow<'a, [Option<Point3d>]>,
}

impl<'a> BareModel<'a> {
    /// That of `model`.
    pub fn of(model: &'a Reconstruction) -> Self {
        Self {
            cameras: Cow::Borrowed(&model.cameras),
            apart: Cow::Borrowed(&model.apart),
            images: model.images().iter().map(|(&id, image)| (id, image.camera, image.cam_from_world)).collect(),
            points: Cow::Borrowed(&model.points),
        }
    }

    /// Ids of its images.
    pub fn image_ids(&self) -> impl Iterator<Item = ImageId> {
        self.images.iter().map(|&(id, ..)| id)
    }

    /// The whole model, with the positions that `keypoints` gives for each image; none where they are not those it was
    /// made with.
    pub fn complete(self, keypoints: &dyn Fn(ImageId) -> Option<Arc<[Pixel]>>) -> Option<Reconstruction> {
        let mut model = Reconstruction::new(self.cameras.into_owned());
        model.apart = self.apart.into_owned();
        for (id, camera, cam_from_world) in self.images {
            if !model.cameras.contains_key(&camera) || model.image(id).is_some() {
                return None;
            }
            model.register(id, camera, cam_from_world, keypoints(id)?);
        }
        model.points = self.points.into_owned();
        model.num_points = model.points.iter().flatten().count();
        for (id, point) in (0..).map(super::Point3dId::new).zip(&model.points) {
            for &Observation { image, keypoint } in point.iter().flat_map(|point| &point.track) {
                let slot = model.images.get_mut(&image)?.points.get_mut(keypoint.index())?;
                if slot.replace(id).is_some() {
                    return None;
                }
            }
        }
        Some(model)
    }
}

#[cfg(test)]
mod tests {
    #![allow(clippy::unwrap_used)]
    use super::*;
    use crate::synthetic::{SceneOptions, generate};

    fn bytes(model: &Reconstruction) -> Vec<u8> {
        postcard::to_stdvec(model).unwrap()
    }

    #[test]
    fn a_model_comes_back_whole_or_not_at_all() {
        let mut model = generate(&SceneOptions { num_images: 6, num_points: 200, ..SceneOptions::default() }).truth;
        let gone = model.points().nth(50).unwrap().0;
        model.remove_point(gone);
        let kept = postcard::to_stdvec(&BareModel::of(&model)).unwrap();
        assert!(kept.len() < bytes(&model).len());
        let bare = || postcard::from_bytes::<BareModel<'static>>(&kept).unwrap();
        let of_model = |id| model.image(id).map(|image| image.keypoints.clone());
        let back = bare().complete(&of_model).unwrap();
        back.assert_consistent();
        assert_eq!(bytes(&back), bytes(&model));

        let last = *model.images().keys().last().unwrap();
        assert!(bare().complete(&|id| of_model(id).filter(|_| id != last)).is_none(), "an image nobody knows");
        let fewer = |id| of_model(id).map(|keypoints| keypoints[..1].into());
        assert!(bare().complete(&fewer).is_none(), "other keypoints");
    }
}
