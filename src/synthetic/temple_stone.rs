//! What the temple's stones look like: colours and carving out of hashed value noise of many scales.
//!
//! Details finer than what a pixel covers are left out, so that pictures from different distances agree.

use super::temple_solids::{Material, Vec3};

/// Direction to the sun (not of unit length).
pub(super) const SUN: [f32; 3] = [0.55, -0.62, 0.72];

/// A well mixed hash of cell coordinates.
#[inline]
fn hash(x: i32, y: i32, z: i32, seed: u32) -> u32 {
    let mut h = (x as u32).wrapping_mul(0x8da6_b343)
        ^ (y as u32).wrapping_mul(0xd816_3841)
        ^ (z as u32).wrapping_mul(0xcb1a_b31f)
        ^ seed.wrapping_mul(0x9e37_79b9);
    h = (h ^ (h >> 15)).wrapping_mul(0x2c1b_3c6d);
    h = (h ^ (h >> 12)).wrapping_mul(0x297a_2d39);
    h ^ (h >> 15)
}

/// A hash as a number from -1 to 1.
#[inline]
fn signed(h: u32) -> f32 {
    (h >> 8) as f32 * (2.0 / 16_777_216.0) - 1.0
}

/// Value noise, -1 to 1, with cells of unit size.
#[inline]
fn noise(p: &Vec3, seed: u32) -> f32 {
    let cell = p.map(f32::floor);
    let f = p - cell;
    let w = f.map(|t| t * t * (3.0 - 2.0 * t));
    let (x, y, z) = (cell.x as i32, cell.y as i32, cell.z as i32);
    let mix = |a: f32, b: f32, t: f32| a + (b - a) * t;
    let row = |y: i32, z: i32| mix(signed(hash(x, y, z, seed)), signed(hash(x + 1, y, z, seed)), w.x);
    let sheet = |z: i32| mix(row(y, z), row(y + 1, z), w.y);
    mix(sheet(z), sheet(z + 1), w.z)
}

/// How much of a detail of this size is left where a pixel covers `footprint`: all above 2.5 pixels, nothing below 1.
#[inline]
fn visible(size: f32, footprint: f32) -> f32 {
    ((size / footprint - 1.0) / 1.5).clamp(0.0, 1.0)
}

/// A sum of octaves of noise; each is `(size in metres, amplitude)`.
#[inline]
fn octaves(p: &Vec3, footprint: f32, seed: u32, sizes: &[(f32, f32)]) -> f32 {
    let mut sum = 0.0;
    for (at, &(size, amplitude)) in (0u32..).zip(sizes) {
        let share = visible(size, footprint);
        if share > 0.0 {
            sum += share * amplitude * noise(&(p / size), seed.wrapping_add(at));
        }
    }
    sum
}

const GRAIN: [(f32, f32); 6] = [(0.62, 0.2), (0.27, 0.2), (0.125, 0.22), (0.06, 0.26), (0.03, 0.28), (0.012, 0.22)];

/// Coordinates on a surface: along it, and up (or across, where it lies flat).
fn on_surface(p: &Vec3, normal: &Vec3) -> (f32, f32) {
    if normal.z.abs() > 0.7 {
        (p.x, p.y)
    } else if normal.x.abs() > normal.y.abs() {
        (p.y, p.z)
    } else {
        (p.x, p.z)
    }
}

/// A face of a solid has a number of its own, so that opposite sides differ.
fn side_of(normal: &Vec3) -> u32 {
    let axis = normal.iamax() as u32;
    2 * axis + u32::from(normal[axis as usize] > 0.0)
}

/// A grid of stones of this size (every row shifted): the stone's hash, and how far the next joint is.
fn masonry(u: f32, v: f32, size: [f32; 2], seed: u32) -> (u32, f32) {
    let row = (v / size[1]).floor();
    let shift = signed(hash(row as i32, 7, 3, seed)) * 0.5;
    let at = u / size[0] + shift;
    let column = at.floor();
    let (du, dv) = ((at - column) * size[0], v - row * size[1]);
    let joint = du.min(size[0] - du).min(dv).min(size[1] - dv);
    (hash(column as i32, row as i32, 11, seed), joint)
}

/// The height of the carving at a place, about -1 to 1: in every panel another rosette, and tendrils over all.
fn carving(u: f32, v: f32, p: &Vec3, footprint: f32, seed: u32) -> f32 {
    const PANEL: f32 = 0.5;
    let (column, row) = ((u / PANEL).floor(), (v / PANEL).floor());
    let h = hash(column as i32, row as i32, 5, seed);
    let x = u / PANEL - column - 0.5 + 0.12 * signed(h);
    let y = v / PANEL - row - 0.5 + 0.12 * signed(h.rotate_left(9));
    let radius = (x * x + y * y).sqrt();
    let petals = (3 + h % 6) as f32;
    let outline = 0.3 + 0.09 * (petals * y.atan2(x) + signed(h.rotate_left(17)) * 3.0).sin();
    let rings = (radius * (14.0 + (h >> 5 & 15) as f32)).sin() * visible(0.2, footprint);
    let rosette = if radius < outline { 0.45 + 0.4 * rings } else { -0.35 };
    let tendrils = 1.0 - 2.2 * noise(&(p / 0.19), seed ^ 0x51).abs();
    let chisel = octaves(p, footprint, seed ^ 0x77, &[(0.09, 0.6), (0.045, 0.5)]);
    rosette + 0.5 * tendrils + chisel
}

/// A colour (red, green, blue of light reflected) and a factor for the sun from the carving's slope.
pub(super) fn stone(
    p: &Vec3,
    normal: &Vec3,
    material: Material,
    id: u32,
    footprint: f32,
    seed: u32,
) -> ([f32; 3], f32) {
    let (u, v) = on_surface(p, normal);
    let own = seed ^ id.wrapping_mul(0x632b_e5ab) ^ side_of(normal).wrapping_mul(0x1f12_3bb5);
    let grain = octaves(p, footprint, seed, &GRAIN);
    let stain = noise(&(p / 2.3), seed ^ 0x99) + 0.5 * noise(&(p / 0.9), seed ^ 0x9a);
    // Pits: dark spots where noise is high, of two sizes.
    let pits = [(0.085, 0.45, 0x3c), (0.04, 0.4, 0x3d)].iter().fold(0.0f32, |pits, &(size, from, salt)| {
        let deep = noise(&(p / size), seed ^ salt);
        pits.max(visible(size, footprint) * ((deep - from) * 2.5).clamp(0.0, 0.8))
    });
    let joint_of = |joint: f32, width: f32| {
        let rough = 1.0 + 0.6 * noise(&(p / 0.07), seed ^ 0x42);
        (1.0 - joint / (width * rough + footprint)).clamp(0.0, 1.0) * (width / (width + 0.5 * footprint))
    };
    let sandstone = [0.60f32, 0.50, 0.37];
    let mut relief = 1.0;
    let (color, brightness) = match material {
        Material::Ground => {
            let (slab, joint) = masonry(u, v, [1.3, 0.9], seed ^ 0x10);
            let far = ((p.xy().norm() - 15.0) / 5.0 + 0.6 * stain).clamp(0.0, 1.0);
            let paved = 1.0 + 0.22 * signed(slab) + 0.8 * grain - 0.5 * joint_of(joint, 0.03) - 0.4 * pits;
            let gravel = 1.0 + 1.1 * grain - 0.4 * pits;
            let mix = |a: f32, b: f32| a + (b - a) * far;
            ([mix(0.50, 0.42), mix(0.46, 0.40), mix(0.40, 0.26)], mix(paved, gravel))
        }
        Material::Blocks => {
            let (block, joint) = masonry(u, v, [0.78, 0.4], own);
            let tint = 1.0 + 0.25 * signed(block);
            let gone = if block % 23 == 0 { 0.5 } else { 1.0 };
            let warm = 0.05 * signed(block.rotate_left(13));
            let color = [sandstone[0] + warm, sandstone[1], sandstone[2] - warm];
            (color, gone * (tint + 0.75 * grain - 0.6 * joint_of(joint, 0.018) - 0.5 * pits))
        }
        Material::Column => {
            let angle = normal.y.atan2(normal.x);
            let flute = (angle * 18.0).sin() * visible(0.12, footprint);
            let drum = ((p.z + 0.17 * (id % 5) as f32) / 0.85).floor();
            let tint = 1.0 + 0.2 * signed(hash(drum as i32, 3, 1, own));
            let from_joint = (p.z + 0.17 * (id % 5) as f32) / 0.85 - drum;
            let joint = from_joint.min(1.0 - from_joint) * 0.85;
            (sandstone, tint + 0.13 * flute + 0.8 * grain - 0.5 * joint_of(joint, 0.015) - 0.5 * pits)
        }
        Material::Relief => {
            let own = own ^ 0xabc;
            let height = carving(u, v, p, footprint, own);
            // The slope towards the sun, along the surface.
            let sun = Vec3::from(SUN).normalize();
            let along = (sun - normal * sun.dot(normal)).normalize() * (0.02f32).max(0.7 * footprint);
            let q = p + along;
            let (qu, qv) = on_surface(&q, normal);
            let slope = height - carving(qu, qv, &q, footprint, own);
            relief = (1.0 + 0.55 * slope).clamp(0.25, 1.7);
            (sandstone, 0.9 + 0.22 * height + 0.5 * grain - 0.3 * pits)
        }
        Material::Dark => ([0.10, 0.09, 0.08], 1.0 + 0.9 * grain),
        Material::Rubble => {
            let tint = 1.0 + 0.25 * signed(hash(id as i32, 1, 2, seed));
            ([0.55, 0.49, 0.41], tint + 1.0 * grain - 0.6 * pits)
        }
    };
    // Lichen and soot.
    let soot = ((stain - 0.45) * 1.6).clamp(0.0, 0.5);
    let brightness = brightness.clamp(0.12, 1.9) * (1.0 + 0.12 * stain) * (1.0 - soot);
    (color.map(|channel| channel * brightness), relief)
}
