//! Kernels for x86-64: AVX2, AVX-VNNI (256 bits) and AVX-512 VNNI.

// A tile is indexed by query, group, quad and half at once, each of several arrays.
#![allow(clippy::needless_range_loop)]

use std::arch::x86_64::*;

use super::kernel::Kernel;
use super::packed::{GROUP_ROWS, Group, Line, QUADS, QUERY_OFFSET, ShortSums, biases_of, sum};
use crate::scene::Descriptor;

/// Lines and biases of sixteen rows: the 16 x 32 quads of the rows are transposed in blocks of 8 x 8, three rounds of
/// interleaving each, a dozen instructions a row where moving quad by quad takes sixty-four.
#[target_feature(enable = "avx2")]
pub(super) fn pack_group(
    rows: &[&Descriptor; GROUP_ROWS],
    lines: &mut [Line; QUADS],
    biases: &mut [i32; GROUP_ROWS],
) -> ShortSums {
    for half in 0..2 {
        for block in 0..QUADS / 8 {
            // SAFETY: 32 bytes from 32 * block are inside a descriptor of 128.
            let loaded: [__m256i; 8] = std::array::from_fn(|row| unsafe {
                _mm256_loadu_si256(rows[8 * half + row].as_ptr().add(32 * block).cast())
            });
            let pairs: [__m256i; 8] = std::array::from_fn(|k| {
                let (a, b) = (loaded[2 * (k / 2)], loaded[2 * (k / 2) + 1]);
                if k % 2 == 0 { _mm256_unpacklo_epi32(a, b) } else { _mm256_unpackhi_epi32(a, b) }
            });
            // Of four rows: quads 0 and 4, 1 and 5, 2 and 6, 3 and 7.
            let fours: [__m256i; 8] = std::array::from_fn(|k| {
                let (a, b) = (pairs[4 * (k / 4) + (k % 4) / 2], pairs[4 * (k / 4) + 2 + (k % 4) / 2]);
                if k % 2 == 0 { _mm256_unpacklo_epi64(a, b) } else { _mm256_unpackhi_epi64(a, b) }
            });
            for quad in 0..8 {
                let (a, b) = (fours[quad % 4], fours[4 + quad % 4]);
                let eight = if quad < 4 {
                    _mm256_permute2x128_si256::<0x20>(a, b)
                } else {
                    _mm256_permute2x128_si256::<0x31>(a, b)
                };
                let line = lines[8 * block + quad].0[8 * half..].as_mut_ptr();
                // SAFETY: eight quads, 32 bytes, of the line are there.
                unsafe { _mm256_storeu_si256(line.cast(), eight) };
            }
        }
    }
    // Loops: a closure would be compiled for other instructions.
    let mut row_sums = [0; GROUP_ROWS];
    for (row_sum, row) in row_sums.iter_mut().zip(rows) {
        *row_sum = sum(row);
    }
    biases_of(rows, &row_sums, biases);
    ShortSums::new(&row_sums, most_of_four(rows))
}

/// [`ShortSums::most`] of these rows: of every eight bytes, the sums of two and two.
#[inline]
#[target_feature(enable = "avx2")]
fn most_of_four(rows: &[&Descriptor; GROUP_ROWS]) -> i32 {
    let ones = _mm256_set1_epi8(1);
    let mut most = _mm256_setzero_si256();
    for row in rows {
        for block in row.as_chunks::<32>().0 {
            // SAFETY: 32 bytes are there.
            let bytes = unsafe { _mm256_loadu_si256(block.as_ptr().cast()) };
            let twos = _mm256_maddubs_epi16(bytes, ones);
            // The upper halves hold sums of two alone, which are no greater.
            most = _mm256_max_epi16(most, _mm256_add_epi16(twos, _mm256_srli_epi64::<32>(twos)));
        }
    }
    let mut lanes = [0i16; 16];
    // SAFETY: 32 bytes are there.
    unsafe { _mm256_storeu_si256(lanes.as_mut_ptr().cast(), most) };
    lanes.into_iter().fold(0, |most, lane| most.max(i32::from(lane)))
}

/// The query's bytes as signed ones, four to an integer that is broadcast to all rows.
#[inline(always)]
fn signed_quads(query: &Descriptor) -> [i32; QUADS] {
    std::array::from_fn(|quad| i32::from_le_bytes(std::array::from_fn(|byte| query[4 * quad + byte] ^ QUERY_OFFSET)))
}

/// 512-bit `vpdpbusd`.
pub(super) struct Avx512Vnni;

// SAFETY: needs AVX-512 F, BW and VNNI, which `tier` asks for before it chooses this kernel.
unsafe impl Kernel for Avx512Vnni {
    type Lanes = __m512i;
    type Query = [i32; QUADS];

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        signed_quads(query)
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is 64 aligned bytes; the instructions are the caller's matter.
        unsafe {
            let mut sums = [[_mm512_setzero_si512(); G]; Q];
            for quad in 0..QUADS {
                let rows: [__m512i; G] =
                    std::array::from_fn(|g| _mm512_load_si512((&raw const groups[g].lines[quad]).cast()));
                for q in 0..Q {
                    let query = _mm512_set1_epi32(queries[q][quad]);
                    for g in 0..G {
                        sums[q][g] = _mm512_dpbusd_epi32(sums[q][g], rows[g], query);
                    }
                }
            }
            sums
        }
    }

    #[inline(always)]
    unsafe fn splat(value: i32) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_set1_epi32(value) }
    }

    #[inline(always)]
    unsafe fn load(from: &[i32; GROUP_ROWS]) -> Self::Lanes {
        // SAFETY: 64 bytes are there; the instructions are the caller's matter.
        unsafe { _mm512_loadu_si512(from.as_ptr().cast()) }
    }

    #[inline(always)]
    unsafe fn store(lanes: Self::Lanes, to: &mut [i32; GROUP_ROWS]) {
        // SAFETY: 64 bytes are there; the instructions are the caller's matter.
        unsafe { _mm512_storeu_si512(to.as_mut_ptr().cast(), lanes) }
    }

    #[inline(always)]
    unsafe fn minus_twice(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_sub_epi32(a, _mm512_slli_epi32::<1>(b)) }
    }

    #[inline(always)]
    unsafe fn add(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_add_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn min(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_min_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn max(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_max_epi32(a, b) }
    }

    #[inline(always)]
    unsafe fn select_less(a: Self::Lanes, b: Self::Lanes, if_less: Self::Lanes, otherwise: Self::Lanes) -> Self::Lanes {
        // SAFETY: the instructions are the caller's matter.
        unsafe { _mm512_mask_mov_epi32(otherwise, _mm512_cmplt_epi32_mask(a, b), if_less) }
    }

    #[inline(always)]
    unsafe fn near(line: &[f32; 3], half_width: f32, x: &[f32; GROUP_ROWS], y: &[f32; GROUP_ROWS]) -> Self::Lanes {
        // SAFETY: twice 64 bytes are there; the instructions are the caller's matter.
        unsafe {
            let [a, b, c] = line.map(|coefficient| _mm512_set1_ps(coefficient));
            let (x, y) = (_mm512_loadu_ps(x.as_ptr()), _mm512_loadu_ps(y.as_ptr()));
            let signed = _mm512_add_ps(_mm512_add_ps(_mm512_mul_ps(a, x), _mm512_mul_ps(b, y)), c);
            let near = _mm512_cmp_ps_mask::<_CMP_LE_OQ>(_mm512_abs_ps(signed), _mm512_set1_ps(half_width));
            _mm512_maskz_set1_epi32(near, 1)
        }
    }
}

/// What the two kernels with 256-bit vectors share: sixteen lanes are two vectors.
macro_rules! halves {
    () => {
        #[inline(always)]
        unsafe fn splat(value: i32) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe { [_mm256_set1_epi32(value); 2] }
        }

        #[inline(always)]
        unsafe fn load(from: &[i32; GROUP_ROWS]) -> Self::Lanes {
            // SAFETY: twice 32 bytes are there; the instructions are the caller's matter.
            unsafe { [_mm256_loadu_si256(from.as_ptr().cast()), _mm256_loadu_si256(from.as_ptr().add(8).cast())] }
        }

        #[inline(always)]
        unsafe fn store(lanes: Self::Lanes, to: &mut [i32; GROUP_ROWS]) {
            // SAFETY: twice 32 bytes are there; the instructions are the caller's matter.
            unsafe {
                _mm256_storeu_si256(to.as_mut_ptr().cast(), lanes[0]);
                _mm256_storeu_si256(to.as_mut_ptr().add(8).cast(), lanes[1]);
            }
        }

        #[inline(always)]
        unsafe fn minus_twice(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe { std::array::from_fn(|h| _mm256_sub_epi32(a[h], _mm256_slli_epi32::<1>(b[h]))) }
        }

        #[inline(always)]
        unsafe fn add(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe { std::array::from_fn(|h| _mm256_add_epi32(a[h], b[h])) }
        }

        #[inline(always)]
        unsafe fn min(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe { std::array::from_fn(|h| _mm256_min_epi32(a[h], b[h])) }
        }

        #[inline(always)]
        unsafe fn max(a: Self::Lanes, b: Self::Lanes) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe { std::array::from_fn(|h| _mm256_max_epi32(a[h], b[h])) }
        }

        #[inline(always)]
        unsafe fn select_less(
            a: Self::Lanes,
            b: Self::Lanes,
            if_less: Self::Lanes,
            otherwise: Self::Lanes,
        ) -> Self::Lanes {
            // SAFETY: the instructions are the caller's matter.
            unsafe {
                std::array::from_fn(|h| _mm256_blendv_epi8(otherwise[h], if_less[h], _mm256_cmpgt_epi32(b[h], a[h])))
            }
        }

        #[inline(always)]
        unsafe fn near(line: &[f32; 3], half_width: f32, x: &[f32; GROUP_ROWS], y: &[f32; GROUP_ROWS]) -> Self::Lanes {
            // SAFETY: twice two times 32 bytes are there; the instructions are the caller's matter.
            unsafe {
                [
                    near_of_eight(line, half_width, x.as_ptr(), y.as_ptr()),
                    near_of_eight(line, half_width, x.as_ptr().add(8), y.as_ptr().add(8)),
                ]
            }
        }
    };
}

/// [`Kernel::near`] of eight rows. A function of its own, without closures, as the compiler can't be relied on to compile a
/// closure for the instructions of the function around it.
#[inline]
#[target_feature(enable = "avx2")]
unsafe fn near_of_eight(line: &[f32; 3], half_width: f32, x: *const f32, y: *const f32) -> __m256i {
    // SAFETY: the caller has eight values at either address.
    let (x, y) = unsafe { (_mm256_loadu_ps(x), _mm256_loadu_ps(y)) };
    let (along_x, along_y) = (_mm256_mul_ps(_mm256_set1_ps(line[0]), x), _mm256_mul_ps(_mm256_set1_ps(line[1]), y));
    let signed = _mm256_add_ps(_mm256_add_ps(along_x, along_y), _mm256_set1_ps(line[2]));
    let distance = _mm256_andnot_ps(_mm256_set1_ps(-0.0), signed);
    let near = _mm256_cmp_ps::<_CMP_LE_OQ>(distance, _mm256_set1_ps(half_width));
    _mm256_srli_epi32::<31>(_mm256_castps_si256(near))
}

mod avx2;
pub(super) use avx2::Avx2;

/// 256-bit `vpdpbusd` in its VEX form.
pub(super) struct AvxVnni;

// SAFETY: needs AVX2 and AVX-VNNI, which `tier` asks for before it chooses this kernel.
unsafe impl Kernel for AvxVnni {
    type Lanes = [__m256i; 2];
    type Query = [i32; QUADS];

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        signed_quads(query)
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is twice 32 aligned bytes; the instructions are the caller's matter.
        unsafe {
            let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
            for quad in 0..QUADS {
                for g in 0..G {
                    let line: *const __m256i = (&raw const groups[g].lines[quad]).cast();
                    let rows = [_mm256_load_si256(line), _mm256_load_si256(line.add(1))];
                    for q in 0..Q {
                        let query = _mm256_set1_epi32(queries[q][quad]);
                        for h in 0..2 {
                            sums[q][g][h] = _mm256_dpbusd_avx_epi32(sums[q][g][h], rows[h], query);
                        }
                    }
                }
            }
            sums
        }
    }

    halves!();
}
