//! The normal equations with the points eliminated: one pass over the sightings, without storing a Jacobian.
//!
//! Partition the unknowns into cameras `c` (poses and intrinsics) and points `p`. One Gauss-Newton step of the weighted problem
//! with damping solves
//!
//!   [ U  W ] [dc]     [gc]
//!   [ W' V ] [dp] = - [gp]
//!
//! where `V` is block diagonal with a 3x3 block per point. With `V = L L'` and, per point, `Z = L^-1 W'` (three rows)
//! and `z = L^-1 gp`, eliminating the points leaves the reduced camera system (Brown, 1958; Triggs, McLauchlan,
//! Hartley, Fitzgibbon, "Bundle adjustment: a modern synthesis", 1999, section 6)
//!
//!   S dc = -b,    S = U - sum Z' Z,    b = gc - sum Z' z.
//!
//! For a sighting with `y = R X`, `x = y + t`, error `e` and weight `w` (the derivative of the robust loss), everything follows
//! from `J`, the derivative of the pixel by `x`, because the derivative of `x` by the step `(omega, v)` of the pose is
//! `[-[y]_x | I]` and by `X` is `R`. With `A = w J'J` and `q = w J'e`:
//!
//!   U(v, v) = A          U(omega, v) = [y]_x A       U(omega, omega) = [y]_x A [y]_x'
//!   g(v) = q             g(omega) = y x q            V += R'A R,  gp += R'q
//!   Z(v) = L^-1 R'A      Z(omega): each row n of Z(v) becomes y x n
//!
//! A camera shared by several images of a point enters `Z` once, with the sum of its blocks: the cost of shared intrinsics
//! is linear in the length of a track.

use nalgebra::Vector3;

use super::pattern::{Part, Pattern};
use super::point_block::PointBlock;
use super::problem::{POSE, Problem, State};
use crate::camera::MAX_PARAMS;
use crate::math::RobustLoss;

/// Depth, in scene units, below which a point counts as behind the camera.
pub(super) const MIN_DEPTH: f64 = 1e-9;

/// What a sighting keeps between the two loops over a point's sightings.
struct Terms {
    a: [f64; 6],
    y: [f64; 3],
    pose: u32,
}

/// The sums of one part of the points, and its scratch.
#[derive(Default)]
pub(super) struct PartialSums {
    /// `S` as [`Pattern`] stores it, without damping of the cameras.
    pub values: Vec<f64>,
    /// `gc`.
    pub gradient: Vec<f64>,
    /// `b`.
    pub reduced_gradient: Vec<f64>,
    /// Diagonal of `U`.
    pub diagonal: Vec<f64>,
    /// Half the sum of losses.
    pub cost: f64,
    /// Largest entry of `gp`.
    pub max_point_gradient: f64,
    terms: Vec<Terms>,
    z: [Vec<f64>; 3],
    /// Slot and first column in `z` of each block of the point.
    blocks: Vec<(u32, u32)>,
}

impl PartialSums {
    /// Zeroes the sums, allocating them the first time.
    fn reset(&mut self, pattern: &Pattern, num_unknowns: usize) {
        for (sums, len) in [
            (&mut self.values, pattern.num_values),
            (&mut self.gradient, num_unknowns),
            (&mut self.reduced_gradient, num_unknowns),
            (&mut self.diagonal, num_unknowns),
        ] {
            sums.clear();
            sums.resize(len, 0.0);
        }
        self.cost = 0.0;
        self.max_point_gradient = 0.0;
    }

    /// Adds the sums of another part.
    pub fn add(&mut self, other: &Self) {
        for (sums, others) in [
            (&mut self.values, &other.values),
            (&mut self.gradient, &other.gradient),
            (&mut self.reduced_gradient, &other.reduced_gradient),
            (&mut self.diagonal, &other.diagonal),
        ] {
            for (sum, other) in sums.iter_mut().zip(others) {
                *sum += other;
            }
        }
        self.cost += other.cost;
        self.max_point_gradient = self.max_point_gradient.max(other.max_point_gradient);
    }

    /// Sums up the points of a part at `state`, with the points' blocks damped by `damping`.
    pub fn eliminate(
        &mut self,
        problem: &Problem,
        pattern: &Pattern,
        part: &Part,
        state: &State,
        loss: RobustLoss,
        damping: f64,
    ) {
        self.reset(pattern, problem.num_unknowns);
        let mut pairs = &pattern.pairs[part.first_pair..];
        for point in part.first_point..part.end_point {
            let block = self.add_point(problem, pattern, state, loss, point);
            if !problem.point_is_variable[point] {
                continue;
            }
            self.max_point_gradient = block.gradient.iter().fold(self.max_point_gradient, |max, g| max.max(g.abs()));
            let count = self.blocks.len() * (self.blocks.len() + 1) / 2;
            let (own, rest) = pairs.split_at(count);
            pairs = rest;
            if let Some(inverse) = block.damped(damping).inverse_factor() {
                self.finish_z(problem, state, &inverse);
                self.subtract_products(problem, pattern, own, &inverse.apply(&block.gradient));
            }
        }
    }

    /// First loop over a point's sightings: `U`, `gc`, `V`, `gp`, and the sums `W'` of cameras, left in `z`.
    fn add_point(
        &mut self,
        problem: &Problem,
        pattern: &Pattern,
        state: &State,
        loss: RobustLoss,
        point: usize,
    ) -> PointBlock {
        let mut block = PointBlock::default();
        let sightings =
            &problem.sightings[problem.point_start[point] as usize..problem.point_start[point + 1] as usize];
        self.lay_out_blocks(problem, point);
        self.terms.clear();
        let x_in_world = state.points[point];
        for seen in sightings {
            let pose = &problem.poses[seen.pose as usize];
            let rotation = &state.rotations[seen.pose as usize];
            let camera = &problem.cameras[pose.camera as usize];
            let y = rotate(rotation, &x_in_world);
            let t = &state.poses[seen.pose as usize].translation;
            let x_in_cam = [y[0] + t.x, y[1] + t.y, y[2] + t.z];
            if x_in_cam[2] < MIN_DEPTH {
                self.cost += 0.5 * loss.evaluate(camera.behind_sq).0;
                self.terms.push(Terms { a: [0.0; 6], y, pose: seen.pose });
                continue;
            }
            let lens = &state.lenses[pose.camera as usize];
            let here = lens.linearise(&x_in_cam);
            let e = [here.pixel[0] - seen.pixel[0], here.pixel[1] - seen.pixel[1]];
            let (rho, w) = loss.evaluate(e[0] * e[0] + e[1] * e[1]);
            self.cost += 0.5 * rho;
            let [j0, j1] = here.by_point;
            let a = [
                w * (j0[0] * j0[0] + j1[0] * j1[0]),
                w * (j0[0] * j0[1] + j1[0] * j1[1]),
                w * (j0[0] * j0[2] + j1[0] * j1[2]),
                w * (j0[1] * j0[1] + j1[1] * j1[1]),
                w * (j0[1] * j0[2] + j1[1] * j1[2]),
                w * (j0[2] * j0[2] + j1[2] * j1[2]),
            ];
            let q: [f64; 3] = std::array::from_fn(|k| w * (j0[k] * e[0] + j1[k] * e[1]));
            block.add(rotation, &a, &q);
            if let Some(slot) = pose.slot {
                self.add_pose(pattern, slot as usize, problem.slots[slot as usize].first, &a, &q, &y);
            }
            if let Some(slot) = camera.slot {
                let first = problem.slots[slot as usize].first;
                let free = camera.free.len();
                let mut columns = [[0.0; 2]; MAX_PARAMS];
                for (column, &(_, kind)) in columns.iter_mut().zip(&camera.free) {
                    *column = here.by_parameter(lens, kind);
                }
                let (diagonal, stride) = (pattern.diagonal[slot as usize], pattern.stride[slot as usize]);
                let at = self.blocks.iter().rposition(|&(other, _)| other == slot).expect("the camera is laid out");
                let z_first = self.blocks[at].1 as usize;
                for (k, column) in columns[..free].iter().enumerate() {
                    for (row, other) in columns[k..free].iter().enumerate() {
                        self.values[diagonal + k * stride + k + row] +=
                            w * (column[0] * other[0] + column[1] * other[1]);
                    }
                    self.diagonal[first + k] += w * (column[0] * column[0] + column[1] * column[1]);
                    self.gradient[first + k] += w * (column[0] * e[0] + column[1] * e[1]);
                    let c: [f64; 3] = std::array::from_fn(|i| w * (j0[i] * column[0] + j1[i] * column[1]));
                    for (i, z) in self.z.iter_mut().enumerate() {
                        z[z_first + k] += rotation[0][i] * c[0] + rotation[1][i] * c[1] + rotation[2][i] * c[2];
                    }
                    if let Some(pose_slot) = pose.slot {
                        let joint = &mut self.values[pattern.pose_camera[seen.pose as usize] + k..];
                        let stride = pattern.stride[pose_slot as usize];
                        let turned = cross(&y, &c);
                        for i in 0..3 {
                            joint[i * stride] += turned[i];
                            joint[(3 + i) * stride] += c[i];
                        }
                    }
                }
            }
            self.terms.push(Terms { a, y, pose: seen.pose });
        }
        block
    }

    /// Lists the point's blocks, poses first, and clears the columns of cameras in `z`.
    fn lay_out_blocks(&mut self, problem: &Problem, point: usize) {
        let sightings =
            &problem.sightings[problem.point_start[point] as usize..problem.point_start[point + 1] as usize];
        self.blocks.clear();
        let mut width = 0;
        for slot in sightings.iter().filter_map(|seen| problem.poses[seen.pose as usize].slot) {
            self.blocks.push((slot, width));
            width += POSE as u32;
        }
        let num_poses = self.blocks.len();
        for seen in sightings {
            let camera = problem.poses[seen.pose as usize].camera;
            let Some(slot) = problem.cameras[camera as usize].slot else { continue };
            let at = num_poses + self.blocks[num_poses..].partition_point(|&(other, _)| other < slot);
            if self.blocks.get(at).is_none_or(|&(other, _)| other != slot) {
                self.blocks.insert(at, (slot, 0));
            }
        }
        for (slot, first) in &mut self.blocks[num_poses..] {
            *first = width;
            width += problem.slots[*slot as usize].len as u32;
        }
        for z in &mut self.z {
            z.clear();
            z.resize(width as usize, 0.0);
        }
    }

    fn add_pose(&mut self, pattern: &Pattern, slot: usize, first: usize, a: &[f64; 6], q: &[f64; 3], y: &[f64; 3]) {
        let stride = pattern.stride[slot];
        let values = &mut self.values[pattern.diagonal[slot]..];
        let rows = [[a[0], a[1], a[2]], [a[1], a[3], a[4]], [a[2], a[4], a[5]]];
        // Column i of `[y]_x A`, as `A` is symmetric; row i of the block (v, omega).
        let b = [cross(y, &rows[0]), cross(y, &rows[1]), cross(y, &rows[2])];
        for i in 0..3 {
            let row_of_b = [b[0][i], b[1][i], b[2][i]];
            let turned = cross(y, &row_of_b);
            for j in 0..=i {
                values[j * stride + i] += turned[j];
                values[(3 + j) * stride + 3 + i] += rows[i][j];
            }
            for j in 0..3 {
                values[j * stride + 3 + i] += b[i][j];
            }
            self.diagonal[first + i] += turned[i];
            self.diagonal[first + 3 + i] += rows[i][i];
        }
        let turn = cross(y, q);
        for i in 0..3 {
            self.gradient[first + i] += turn[i];
            self.gradient[first + 3 + i] += q[i];
        }
    }

    /// Second loop: `Z = L^-1 W'`.
    fn finish_z(&mut self, problem: &Problem, state: &State, inverse: &super::point_block::InverseFactor) {
        let [z0, z1, z2] = &mut self.z;
        let mut column = 0;
        for terms in self.terms.iter().filter(|terms| problem.poses[terms.pose as usize].slot.is_some()) {
            let m = inverse.times_transposed(&state.rotations[terms.pose as usize]);
            let a = &terms.a;
            for (z, m) in [&mut *z0, &mut *z1, &mut *z2].into_iter().zip(&m) {
                let n = [
                    m[0] * a[0] + m[1] * a[1] + m[2] * a[2],
                    m[0] * a[1] + m[1] * a[3] + m[2] * a[4],
                    m[0] * a[2] + m[1] * a[4] + m[2] * a[5],
                ];
                let turned = cross(&terms.y, &n);
                z[column..column + 3].copy_from_slice(&turned);
                z[column + 3..column + POSE].copy_from_slice(&n);
            }
            column += POSE;
        }
        for at in column..z0.len() {
            let product = inverse.apply(&[z0[at], z1[at], z2[at]]);
            (z0[at], z1[at], z2[at]) = (product[0], product[1], product[2]);
        }
    }

    /// `S -= Z' Z` and `b -= Z' z`.
    fn subtract_products(&mut self, problem: &Problem, pattern: &Pattern, pairs: &[u32], z: &[f64; 3]) {
        let [z0, z1, z2] = &self.z;
        let mut pairs = pairs.iter();
        for (at, &(slot, column)) in self.blocks.iter().enumerate() {
            let block = problem.slots[slot as usize];
            let stride = pattern.stride[slot as usize];
            let columns = column as usize..column as usize + block.len;
            let (c0, c1, c2) = (&z0[columns.clone()], &z1[columns.clone()], &z2[columns]);
            for k in 0..block.len {
                self.reduced_gradient[block.first + k] -= c0[k] * z[0] + c1[k] * z[1] + c2[k] * z[2];
            }
            for (&(row_slot, row), &position) in self.blocks[at..].iter().zip(&mut pairs) {
                let rows = row as usize..row as usize + problem.slots[row_slot as usize].len;
                let (r0, r1, r2) = (&z0[rows.clone()], &z1[rows.clone()], &z2[rows]);
                let out = &mut self.values[position as usize..];
                if let (Ok(r0), Ok(r1), Ok(r2)) = (r0.try_into(), r1.try_into(), r2.try_into()) {
                    subtract_pose_rows(out, stride, [c0, c1, c2], [r0, r1, r2]);
                } else {
                    for k in 0..block.len {
                        let column = &mut out[k * stride..k * stride + r0.len()];
                        for (i, value) in column.iter_mut().enumerate() {
                            *value -= c0[k] * r0[i] + c1[k] * r1[i] + c2[k] * r2[i];
                        }
                    }
                }
            }
        }
    }
}

/// The product of three-row blocks, the rows being a pose's. All of it is copied first: of what is behind references the
/// compiler does not see that writing leaves it as it is, and computes one entry after the other.
#[inline(always)]
fn subtract_pose_rows(out: &mut [f64], stride: usize, columns: [&[f64]; 3], rows: [&[f64; POSE]; 3]) {
    let [r0, r1, r2] = rows.map(|row| *row);
    for k in 0..columns[0].len() {
        let (a, b, c) = (columns[0][k], columns[1][k], columns[2][k]);
        let column: &mut [f64; POSE] =
            (&mut out[k * stride..k * stride + POSE]).try_into().expect("the slice has this length");
        let mut sums = *column;
        for i in 0..POSE {
            sums[i] -= a * r0[i] + b * r1[i] + c * r2[i];
        }
        *column = sums;
    }
}

/// `R x`.
#[inline(always)]
pub(super) fn rotate(rotation: &[[f64; 3]; 3], x: &[f64; 3]) -> [f64; 3] {
    std::array::from_fn(|row| rotation[row][0] * x[0] + rotation[row][1] * x[1] + rotation[row][2] * x[2])
}

/// `v x w`.
#[inline(always)]
pub(super) fn cross(v: &[f64; 3], w: &[f64; 3]) -> [f64; 3] {
    let product = Vector3::from(*v).cross(&Vector3::from(*w));
    [product.x, product.y, product.z]
}
