//! The shape of the temple: boxes along the axes and upright cylinders, in a tree of bounding boxes for ray casting.
//!
//! Metres; z is up, the ground is the plane z = 0, and the middle of the temple is above the origin.

use nalgebra::Vector3;

use crate::math::Rng;

pub(super) type Vec3 = Vector3<f32>;

/// What a solid is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Material {
    Ground,
    /// Courses of blocks with joints.
    Blocks,
    /// Fluted drums.
    Column,
    /// Carved all over.
    Relief,
    /// What is seen through a window.
    Dark,
    /// A single stone.
    Rubble,
}

#[derive(Clone, Copy, Debug)]
enum Shape {
    Box,
    /// It fills its bounding box's circle.
    Cylinder,
}

#[derive(Clone, Copy, Debug)]
struct Solid {
    low: Vec3,
    high: Vec3,
    shape: Shape,
    material: Material,
    id: u32,
}

/// Where a ray meets a surface.
#[derive(Clone, Copy, Debug)]
pub(super) struct Hit {
    /// In lengths of the ray's direction.
    pub(super) distance: f32,
    pub(super) normal: Vec3,
    pub(super) material: Material,
    /// Different for every solid.
    pub(super) id: u32,
}

/// A node of the tree: a leaf when `count > 0`.
#[derive(Clone, Copy, Debug)]
struct Node {
    low: Vec3,
    high: Vec3,
    /// The first solid of a leaf, or the second child of another node; the first child follows the node.
    at: u32,
    count: u32,
}

/// All solids.
#[derive(Clone, Debug)]
pub(super) struct Solids {
    solids: Vec<Solid>,
    nodes: Vec<Node>,
    /// Where the solid of an id stands in `solids`; the ground's id, 0, has no meaning here.
    place_of_id: Vec<u32>,
}

/// Solids of a leaf at most.
const LEAF_LEN: usize = 3;
/// Deepest path of the tree: it halves, so this is far more than it needs.
const STACK_LEN: usize = 32;

/// Half extents of the lowest step, and the height of a step.
pub(super) const BASE_HALF: [f32; 2] = [8.0, 6.0];
pub(super) const STEP_HEIGHT: f32 = 0.4;
const NUM_STEPS: usize = 4;
const STEP_DEPTH: f32 = 0.38;
/// Top of the platform, of the columns, of the architrave, of the frieze, of the cornice.
pub(super) const FLOOR: f32 = STEP_HEIGHT * NUM_STEPS as f32;
pub(super) const COLUMN_TOP: f32 = 5.6;
const ARCHITRAVE_TOP: f32 = 6.0;
const FRIEZE_TOP: f32 = 7.0;
const CORNICE_TOP: f32 = 7.3;
/// Half extents of the row of columns, and of the walls behind them.
pub(super) const COLONNADE_HALF: [f32; 2] = [6.1, 4.1];
const WALL_HALF: [f32; 2] = [4.4, 2.5];
const COLUMN_RADIUS: f32 = 0.36;
const WINDOW_DEPTH: f32 = 0.3;
const NUM_RUBBLE: usize = 46;
/// Where the ground ends, in lengths of a ray's direction: far behind the haze.
const HORIZON: f32 = 1e4;

#[derive(Default)]
struct Builder {
    solids: Vec<Solid>,
}

impl Builder {
    fn add(&mut self, low: [f32; 3], high: [f32; 3], shape: Shape, material: Material) {
        let id = self.solids.len() as u32 + 1;
        self.solids.push(Solid { low: low.into(), high: high.into(), shape, material, id });
    }

    /// A box around the z axis.
    fn storey(&mut self, half: [f32; 2], z: [f32; 2], material: Material) {
        self.add([-half[0], -half[1], z[0]], [half[0], half[1], z[1]], Shape::Box, material);
    }

    fn column(&mut self, x: f32, y: f32, top: f32) {
        let square = |builder: &mut Self, half: f32, z: [f32; 2], shape, material| {
            builder.add([x - half, y - half, z[0]], [x + half, y + half, z[1]], shape, material);
        };
        square(self, 0.5, [FLOOR, FLOOR + 0.22], Shape::Box, Material::Blocks);
        square(self, 0.44, [FLOOR + 0.22, FLOOR + 0.4], Shape::Cylinder, Material::Relief);
        let whole = top >= COLUMN_TOP;
        square(
            self,
            COLUMN_RADIUS,
            [FLOOR + 0.4, if whole { top - 0.5 } else { top }],
            Shape::Cylinder,
            Material::Column,
        );
        if whole {
            square(self, 0.45, [top - 0.5, top - 0.22], Shape::Cylinder, Material::Relief);
            square(self, 0.54, [top - 0.22, top], Shape::Box, Material::Relief);
        }
    }

    /// The wall along one side: bands below and above the windows, and piers between them.
    fn wall(&mut self, axis: usize, sign: f32) {
        let (along, across) = (WALL_HALF[axis], WALL_HALF[1 - axis]);
        let place = |builder: &mut Self, u: [f32; 2], z: [f32; 2], out: f32, material| {
            let (a, b) = (sign * (across - WINDOW_DEPTH), sign * (across + out));
            let mut low = [0.0, 0.0, z[0]];
            let mut high = [0.0, 0.0, z[1]];
            (low[axis], high[axis]) = (u[0], u[1]);
            (low[1 - axis], high[1 - axis]) = (a.min(b), a.max(b));
            builder.add(low, high, Shape::Box, material);
        };
        let (sill, lintel) = (2.7, 4.5);
        place(self, [-along, along], [FLOOR, sill], 0.0, Material::Blocks);
        place(self, [-along, along], [lintel, COLUMN_TOP], 0.0, Material::Relief);
        let windows = if axis == 0 { 5 } else { 3 };
        let pitch = 2.0 * along / windows as f32;
        for pier in 0..=windows {
            let middle = -along + pitch * pier as f32;
            let half = 0.23 * pitch;
            let u = [(middle - half).max(-along), (middle + half).min(along)];
            place(self, u, [sill, lintel], 0.0, Material::Blocks);
            if pier < windows {
                let mullion = middle + 0.5 * pitch;
                place(self, [mullion - 0.06, mullion + 0.06], [sill, lintel], -0.08, Material::Relief);
                place(self, [middle + half, middle + pitch - half], [sill - 0.12, sill], 0.12, Material::Blocks);
            }
        }
    }

    fn rubble(&mut self, rng: &mut Rng) {
        for _ in 0..NUM_RUBBLE {
            let angle = rng.range(0.0, std::f64::consts::TAU);
            let reach = rng.range(1.12, 1.45);
            let x = (10.0 * reach * angle.cos()) as f32;
            let y = (8.2 * reach * angle.sin()) as f32;
            let half = [0.0; 3].map(|_| rng.range(0.1, 0.42) as f32);
            let low = [x - half[0], y - half[1], -0.1];
            self.add(low, [x + half[0], y + half[1], 1.5 * half[2]], Shape::Box, Material::Rubble);
        }
    }
}

/// The coordinates of `count` columns from one corner to the other.
fn positions(half: f32, count: usize) -> impl Iterator<Item = f32> {
    (0..count).map(move |at| half * (2.0 * at as f32 / (count - 1) as f32 - 1.0))
}

impl Solids {
    /// The temple of a seed: where stones lie around it and how high its broken column stands.
    pub(super) fn new(rng: &mut Rng) -> Self {
        let mut builder = Builder::default();
        for step in 0..NUM_STEPS {
            let inset = STEP_DEPTH * step as f32;
            let half = BASE_HALF.map(|half| half - inset);
            builder.storey(half, [0.0, STEP_HEIGHT * (step + 1) as f32], Material::Blocks);
        }
        let [cx, cy] = COLONNADE_HALF;
        let broken_top = FLOOR + rng.range(1.2, 2.0) as f32;
        for (at, x) in positions(cx, 6).enumerate() {
            builder.column(x, -cy, if at == 4 { broken_top } else { COLUMN_TOP });
            builder.column(x, cy, COLUMN_TOP);
        }
        for y in positions(cy, 4).skip(1).take(2) {
            builder.column(-cx, y, COLUMN_TOP);
            builder.column(cx, y, COLUMN_TOP);
        }
        builder.storey(WALL_HALF.map(|half| half - WINDOW_DEPTH), [FLOOR, COLUMN_TOP], Material::Dark);
        for axis in 0..2 {
            builder.wall(axis, -1.0);
            builder.wall(axis, 1.0);
        }
        let beam = COLONNADE_HALF.map(|half| half + 0.45);
        builder.storey(beam, [COLUMN_TOP, ARCHITRAVE_TOP], Material::Blocks);
        builder.storey(beam.map(|half| half - 0.08), [ARCHITRAVE_TOP, FRIEZE_TOP], Material::Relief);
        builder.storey(beam.map(|half| half + 0.35), [FRIEZE_TOP, CORNICE_TOP], Material::Blocks);
        let mut z = CORNICE_TOP;
        for tier in 0..4 {
            let half = [5.6 - 1.15 * tier as f32, 3.8 - 0.72 * tier as f32];
            builder.storey(half, [z, z + 0.55], Material::Relief);
            builder.storey(half.map(|half| half + 0.14), [z + 0.55, z + 0.72], Material::Blocks);
            z += 0.72;
        }
        builder.add([-0.7, -0.7, z], [0.7, 0.7, z + 0.8], Shape::Cylinder, Material::Relief);
        builder.add([-0.4, -0.4, z + 0.8], [0.4, 0.4, z + 1.3], Shape::Cylinder, Material::Relief);
        builder.rubble(rng);
        let mut solids = builder.solids;
        let mut nodes = Vec::new();
        let len = solids.len();
        build(&mut solids, 0, len, &mut nodes);
        let mut place_of_id = vec![0; len + 1];
        for (place, solid) in (0u32..).zip(&solids) {
            place_of_id[solid.id as usize] = place;
        }
        Self { solids, nodes, place_of_id }
    }

    /// Where a ray meets the solid of this id, whatever else stands in its way.
    pub(super) fn meet(&self, id: u32, origin: &Vec3, direction: &Vec3) -> Option<Hit> {
        if id == 0 {
            return ground(origin, direction);
        }
        let solid = &self.solids[self.place_of_id[id as usize] as usize];
        let (distance, normal) = solid.meet(origin, direction, &direction.map(|d| 1.0 / d))?;
        Some(Hit { distance, normal, material: solid.material, id })
    }

    /// The nearest surface on a ray, ground included.
    pub(super) fn nearest(&self, origin: &Vec3, direction: &Vec3) -> Option<Hit> {
        let mut nearest = ground(origin, direction);
        self.walk(origin, direction, &mut nearest, false);
        nearest
    }

    /// Whether anything stands in a ray's way.
    pub(super) fn blocks(&self, origin: &Vec3, direction: &Vec3) -> bool {
        let mut nearest = None;
        self.walk(origin, direction, &mut nearest, true);
        nearest.is_some()
    }

    /// Goes through the tree, near boxes first; with `any`, up to the first hit.
    fn walk(&self, origin: &Vec3, direction: &Vec3, nearest: &mut Option<Hit>, any: bool) {
        let inverse = direction.map(|d| 1.0 / d);
        let enter = |at: u32| {
            let node = &self.nodes[at as usize];
            slabs(&node.low, &node.high, origin, &inverse).map_or(f32::INFINITY, |(enter, _, _)| enter)
        };
        let mut limit = nearest.map_or(f32::INFINITY, |hit| hit.distance);
        let mut stack = [(0u32, 0f32); STACK_LEN];
        stack[0] = (0, enter(0));
        let mut depth = 1;
        while depth > 0 {
            depth -= 1;
            let (at, entered) = stack[depth];
            if entered >= limit {
                continue;
            }
            let node = &self.nodes[at as usize];
            if node.count == 0 {
                let (a, b) = ((at + 1, enter(at + 1)), (node.at, enter(node.at)));
                let (near, far) = if a.1 <= b.1 { (a, b) } else { (b, a) };
                for child in [far, near] {
                    if child.1 < limit {
                        stack[depth] = child;
                        depth += 1;
                    }
                }
                continue;
            }
            for solid in &self.solids[node.at as usize..(node.at + node.count) as usize] {
                if let Some((distance, normal)) = solid.meet(origin, direction, &inverse)
                    && distance < limit
                {
                    limit = distance;
                    *nearest = Some(Hit { distance, normal, material: solid.material, id: solid.id });
                    if any {
                        return;
                    }
                }
            }
        }
    }
}

fn ground(origin: &Vec3, direction: &Vec3) -> Option<Hit> {
    let distance = -origin.z / direction.z;
    (direction.z < 0.0 && distance > 0.0 && distance < HORIZON).then(|| Hit {
        distance,
        normal: Vec3::z(),
        material: Material::Ground,
        id: 0,
    })
}

/// Where a ray enters a box, where it leaves it, and the axis of the face it enters by.
#[inline]
fn slabs(low: &Vec3, high: &Vec3, origin: &Vec3, inverse: &Vec3) -> Option<(f32, f32, usize)> {
    let (mut enter, mut leave, mut axis) = (f32::NEG_INFINITY, f32::INFINITY, 0);
    for i in 0..3 {
        let (a, b) = ((low[i] - origin[i]) * inverse[i], (high[i] - origin[i]) * inverse[i]);
        // A ray in the plane of a face gives NaN; every comparison with it is false, which leaves the bound as it is.
        let (near, far) = if a < b { (a, b) } else { (b, a) };
        if near > enter {
            (enter, axis) = (near, i);
        }
        if far < leave {
            leave = far;
        }
    }
    (enter <= leave && leave > 0.0).then_some((enter, leave, axis))
}

impl Solid {
    /// Where a ray from outside enters, and the normal there.
    fn meet(&self, origin: &Vec3, direction: &Vec3, inverse: &Vec3) -> Option<(f32, Vec3)> {
        let (enter, leave, axis) = slabs(&self.low, &self.high, origin, inverse)?;
        let face = |axis: usize| {
            let mut normal = Vec3::zeros();
            normal[axis] = -direction[axis].signum();
            normal
        };
        match self.shape {
            Shape::Box => (enter > 0.0).then(|| (enter, face(axis))),
            Shape::Cylinder => {
                let middle = 0.5 * (self.low + self.high);
                let radius = 0.5 * (self.high.x - self.low.x);
                let (ox, oy) = (origin.x - middle.x, origin.y - middle.y);
                let a = direction.x * direction.x + direction.y * direction.y;
                let b = ox * direction.x + oy * direction.y;
                let root = b * b - a * (ox * ox + oy * oy - radius * radius);
                if root < 0.0 {
                    return None;
                }
                let side = (-b - root.sqrt()) / a;
                let exit = (-b + root.sqrt()) / a;
                // The ray is inside the slab of heights from `low_z` to `leave`.
                let cap = ((self.low.z - origin.z) * inverse.z).min((self.high.z - origin.z) * inverse.z);
                if cap > side {
                    return (cap > 0.0 && cap < exit && cap <= leave).then(|| (cap, face(2)));
                }
                let z = origin.z + side * direction.z;
                (side > 0.0 && z >= self.low.z && z <= self.high.z).then(|| {
                    let x = (ox + side * direction.x) / radius;
                    let y = (oy + side * direction.y) / radius;
                    (side, Vec3::new(x, y, 0.0))
                })
            }
        }
    }
}

/// Builds the tree over `solids[from..to]`, halving along the longest side.
fn build(solids: &mut [Solid], from: usize, to: usize, nodes: &mut Vec<Node>) {
    let part = &mut solids[from..to];
    let low = part.iter().fold(Vec3::repeat(f32::INFINITY), |low, solid| low.inf(&solid.low));
    let high = part.iter().fold(Vec3::repeat(f32::NEG_INFINITY), |high, solid| high.sup(&solid.high));
    let at = nodes.len();
    nodes.push(Node { low, high, at: from as u32, count: part.len() as u32 });
    if part.len() <= LEAF_LEN {
        return;
    }
    let axis = (high - low).imax();
    part.sort_by(|a, b| (a.low[axis] + a.high[axis]).total_cmp(&(b.low[axis] + b.high[axis])).then(a.id.cmp(&b.id)));
    let middle = (from + to) / 2;
    build(solids, from, middle, nodes);
    nodes[at].at = nodes.len() as u32;
    nodes[at].count = 0;
    build(solids, middle, to, nodes);
}
