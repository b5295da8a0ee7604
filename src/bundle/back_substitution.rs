//! From the step of the cameras to the step of the points, and the cost where both lead: a second pass over the sightings.
//!
//! With the letters of [`super::elimination`], `dp = -V^-1 (gp + W' dc)` per point. `W' dc` is not taken from a stored
//! `W`: with `u` the change of the pixel that the step of the cameras makes to first order,
//! `gp + W' dc = sum R'J' w (e + u)`.

use super::elimination::{MIN_DEPTH, cross, rotate};
use super::pattern::Part;
use super::point_block::PointBlock;
use super::problem::{POSE, Problem, State};
use crate::math::RobustLoss;

/// What the second pass sums up over the points of a part.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct StepSums {
    /// Half the sum of losses at the trial.
    pub cost: f64,
    /// `-dp' gp`.
    pub descent: f64,
    /// `dp' D dp`, with `D` what damping added.
    pub damped_sq: f64,
    /// `|dp|^2`.
    pub step_sq: f64,
    /// `|p|^2`.
    pub size_sq: f64,
}

impl StepSums {
    /// The sum of both.
    pub fn plus(self, other: Self) -> Self {
        Self {
            cost: self.cost + other.cost,
            descent: self.descent + other.descent,
            damped_sq: self.damped_sq + other.damped_sq,
            step_sq: self.step_sq + other.step_sq,
            size_sq: self.size_sq + other.size_sq,
        }
    }
}

/// Steps the points of a part from `state`, whose cameras take the step `dc` to those of `trial`, into `points` (those of the
/// part), and sums up.
pub(super) fn step_points(
    problem: &Problem,
    part: &Part,
    (state, trial): (&State, &State),
    dc: &[f64],
    loss: RobustLoss,
    damping: f64,
    points: &mut [[f64; 3]],
) -> StepSums {
    let mut sums = StepSums::default();
    for (point, stepped) in (part.first_point..part.end_point).zip(points) {
        let x_in_world = state.points[point];
        *stepped = x_in_world;
        if problem.point_is_variable[point] {
            let (block, turned) = point_block(problem, state, dc, loss, point);
            if let Some(inverse) = block.damped(damping).inverse_factor() {
                let step = inverse.solve(&turned).map(|s| -s);
                let added = block.damping_diagonal(damping);
                for k in 0..3 {
                    stepped[k] += step[k];
                    sums.descent -= step[k] * block.gradient[k];
                    sums.damped_sq += added[k] * step[k] * step[k];
                    sums.step_sq += step[k] * step[k];
                }
            }
            sums.size_sq += x_in_world.iter().map(|x| x * x).sum::<f64>();
        }
        let range = problem.point_start[point] as usize..problem.point_start[point + 1] as usize;
        for seen in &problem.sightings[range] {
            let camera = problem.poses[seen.pose as usize].camera as usize;
            let y = rotate(&trial.rotations[seen.pose as usize], stepped);
            let t = &trial.poses[seen.pose as usize].translation;
            let x_in_cam = [y[0] + t.x, y[1] + t.y, y[2] + t.z];
            // Written so that a position that is no number goes on into the cost, which then is none either.
            let error_sq = if x_in_cam[2] < MIN_DEPTH {
                problem.cameras[camera].behind_sq
            } else {
                let pixel = trial.lenses[camera].project(&x_in_cam);
                let e = [pixel[0] - seen.pixel[0], pixel[1] - seen.pixel[1]];
                e[0] * e[0] + e[1] * e[1]
            };
            sums.cost += 0.5 * loss.evaluate(error_sq).0;
        }
    }
    sums
}

/// `V` and `gp` of a point, and `gp + W' dc`.
fn point_block(problem: &Problem, state: &State, dc: &[f64], loss: RobustLoss, point: usize) -> (PointBlock, [f64; 3]) {
    let mut block = PointBlock::default();
    let mut turned = PointBlock::default();
    let x_in_world = state.points[point];
    let range = problem.point_start[point] as usize..problem.point_start[point + 1] as usize;
    for seen in &problem.sightings[range] {
        let pose = &problem.poses[seen.pose as usize];
        let rotation = &state.rotations[seen.pose as usize];
        let y = rotate(rotation, &x_in_world);
        let t = &state.poses[seen.pose as usize].translation;
        let x_in_cam = [y[0] + t.x, y[1] + t.y, y[2] + t.z];
        if x_in_cam[2] < MIN_DEPTH {
            continue;
        }
        let lens = &state.lenses[pose.camera as usize];
        let here = lens.linearise(&x_in_cam);
        let e = [here.pixel[0] - seen.pixel[0], here.pixel[1] - seen.pixel[1]];
        let (_, w) = loss.evaluate(e[0] * e[0] + e[1] * e[1]);
        let [j0, j1] = here.by_point;
        let mut moved = [0.0; 3];
        if let Some(slot) = pose.slot {
            let step = &dc[problem.slots[slot as usize].first..][..POSE];
            let turn = cross(&[step[0], step[1], step[2]], &y);
            moved = [turn[0] + step[3], turn[1] + step[4], turn[2] + step[5]];
        }
        let mut u = [e[0] + dot(&j0, &moved), e[1] + dot(&j1, &moved)];
        let camera = &problem.cameras[pose.camera as usize];
        if let Some(slot) = camera.slot {
            let first = problem.slots[slot as usize].first;
            for (step, &(_, kind)) in dc[first..].iter().zip(&camera.free) {
                let column = here.by_parameter(lens, kind);
                u[0] += column[0] * step;
                u[1] += column[1] * step;
            }
        }
        let a = [
            w * (j0[0] * j0[0] + j1[0] * j1[0]),
            w * (j0[0] * j0[1] + j1[0] * j1[1]),
            w * (j0[0] * j0[2] + j1[0] * j1[2]),
            w * (j0[1] * j0[1] + j1[1] * j1[1]),
            w * (j0[1] * j0[2] + j1[1] * j1[2]),
            w * (j0[2] * j0[2] + j1[2] * j1[2]),
        ];
        block.add(rotation, &a, &std::array::from_fn(|k| w * (j0[k] * e[0] + j1[k] * e[1])));
        turned.add_gradient(rotation, &std::array::from_fn(|k| w * (j0[k] * u[0] + j1[k] * u[1])));
    }
    (block, turned.gradient)
}

#[inline(always)]
fn dot(a: &[f64; 3], b: &[f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}
