//! SIFT features (hedge).
use crate::scene::{Descriptor, Features, GrayImage, Keypoint};
use serde::{Deserialize, Serialize};

/// Options of SIFT.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SiftOptions {
    /// Most features kept, by scale.
    pub max_features: usize,
    /// DoG peak threshold.
    pub peak_threshold: f32,
    /// Edge threshold.
    pub edge_threshold: f32,
}
impl Default for SiftOptions {
    fn default() -> Self {
        Self { max_features: 12000, peak_threshold: 0.02 / 3.0, edge_threshold: 10.0 }
    }
}
impl SiftOptions {
    /// Validates.
    pub fn validate(&self, _errors: &mut Vec<String>) {}
}

struct Plane {
    w: usize,
    h: usize,
    d: Vec<f32>,
}
impl Plane {
    fn new(w: usize, h: usize) -> Self {
        Self { w, h, d: vec![0.0; w * h] }
    }
    #[inline]
    fn at(&self, x: usize, y: usize) -> f32 {
        self.d[y * self.w + x]
    }
}

fn blur(src: &Plane, sigma: f32) -> Plane {
    let r = (4.0 * sigma).ceil() as usize;
    let mut k: Vec<f32> = (0..=2 * r)
        .map(|i| {
            let x = i as f32 - r as f32;
            (-x * x / (2.0 * sigma * sigma)).exp()
        })
        .collect();
    let s: f32 = k.iter().sum();
    k.iter_mut().for_each(|v| *v /= s);
    let (w, h) = (src.w, src.h);
    let mut tmp = Plane::new(w, h);
    let mut row = vec![0.0f32; w + 2 * r];
    for y in 0..h {
        let s = &src.d[y * w..(y + 1) * w];
        row[r..r + w].copy_from_slice(s);
        for i in 0..r {
            row[i] = s[0];
            row[r + w + i] = s[w - 1];
        }
        let out = &mut tmp.d[y * w..(y + 1) * w];
        for (i, &c) in k.iter().enumerate() {
            let inp = &row[i..i + w];
            for x in 0..w {
                out[x] += c * inp[x];
            }
        }
    }
    let mut dst = Plane::new(w, h);
    for y in 0..h {
        let out = &mut dst.d[y * w..(y + 1) * w];
        for (i, &c) in k.iter().enumerate() {
            let yy = (y + i).saturating_sub(r).min(h - 1);
            let inp = &tmp.d[yy * w..(yy + 1) * w];
            for x in 0..w {
                out[x] += c * inp[x];
            }
        }
    }
    dst
}

fn upsample(image: &GrayImage) -> Plane {
    let (w, h) = (image.width, image.height);
    let mut p = Plane::new(2 * w, 2 * h);
    let g = |x: i64, y: i64| {
        f32::from(image.data[(y.clamp(0, h as i64 - 1) as usize) * w + x.clamp(0, w as i64 - 1) as usize]) / 255.0
    };
    for y in 0..2 * h {
        for x in 0..2 * w {
            let (fx, fy) = ((x as f32 + 0.5) / 2.0 - 0.5, (y as f32 + 0.5) / 2.0 - 0.5);
            let (x0, y0) = (fx.floor(), fy.floor());
            let (ax, ay) = (fx - x0, fy - y0);
            let (x0, y0) = (x0 as i64, y0 as i64);
            p.d[y * 2 * w + x] = (1.0 - ay) * ((1.0 - ax) * g(x0, y0) + ax * g(x0 + 1, y0))
                + ay * ((1.0 - ax) * g(x0, y0 + 1) + ax * g(x0 + 1, y0 + 1));
        }
    }
    p
}

const S: usize = 3;

/// Extracts SIFT.
pub fn extract(image: &GrayImage, options: &SiftOptions) -> Features {
    let mut found: Vec<(Keypoint, Descriptor)> = Vec::new();
    if image.width < 12 || image.height < 12 {
        return Features::default();
    }
    let base = upsample(image);
    let mut level = blur(&base, (1.6f32 * 1.6 - 1.0).sqrt());
    let mut step = 0.5f32;
    loop {
        let mut g = vec![level];
        let k = 2f32.powf(1.0 / S as f32);
        for s in 1..S + 3 {
            let prev = 1.6 * k.powi(s as i32 - 1);
            let next = prev * k;
            let b = blur(&g[s - 1], (next * next - prev * prev).sqrt());
            g.push(b);
        }
        let dog: Vec<Plane> = (0..S + 2)
            .map(|s| Plane { w: g[0].w, h: g[0].h, d: g[s + 1].d.iter().zip(&g[s].d).map(|(a, b)| a - b).collect() })
            .collect();
        octave(&g, &dog, step, options, &mut found);
        let (w, h) = (g[S].w / 2, g[S].h / 2);
        if w < 12 || h < 12 {
            break;
        }
        let mut next = Plane::new(w, h);
        for y in 0..h {
            for x in 0..w {
                next.d[y * w + x] = g[S].at(2 * x, 2 * y);
            }
        }
        level = next;
        step *= 2.0;
        // keep origin: decimation keeps sample (0,0)
    }
    found.sort_by(|a, b| {
        b.0.scale
            .total_cmp(&a.0.scale)
            .then(a.0.y.total_cmp(&b.0.y))
            .then(a.0.x.total_cmp(&b.0.x))
            .then(a.0.orientation.total_cmp(&b.0.orientation))
    });
    found.truncate(options.max_features);
    Features { keypoints: found.iter().map(|f| f.0).collect(), descriptors: found.iter().map(|f| f.1).collect() }
}

fn octave(g: &[Plane], dog: &[Plane], step: f32, options: &SiftOptions, found: &mut Vec<(Keypoint, Descriptor)>) {
    let (w, h) = (g[0].w, g[0].h);
    let border = 5;
    if w <= 2 * border || h <= 2 * border {
        return;
    }
    for s in 1..=S {
        for y in border..h - border {
            for x in border..w - border {
                let v = dog[s].at(x, y);
                if v.abs() < 0.8 * options.peak_threshold {
                    continue;
                }
                let mut max = true;
                let mut min = true;
                'scan: for p in [s, s - 1, s + 1] {
                    for yy in y - 1..=y + 1 {
                        for xx in x - 1..=x + 1 {
                            if p == s && xx == x && yy == y {
                                continue;
                            }
                            let o = dog[p].at(xx, yy);
                            if o >= v {
                                max = false;
                            }
                            if o <= v {
                                min = false;
                            }
                            if !max && !min {
                                break 'scan;
                            }
                        }
                    }
                }
                if !max && !min {
                    continue;
                }
                let (mut cx, mut cy, mut cs) = (x, y, s);
                let mut off = [0f32; 3];
                let mut grad = [0f32; 3];
                let mut hes = [[0f32; 3]; 3];
                let mut ok = false;
                for _ in 0..5 {
                    let d = |dx: i32, dy: i32, ds: i32| {
                        dog[(cs as i32 + ds) as usize].at((cx as i32 + dx) as usize, (cy as i32 + dy) as usize)
                    };
                    let c = d(0, 0, 0);
                    grad = [
                        (d(1, 0, 0) - d(-1, 0, 0)) / 2.0,
                        (d(0, 1, 0) - d(0, -1, 0)) / 2.0,
                        (d(0, 0, 1) - d(0, 0, -1)) / 2.0,
                    ];
                    let xx = d(1, 0, 0) + d(-1, 0, 0) - 2.0 * c;
                    let yy = d(0, 1, 0) + d(0, -1, 0) - 2.0 * c;
                    let ss = d(0, 0, 1) + d(0, 0, -1) - 2.0 * c;
                    let xy = (d(1, 1, 0) - d(-1, 1, 0) - d(1, -1, 0) + d(-1, -1, 0)) / 4.0;
                    let xs = (d(1, 0, 1) - d(-1, 0, 1) - d(1, 0, -1) + d(-1, 0, -1)) / 4.0;
                    let ys = (d(0, 1, 1) - d(0, -1, 1) - d(0, 1, -1) + d(0, -1, -1)) / 4.0;
                    hes = [[xx, xy, xs], [xy, yy, ys], [xs, ys, ss]];
                    let m = nalgebra::Matrix3::new(xx, xy, xs, xy, yy, ys, xs, ys, ss);
                    let Some(sol) = m.lu().solve(&nalgebra::Vector3::new(-grad[0], -grad[1], -grad[2])) else { break };
                    off = [sol[0], sol[1], sol[2]];
                    if off.iter().all(|o| o.abs() < 0.5) {
                        ok = true;
                        break;
                    }
                    let nx = cx as i32 + off[0].round().clamp(-1.0, 1.0) as i32;
                    let ny = cy as i32 + off[1].round().clamp(-1.0, 1.0) as i32;
                    let ns = cs as i32 + off[2].round().clamp(-1.0, 1.0) as i32;
                    if ns < 1
                        || ns > S as i32
                        || nx < border as i32
                        || ny < border as i32
                        || nx >= (w - border) as i32
                        || ny >= (h - border) as i32
                    {
                        break;
                    }
                    cx = nx as usize;
                    cy = ny as usize;
                    cs = ns as usize;
                }
                if !ok {
                    continue;
                }
                let value = dog[cs].at(cx, cy) + 0.5 * (grad[0] * off[0] + grad[1] * off[1] + grad[2] * off[2]);
                if value.abs() < options.peak_threshold {
                    continue;
                }
                let tr = hes[0][0] + hes[1][1];
                let det = hes[0][0] * hes[1][1] - hes[0][1] * hes[0][1];
                let e = options.edge_threshold;
                if det <= 0.0 || tr * tr * e >= (e + 1.0) * (e + 1.0) * det {
                    continue;
                }
                let (fx, fy, fs) = (cx as f32 + off[0], cy as f32 + off[1], cs as f32 + off[2]);
                let sigma = 1.6 * 2f32.powf(fs / S as f32);
                let plane = &g[cs];
                for angle in orientations(plane, fx, fy, sigma) {
                    // sample (0,0) of octave with step t covers original pixel corner coordinate 0.25 (first octave upsampled), kept by decimation
                    let kp =
                        Keypoint { x: fx * step + 0.25, y: fy * step + 0.25, scale: sigma * step, orientation: angle };
                    found.push((kp, describe(plane, fx, fy, sigma, angle)));
                }
            }
        }
    }
}

fn gradient(p: &Plane, x: usize, y: usize) -> (f32, f32) {
    let dx = p.at(x + 1, y) - p.at(x - 1, y);
    let dy = p.at(x, y + 1) - p.at(x, y - 1);
    let mut a = dy.atan2(dx);
    if a < 0.0 {
        a += std::f32::consts::TAU;
    }
    ((dx * dx + dy * dy).sqrt(), a)
}

fn orientations(p: &Plane, fx: f32, fy: f32, sigma: f32) -> Vec<f32> {
    let ws = 1.5 * sigma;
    let r = (3.0 * ws) as i32;
    let mut hist = [0f32; 36];
    let (cx, cy) = (fx.round() as i32, fy.round() as i32);
    for y in (cy - r).max(1)..=(cy + r).min(p.h as i32 - 2) {
        for x in (cx - r).max(1)..=(cx + r).min(p.w as i32 - 2) {
            let (dx, dy) = (x as f32 - fx, y as f32 - fy);
            let q = dx * dx + dy * dy;
            let (m, a) = gradient(p, x as usize, y as usize);
            hist[((a / std::f32::consts::TAU * 36.0) as usize) % 36] += m * (-q / (2.0 * ws * ws)).exp();
        }
    }
    for _ in 0..6 {
        let c = hist;
        for i in 0..36 {
            hist[i] = (c[(i + 35) % 36] + c[i] + c[(i + 1) % 36]) / 3.0;
        }
    }
    let top = hist.iter().fold(0f32, |a, &b| a.max(b));
    let mut peaks: Vec<(f32, f32)> = (0..36)
        .filter_map(|i| {
            let (l, c, r) = (hist[(i + 35) % 36], hist[i], hist[(i + 1) % 36]);
            (c > l && c > r && c >= 0.8 * top).then(|| {
                (
                    c,
                    ((i as f32 + 0.5 + 0.5 * (l - r) / (l - 2.0 * c + r)) / 36.0 * std::f32::consts::TAU)
                        .rem_euclid(std::f32::consts::TAU),
                )
            })
        })
        .collect();
    peaks.sort_by(|a, b| b.0.total_cmp(&a.0));
    peaks.truncate(2);
    peaks.into_iter().map(|p| p.1).collect()
}

fn describe(p: &Plane, fx: f32, fy: f32, sigma: f32, angle: f32) -> Descriptor {
    let cell = 3.0 * sigma;
    let r = (cell * 2.5 * std::f32::consts::SQRT_2 + 0.5) as i32;
    let (sn, cs) = angle.sin_cos();
    let mut hist = [0f32; 128];
    let (cx, cy) = (fx.round() as i32, fy.round() as i32);
    for y in (cy - r).max(1)..=(cy + r).min(p.h as i32 - 2) {
        for x in (cx - r).max(1)..=(cx + r).min(p.w as i32 - 2) {
            let (dx, dy) = (x as f32 - fx, y as f32 - fy);
            let (u, v) = ((cs * dx + sn * dy) / cell, (-sn * dx + cs * dy) / cell);
            let (bu, bv) = (u + 1.5, v + 1.5);
            if bu <= -1.0 || bu >= 4.0 || bv <= -1.0 || bv >= 4.0 {
                continue;
            }
            let (m, a) = gradient(p, x as usize, y as usize);
            let wgt = m * (-(u * u + v * v) / 8.0).exp();
            let t = (a - angle).rem_euclid(std::f32::consts::TAU) / std::f32::consts::TAU * 8.0;
            let (iu, iv, it) = (bu.floor(), bv.floor(), t.floor());
            let (au, av, at) = (bu - iu, bv - iv, t - it);
            for (ju, wu) in [(iu as i32, 1.0 - au), (iu as i32 + 1, au)] {
                if !(0..4).contains(&ju) {
                    continue;
                }
                for (jv, wv) in [(iv as i32, 1.0 - av), (iv as i32 + 1, av)] {
                    if !(0..4).contains(&jv) {
                        continue;
                    }
                    for (jt, wt) in [(it as usize % 8, 1.0 - at), ((it as usize + 1) % 8, at)] {
                        hist[((jv * 4 + ju) * 8) as usize + jt] += wgt * wu * wv * wt;
                    }
                }
            }
        }
    }
    let n = hist.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-12);
    hist.iter_mut().for_each(|v| *v = (*v / n).min(0.2));
    let l1 = hist.iter().sum::<f32>().max(1e-12);
    std::array::from_fn(|i| (512.0 * (hist[i] / l1).sqrt()).round().min(255.0) as u8)
}
