//! Local and global bundle adjustment with filtering and retriangulation around them.

use std::collections::{BTreeMap, BTreeSet};

use super::{Mapper, Unregistered};
use crate::bundle::{self, BundleConfig, FreeIntrinsics};
use crate::coarse::filter::filter;
use crate::coarse::intrinsics::{enrich_cameras, focal_priors, free_intrinsics, merge_agreeing_cameras};
use crate::scene::{CameraId, ImageId, Point3dId};

impl Mapper<'_> {
    /// Adjusts the initial pair, intrinsics fixed, and filters.
    pub(super) fn adjust_pair(&mut self) {
        let config = BundleConfig::global(&self.model, FreeIntrinsics::default());
        bundle::adjust_while(&mut self.model, &config, &self.options.global_bundle, self.run.keep_going);
        self.filter(None);
    }

    /// Adjusts a new image and those that share most points with it; the other images that see their points are held.
    pub(super) fn adjust_locally(&mut self, image: ImageId) {
        let mut variable = self.neighbours(image, self.options.local_images - 1);
        variable.insert(image);
        let mut config = BundleConfig::local(variable.iter().copied());
        if variable.len() == self.model.images().len() {
            config = BundleConfig::global(&self.model, FreeIntrinsics::default());
        }
        bundle::adjust_while(&mut self.model, &config, &self.options.local_bundle, self.run.keep_going);
        self.filter(Some(&variable));
    }

    /// Adjusts everything, filters and retriangulates until little changes.
    pub(super) fn adjust_globally(&mut self) {
        for _ in 0..self.options.global_rounds {
            if !self.goes_on() {
                return;
            }
            let before = self.model.num_observations();
            let split = self.split_cameras();
            let mut config = BundleConfig::global(&self.model, FreeIntrinsics::default());
            config.intrinsics = self.free_intrinsics();
            config.focal_priors = focal_priors(&self.model, &self.options.intrinsics);
            bundle::adjust_while(&mut self.model, &config, &self.options.global_bundle, self.run.keep_going);
            let merged = merge_agreeing_cameras(&mut self.model, &self.options.intrinsics);
            let removed = self.filter(None);
            let all: Vec<usize> = (0..self.tracks.tracks.len()).collect();
            let added = self.triangulate_tracks(&all);
            let settled = ((removed + added) as f64) < self.options.global_change * before as f64;
            if settled && split == 0 && merged == 0 {
                break;
            }
        }
        self.drop_unsupported();
    }

    /// What is freed of every camera: principal points only at the end, when images that do not share a camera have been told
    /// apart. Before, a principal point may take up what is the difference of two zooms, and then it can't be told any more.
    fn free_intrinsics(&self) -> BTreeMap<CameraId, FreeIntrinsics> {
        let free = free_intrinsics(&self.model, &self.options.intrinsics).into_iter();
        free.map(|(id, free)| (id, FreeIntrinsics { principal_point: free.principal_point && self.is_whole, ..free }))
            .collect()
    }

    /// Gives every camera the model its images determine and adjusts a last time.
    pub(super) fn finish(&mut self) {
        if !self.goes_on() {
            return;
        }
        self.split_cameras_by_adjustment();
        self.is_whole = true;
        enrich_cameras(&mut self.model, &self.options.intrinsics);
        self.adjust_globally();
    }

    /// The registered images that share most points with one.
    fn neighbours(&self, image: ImageId, count: usize) -> BTreeSet<ImageId> {
        let mut shared: BTreeMap<ImageId, usize> = BTreeMap::new();
        for id in self.model.images()[&image].points().iter().flatten() {
            for seen in &self.model.point(*id).expect("a seen point exists").track {
                if seen.image != image {
                    *shared.entry(seen.image).or_insert(0) += 1;
                }
            }
        }
        let mut ranking: Vec<(ImageId, usize)> = shared.into_iter().collect();
        ranking.sort_by(|a, b| b.1.cmp(&a.1).then(a.0.cmp(&b.0)));
        ranking.into_iter().take(count).map(|(id, _)| id).collect()
    }

    /// Filters the points of these images (or all); returns the number of sightings removed.
    fn filter(&mut self, images: Option<&BTreeSet<ImageId>>) -> usize {
        let ids: Vec<Point3dId> = match images {
            None => self.model.points().map(|(id, _)| id).collect(),
            Some(images) => {
                let seen =
                    images.iter().flat_map(|image| self.model.images()[image].points().iter().flatten().copied());
                seen.collect::<BTreeSet<_>>().into_iter().collect()
            }
        };
        filter(&mut self.model, &ids, &self.options.keep_limits())
    }

    /// Takes out images that filtering left with too few points to hold their pose. Each time counts: one that is placed and
    /// taken out over and over would keep the model growing and shrinking for ever.
    fn drop_unsupported(&mut self) {
        let weak: Vec<(ImageId, usize)> = self
            .model
            .images()
            .iter()
            .map(|(&id, image)| (id, image.num_observations()))
            .filter(|&(_, observations)| observations < self.options.min_pose_inliers_relaxed)
            .collect();
        for (id, inliers) in weak {
            if self.model.images().len() > 2 {
                self.model.deregister(id);
                *self.drops.entry(id).or_insert(0) += 1;
                let visible = self.visible_points(id).len();
                self.failures.insert(id, Unregistered::PoseFailed { visible, inliers });
            }
        }
    }
}
