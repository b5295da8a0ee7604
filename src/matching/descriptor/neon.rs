//! Kernel for 64-bit Arm. The dot-product instructions are not stable in Rust yet, so bytes are multiplied to 16 bits
//! (`umull`) and added up in pairs into 32-bit sums (`uadalp`): two sums per row, joined at the end of the tile.

use std::arch::aarch64::*;

use super::kernel::Kernel;
use super::packed::{GROUP_ROWS, Group, QUADS};
use crate::scene::Descriptor;

/// 128-bit vectors, part of every 64-bit Arm processor.
pub(super) struct Neon;

// SAFETY: NEON belongs to the target's baseline.
unsafe impl Kernel for Neon {
    type Lanes = [int32x4_t; 4];
    /// The query's bytes, four to an integer that is broadcast to all rows.
    type Query = [u32; QUADS];

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        std::array::from_fn(|quad| u32::from_le_bytes(std::array::from_fn(|byte| query[4 * quad + byte])))
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is four times 16 bytes.
        unsafe {
            let mut dots = [[[vdupq_n_s32(0); 4]; G]; Q];
            for g in 0..G {
                // A quarter of the group (4 rows) at a time, so that the sums of all queries fit the registers.
                for quarter in 0..4 {
                    let mut sums = [[vdupq_n_u32(0); 2]; Q];
                    for quad in 0..QUADS {
                        let line: *const u8 = (&raw const groups[g].lines[quad]).cast();
                        let rows = vld1q_u8(line.add(16 * quarter));
                        for q in 0..Q {
                            let query = vreinterpret_u8_u32(vdup_n_u32(queries[q][quad]));
                            sums[q][0] = vpadalq_u16(sums[q][0], vmull_u8(vget_low_u8(rows), query));
                            sums[q][1] = vpadalq_u16(sums[q][1], vmull_u8(vget_high_u8(rows), query));
                        }
                    }
                    for q in 0..Q {
                        dots[q][g][quarter] = vreinterpretq_s32_u32(vpaddq_u32(sums[q][0], sums[q][1]));
                    }
                }
            }
            dots
        }
    }

    #[inline(always)]
    unsafe fn splat(value: i32) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { [vdupq_n_s32(value); 4] }
    }

    #[inline(always)]
    unsafe fn load(from: &[i32; GROUP_ROWS]) -> Self::Lanes {
        // SAFETY: four times 16 bytes are there.
        unsafe { std::array::from_fn(|part| vld1q_s32(from.as_ptr().add(4 * part))) }
    }

    #[inline(always)]
    unsafe fn store(lanes: Self::Lanes, to: &mut [i32; GROUP_ROWS]) {
        for (part, lanes) in lanes.into_iter().enumerate() {
            // SAFETY: four times 16 bytes are there.
            unsafe { vst1q_s32(to.as_mut_ptr().add(4 * part), lanes) };
        }
    }

    #[inline(always)]
    unsafe fn minus_twice(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { std::array::from_fn(|part| vsubq_s32(a[part], vshlq_n_s32::<1>(b[part]))) }
    }

    #[inline(always)]
    unsafe fn add(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { std::array::from_fn(|part| vaddq_s32(a[part], b[part])) }
    }

    #[inline(always)]
    unsafe fn min(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { std::array::from_fn(|part| vminq_s32(a[part], b[part])) }
    }

    #[inline(always)]
    unsafe fn max(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { std::array::from_fn(|part| vmaxq_s32(a[part], b[part])) }
    }

    #[inline(always)]
    unsafe fn select_less(a: Self::Lanes, b: Self::Lanes, if_less: Self::Lanes, otherwise: Self::Lanes) -> Self::Lanes {
        // SAFETY: baseline instructions.
        unsafe { std::array::from_fn(|part| vbslq_s32(vcltq_s32(a[part], b[part]), if_less[part], otherwise[part])) }
    }

    #[inline(always)]
    unsafe fn near(line: &[f32; 3], half_width: f32, x: &[f32; GROUP_ROWS], y: &[f32; GROUP_ROWS]) -> Self::Lanes {
        // SAFETY: four times 16 bytes are there.
        unsafe {
            std::array::from_fn(|part| {
                let (x, y) = (vld1q_f32(x.as_ptr().add(4 * part)), vld1q_f32(y.as_ptr().add(4 * part)));
                let signed = vaddq_f32(vmulq_n_f32(x, line[0]), vmulq_n_f32(y, line[1]));
                let distance = vabsq_f32(vaddq_f32(signed, vdupq_n_f32(line[2])));
                let near = vcleq_f32(distance, vdupq_n_f32(half_width));
                vreinterpretq_s32_u32(vandq_u32(near, vdupq_n_u32(1)))
            })
        }
    }
}
