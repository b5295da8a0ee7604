//! Tests of the whole extraction: known blobs, invariance to turning and scaling, odd inputs, agreement of the kernels.

use std::f64::consts::TAU;

use super::*;
use crate::math::Rng;

/// A picture of Gaussian blobs on grey, sampled at pixel centres.
struct Scene {
    /// x, y, sigma, contrast.
    blobs: Vec<(f64, f64, f64, f64)>,
}

impl Scene {
    fn random(seed: u64, count: usize, side: f64, sigmas: (f64, f64)) -> Self {
        let mut rng = Rng::from_parts(&[seed]);
        let blobs = (0..count)
            .map(|_| {
                let sigma = sigmas.0 * (sigmas.1 / sigmas.0).powf(rng.uniform());
                let contrast = rng.range(15.0, 50.0) * if rng.uniform() < 0.5 { -1.0 } else { 1.0 };
                (rng.range(0.0, side), rng.range(0.0, side), sigma, contrast)
            })
            .collect();
        Self { blobs }
    }

    /// The scene under x' = scale * R(turn) * (x - from) + to.
    fn moved(&self, map: &Similarity) -> Self {
        let blobs = self.blobs.iter().map(|&(x, y, sigma, contrast)| {
            let (x, y) = map.apply(x, y);
            (x, y, sigma * map.scale, contrast)
        });
        Self { blobs: blobs.collect() }
    }

    fn render(&self, width: usize, height: usize) -> GrayImage {
        let mut data = vec![128.0_f64; width * height];
        for &(x, y, sigma, contrast) in &self.blobs {
            let reach = 4.5 * sigma;
            let rows = (y - reach).max(0.0) as usize..((y + reach).max(0.0) as usize).min(height);
            for row in rows {
                let columns = (x - reach).max(0.0) as usize..((x + reach).max(0.0) as usize).min(width);
                for column in columns {
                    let distance_sq = (column as f64 + 0.5 - x).powi(2) + (row as f64 + 0.5 - y).powi(2);
                    data[row * width + column] += contrast * (-0.5 * distance_sq / (sigma * sigma)).exp();
                }
            }
        }
        GrayImage::new(width, height, data.into_iter().map(|v| v.round().clamp(0.0, 255.0) as u8).collect())
    }
}

struct Similarity {
    scale: f64,
    turn: f64,
    from: (f64, f64),
    to: (f64, f64),
}

impl Similarity {
    fn apply(&self, x: f64, y: f64) -> (f64, f64) {
        let (sin, cos) = self.turn.sin_cos();
        let (x, y) = (x - self.from.0, y - self.from.1);
        (self.to.0 + self.scale * (cos * x - sin * y), self.to.1 + self.scale * (sin * x + cos * y))
    }
}

fn distance_sq(a: &[u8], b: &[u8]) -> i32 {
    a.iter().zip(b).map(|(&a, &b)| (i32::from(a) - i32::from(b)).pow(2)).sum()
}

/// Mutual nearest neighbours that pass the ratio test.
fn matches(a: &Features, b: &Features) -> Vec<(usize, usize)> {
    let nearest = |query: &[u8], set: &Features| {
        let (mut best, mut second, mut at) = (i32::MAX, i32::MAX, 0);
        for (i, candidate) in set.descriptors.iter().enumerate() {
            let distance = distance_sq(query, candidate);
            if distance < best {
                (second, best, at) = (best, distance, i);
            } else if distance < second {
                second = distance;
            }
        }
        (at, f64::from(best) < 0.64 * f64::from(second))
    };
    let forward = a.descriptors.iter().enumerate().filter_map(|(i, descriptor)| {
        let (j, distinct) = nearest(descriptor, b);
        (distinct && nearest(&b.descriptors[j], a).0 == i).then_some((i, j))
    });
    forward.collect()
}

#[test]
fn blobs_are_found_where_they_are() {
    // A blob of sigma b, blurred to sigma t by the scale space, answers strongest at a scale t that depends on the ratio
    // of neighbouring levels only: its difference of Gaussians 1/(b^2 + k^2 t^2) - 1/(b^2 + t^2) is extremal at
    // t^2 = b^2 / k. A blob drawn with sigma s is taken for one with b^2 = s^2 - c^2, seen by a camera of sigma c.
    let k = 2.0_f64.powf(1.0 / 3.0);
    for sigma in [1.4, 1.8, 2.6, 3.9, 5.5, 8.3] {
        let camera_sigma_px = f64::from(SiftOptions::default().camera_sigma_px);
        let expected = ((sigma * sigma - camera_sigma_px * camera_sigma_px) / k).sqrt();
        let (mut bias, mut ratio) = ((0.0, 0.0), 0.0);
        let count = 20;
        for i in 0..count {
            // Spread over the pixels of the octave, which are up to 4 wide.
            let (x, y) = (60.0 + f64::from(i) * 5.1 % 8.0, 60.0 + f64::from(i) * 3.3 % 8.0);
            let image = Scene { blobs: vec![(x, y, sigma, 90.0)] }.render(128, 128);
            let features = extract(&image, &SiftOptions::default());
            // Rounding to bytes makes small extrema of its own on a flat top; they are told apart by scale.
            let fits = |scale: f32| (0.9..1.1).contains(&(f64::from(scale) / expected));
            let found = features.keypoints.iter().filter(|keypoint| fits(keypoint.scale)).min_by(|a, b| {
                let off = |k: &&crate::scene::Keypoint| (f64::from(k.x) - x).hypot(f64::from(k.y) - y);
                off(a).total_cmp(&off(b))
            });
            let found = found.unwrap_or_else(|| panic!("no keypoint of scale {expected:.2} at {x:.2}, {y:.2}"));
            let (dx, dy) = (f64::from(found.x) - x, f64::from(found.y) - y);
            // The quadratic fit alone is off by up to 0.07 of this, midway between the pixels of the octave.
            assert!(
                dx.hypot(dy) < 0.02 * expected.max(1.6),
                "sigma {sigma} at {x:.2}, {y:.2}: off by {dx:.3}, {dy:.3}"
            );
            bias = (bias.0 + dx / f64::from(count), bias.1 + dy / f64::from(count));
            ratio += f64::from(found.scale) / expected / f64::from(count);
        }
        assert!(bias.0.hypot(bias.1) < 0.02, "sigma {sigma}: mean offset {bias:?}");
        assert!((ratio - 1.0).abs() < 0.03, "sigma {sigma}: scale {ratio:.3} of the expected");
    }
}

#[test]
fn features_follow_turns_and_scales() {
    let scene = Scene::random(3, 700, 240.0, (1.0, 7.0));
    let original = extract(&scene.render(240, 240), &SiftOptions::default());
    assert!(original.len() > 300, "only {} features", original.len());
    for (scale, turn_deg) in [(1.0, 30.0_f64), (1.0, 90.0), (1.0, 180.0), (0.8, 45.0), (1.5, -70.0), (0.5, 10.0)] {
        let map = Similarity { scale, turn: turn_deg.to_radians(), from: (120.0, 120.0), to: (201.3, 199.6) };
        let moved = extract(&scene.moved(&map).render(400, 400), &SiftOptions::default());
        let pairs = matches(&original, &moved);
        let (mut right, mut turned, mut scaled) = (0, 0, 0);
        let mut bias = (0.0, 0.0);
        for &(i, j) in &pairs {
            let (a, b) = (original.keypoints[i], moved.keypoints[j]);
            let (x, y) = map.apply(f64::from(a.x), f64::from(a.y));
            let (dx, dy) = (f64::from(b.x) - x, f64::from(b.y) - y);
            if dx.hypot(dy) < 1.0 * scale.max(1.0) {
                right += 1;
                bias = (bias.0 + dx, bias.1 + dy);
                let turn = (f64::from(b.orientation - a.orientation) - map.turn).rem_euclid(TAU);
                turned += usize::from(turn.min(TAU - turn) < 0.2);
                let ratio = f64::from(b.scale / a.scale) / scale;
                scaled += usize::from((0.87..1.15).contains(&ratio));
            }
        }
        let name = format!("scale {scale}, {turn_deg} degrees: {right} of {} right of {}", pairs.len(), original.len());
        assert!(10 * right > 9 * pairs.len(), "{name}");
        assert!(right as f64 > 0.35 * scale.min(1.0) * original.len() as f64, "{name}");
        assert!(10 * turned > 9 * right && 20 * scaled > 19 * right, "{name}: {turned} turned, {scaled} scaled");
        let bias = (bias.0 / right as f64).hypot(bias.1 / right as f64);
        assert!(bias < 0.05, "{name}: mean offset {bias:.3}");
    }
}

#[test]
fn all_instruction_sets_agree() {
    let image = Scene::random(5, 400, 200.0, (0.8, 9.0)).render(203, 157);
    let portable = extract_with(Isa::available()[0], &image, &SiftOptions::default(), &|_, _| true);
    assert!(portable.len() > 200);
    for &isa in &Isa::available()[1..] {
        let other = extract_with(isa, &image, &SiftOptions::default(), &|_, _| true);
        let mut twins = 0;
        for (a, descriptor) in portable.keypoints.iter().zip(&portable.descriptors) {
            twins += usize::from(other.keypoints.iter().zip(&other.descriptors).any(|(b, twin)| {
                (a.x - b.x).hypot(a.y - b.y) < 0.01
                    && (a.orientation - b.orientation).abs() < 0.01
                    && distance_sq(descriptor, twin) < 200
            }));
        }
        assert!(100 * twins >= 99 * portable.len(), "{isa:?}: {twins} of {}", portable.len());
    }
}

#[test]
fn odd_images_give_no_panic() {
    for (width, height) in [(0, 0), (1, 1), (8, 3), (3, 8), (1, 200), (16, 16), (33, 5), (5, 33), (64, 9)] {
        let data = (0..width * height).map(|i| (i * 7919 % 256) as u8).collect();
        let features = extract(&GrayImage::new(width, height, data), &SiftOptions::default());
        for keypoint in &features.keypoints {
            assert!(
                keypoint.x >= 0.0 && keypoint.x <= width as f32 && keypoint.y >= 0.0 && keypoint.y <= height as f32
            );
        }
    }
    let flat = GrayImage::new(90, 70, vec![200; 90 * 70]);
    assert!(extract(&flat, &SiftOptions::default()).is_empty());
}

#[test]
fn output_is_sorted_capped_and_repeatable() {
    let image = Scene::random(9, 600, 200.0, (0.8, 9.0)).render(200, 200);
    let all = extract(&image, &SiftOptions::default());
    assert_eq!(all, extract(&image, &SiftOptions::default()));
    assert_eq!(all.keypoints.len(), all.descriptors.len());
    let key = |k: &crate::scene::Keypoint| (-k.scale, k.y, k.x, k.orientation);
    assert!(all.keypoints.windows(2).all(|pair| key(&pair[0]) < key(&pair[1])));
    let distinct = extract(&image, &SiftOptions { faint_up_to: 0, ..SiftOptions::default() });
    let capped = extract(&image, &SiftOptions { max_features: 100, ..SiftOptions::default() });
    assert_eq!(capped.keypoints, distinct.keypoints[..100]);
    assert_eq!(capped.descriptors, distinct.descriptors[..100]);
    for keypoint in &all.keypoints {
        assert!((0.0..std::f32::consts::TAU).contains(&keypoint.orientation));
    }
    for descriptor in &all.descriptors {
        let norm = f64::from(distance_sq(descriptor, &[0; 128])).sqrt();
        assert!((500.0..524.0).contains(&norm), "norm {norm}");
    }
}

#[test]
fn levels_that_the_forecast_passes_cost_hardly_a_feature() {
    let image = Scene::random(12, 6000, 500.0, (0.5, 4.0)).render(500, 500);
    let options = SiftOptions { faint_up_to: 0, ..SiftOptions::default() };
    let all = extract(&image, &options);
    for share in [0.3, 0.5, 0.8] {
        let max_features = (share * all.keypoints.len() as f64) as usize;
        let capped = extract(&image, &SiftOptions { max_features, ..options.clone() });
        let mut kept = 0;
        for (keypoint, descriptor) in capped.keypoints.iter().zip(&capped.descriptors) {
            // None where the search without a cap lets the fit go to a level that was passed.
            let Some(at) = all.keypoints.iter().position(|other| other == keypoint) else { continue };
            assert_eq!(*descriptor, all.descriptors[at], "of {keypoint:?}");
            kept += usize::from(at < max_features);
        }
        assert!(kept as f64 >= 0.98 * max_features as f64, "{kept} of {max_features}");
    }
}

#[test]
fn faint_features_make_up_the_number_and_no_more() {
    let mut image = Scene::random(9, 600, 300.0, (0.8, 9.0)).render(300, 300);
    let mut rng = Rng::from_parts(&[10]);
    for value in &mut image.data {
        *value = value.saturating_add((rng.uniform() * 3.0) as u8);
    }
    let options = SiftOptions::default();
    let only = |faint_up_to| extract(&image, &SiftOptions { faint_up_to, ..options.clone() }).keypoints;
    let distinct = only(0);
    let all = extract(&image, &SiftOptions { peak_threshold: options.faint_threshold, ..options.clone() }).keypoints;
    assert!(distinct.len() > 300 && all.len() > distinct.len() + 300, "{} {}", distinct.len(), all.len());
    let faint: Vec<_> = all.iter().filter(|found| !distinct.contains(found)).collect();
    for more in [1, 50, 200, 300] {
        let with_faint = only(distinct.len() + more);
        assert_eq!(with_faint.len(), distinct.len() + more);
        let taken: Vec<_> = with_faint.iter().filter(|found| !distinct.contains(found)).collect();
        assert_eq!(taken, faint[..more], "{more} more");
    }
    assert_eq!(only(distinct.len()), distinct);
    assert_eq!(only(100), distinct);
}

#[test]
fn masked_places_give_no_features_and_leave_the_limit_to_others() {
    let image = Scene::random(9, 600, 200.0, (0.8, 9.0)).render(200, 200);
    let right = |x: f32, _: f32| x >= 100.0;
    let all = extract(&image, &SiftOptions::default());
    let kept: Vec<_> = all.keypoints.iter().copied().filter(|k| right(k.x, k.y)).collect();
    assert!(kept.len() > 100 && kept.len() < all.len());
    assert_eq!(extract_where(&image, &SiftOptions::default(), &right).keypoints, kept);
    let few = SiftOptions { max_features: 50, ..SiftOptions::default() };
    assert_eq!(extract_where(&image, &few, &right).keypoints, kept[..50]);
}

#[test]
fn the_limit_grows_with_the_image_between_bounds() {
    let options = SiftOptions::default();
    assert_eq!(options.limit(640, 480), 12_000);
    assert_eq!(options.limit(1000, 1500), 24_000);
    assert_eq!(options.limit(4000, 3000), 26_624);
    assert_eq!(SiftOptions { max_features: 100, ..options }.limit(640, 480), 100);
}

#[test]
fn default_options_are_valid() {
    let mut errors = Vec::new();
    SiftOptions::default().validate(&mut errors);
    assert!(errors.is_empty(), "{errors:?}");
    SiftOptions { first_octave: 3, max_features: 0, ..SiftOptions::default() }.validate(&mut errors);
    assert_eq!(errors.len(), 2);
}
