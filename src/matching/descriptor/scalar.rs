//! The plain kernel: the oracle of the others, and what runs where none of them can.

use super::distance_sq;
use super::kernel::Kernel;
use super::packed::{GROUP_ROWS, Group, QUADS, QUERY_OFFSET};
use crate::scene::Descriptor;

/// [`super::least_distance_sq`] in ordinary arithmetic, which the compiler turns into what the caller was compiled for.
#[inline(always)]
pub(super) fn least_distance_sq(query: &Descriptor, descriptors: &[Descriptor], indices: &[u32]) -> Option<u32> {
    indices.iter().map(|&index| distance_sq(query, &descriptors[index as usize])).min()
}

/// Sixteen integers and ordinary arithmetic.
pub(super) struct Scalar;

// SAFETY: uses no instructions beyond the target's baseline.
unsafe impl Kernel for Scalar {
    type Lanes = [i32; GROUP_ROWS];
    type Query = [[i32; 4]; QUADS];

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        std::array::from_fn(|quad| {
            std::array::from_fn(|byte| i32::from(query[4 * quad + byte]) - i32::from(QUERY_OFFSET))
        })
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q] {
        let mut sums = [[[0; GROUP_ROWS]; G]; Q];
        for (query, sums) in queries.iter().zip(&mut sums) {
            for (group, sums) in groups.iter().zip(sums) {
                for (quad, line) in query.iter().zip(group.lines) {
                    for (row, sum) in line.0.iter().zip(&mut *sums) {
                        for (&q, &v) in quad.iter().zip(row) {
                            *sum += q * i32::from(v);
                        }
                    }
                }
            }
        }
        sums
    }

    #[inline(always)]
    unsafe fn splat(value: i32) -> Self::Lanes {
        [value; GROUP_ROWS]
    }

    #[inline(always)]
    unsafe fn load(from: &[i32; GROUP_ROWS]) -> Self::Lanes {
        *from
    }

    #[inline(always)]
    unsafe fn store(lanes: Self::Lanes, to: &mut [i32; GROUP_ROWS]) {
        *to = lanes;
    }

    #[inline(always)]
    unsafe fn minus_twice(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        std::array::from_fn(|lane| a[lane] - 2 * b[lane])
    }

    #[inline(always)]
    unsafe fn add(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        std::array::from_fn(|lane| a[lane] + b[lane])
    }

    #[inline(always)]
    unsafe fn min(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        std::array::from_fn(|lane| a[lane].min(b[lane]))
    }

    #[inline(always)]
    unsafe fn max(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        std::array::from_fn(|lane| a[lane].max(b[lane]))
    }

    #[inline(always)]
    unsafe fn select_less(a: Self::Lanes, b: Self::Lanes, if_less: Self::Lanes, otherwise: Self::Lanes) -> Self::Lanes {
        std::array::from_fn(|lane| if a[lane] < b[lane] { if_less[lane] } else { otherwise[lane] })
    }

    #[inline(always)]
    unsafe fn near(line: &[f32; 3], half_width: f32, x: &[f32; GROUP_ROWS], y: &[f32; GROUP_ROWS]) -> Self::Lanes {
        let signed = |lane: usize| line[0] * x[lane] + line[1] * y[lane] + line[2];
        std::array::from_fn(|lane| i32::from(signed(lane).abs() <= half_width))
    }
}
