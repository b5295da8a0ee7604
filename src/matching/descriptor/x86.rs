//! Kernels for x86-64: AVX2, AVX-VNNI (256 bits) and AVX-512 VNNI.

use std::arch::x86_64::*;

use super::kernel::Kernel;
use super::packed::{GROUP_ROWS, Line, QUADS, QUERY_OFFSET, bias};
use crate::scene::Descriptor;

/// Lines and biases of sixteen rows: the 16 x 32 quads of the rows are transposed in blocks of 8 x 8, three rounds of
/// interleaving each, a dozen instructions a row where moving quad by quad takes sixty-four.
#[target_feature(enable = "avx2")]
pub(super) fn pack_group(rows: &[&Descriptor; GROUP_ROWS], lines: &mut [Line; QUADS], biases: &mut [i32; GROUP_ROWS]) {
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
    *biases = rows.map(bias);
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
        groups: &[[Line; QUADS]; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is 64 aligned bytes; the instructions are the caller's matter.
        unsafe {
            let mut sums = [[_mm512_setzero_si512(); G]; Q];
            for quad in 0..QUADS {
                let rows: [__m512i; G] =
                    std::array::from_fn(|g| _mm512_load_si512((&raw const groups[g][quad]).cast()));
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
                let [a, b, c] = line.map(|coefficient| _mm256_set1_ps(coefficient));
                let (sign, half_width) = (_mm256_set1_ps(-0.0), _mm256_set1_ps(half_width));
                std::array::from_fn(|h| {
                    let (x, y) = (_mm256_loadu_ps(x.as_ptr().add(8 * h)), _mm256_loadu_ps(y.as_ptr().add(8 * h)));
                    let signed = _mm256_add_ps(_mm256_add_ps(_mm256_mul_ps(a, x), _mm256_mul_ps(b, y)), c);
                    let near = _mm256_cmp_ps::<_CMP_LE_OQ>(_mm256_andnot_ps(sign, signed), half_width);
                    _mm256_srli_epi32::<31>(_mm256_castps_si256(near))
                })
            }
        }
    };
}

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
        groups: &[[Line; QUADS]; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is twice 32 aligned bytes; the instructions are the caller's matter.
        unsafe {
            let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
            for quad in 0..QUADS {
                for g in 0..G {
                    let line: *const __m256i = (&raw const groups[g][quad]).cast();
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

/// AVX2 alone. `vpmaddubsw` would saturate for full-range bytes, so a line is split into its even and its odd bytes, as
/// 16-bit numbers, and each half multiplied and added up in pairs (`vpmaddwd`): still one 32-bit sum per row.
pub(super) struct Avx2;

// SAFETY: needs AVX2, which `tier` asks for before it chooses this kernel.
unsafe impl Kernel for Avx2 {
    type Lanes = [__m256i; 2];
    /// For every quad its even bytes and its odd bytes, two 16-bit numbers to an integer.
    type Query = [[i32; 2]; QUADS];

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        let signed = |at: usize| i32::from(query[at]) - i32::from(QUERY_OFFSET);
        let pair = |low: usize| (signed(low) & 0xffff) | (signed(low + 2) << 16);
        std::array::from_fn(|quad| [pair(4 * quad), pair(4 * quad + 1)])
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[[Line; QUADS]; G],
    ) -> [[Self::Lanes; G]; Q] {
        // SAFETY: a line is twice 32 aligned bytes; the instructions are the caller's matter.
        unsafe {
            let even_bytes = _mm256_set1_epi16(0xff);
            let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
            for quad in 0..QUADS {
                for g in 0..G {
                    let line: *const __m256i = (&raw const groups[g][quad]).cast();
                    let rows = [_mm256_load_si256(line), _mm256_load_si256(line.add(1))];
                    let even: [__m256i; 2] = std::array::from_fn(|h| _mm256_and_si256(rows[h], even_bytes));
                    let odd: [__m256i; 2] = std::array::from_fn(|h| _mm256_srli_epi16::<8>(rows[h]));
                    for q in 0..Q {
                        let [query_even, query_odd] = queries[q][quad].map(|pair| _mm256_set1_epi32(pair));
                        for h in 0..2 {
                            let products = _mm256_add_epi32(
                                _mm256_madd_epi16(even[h], query_even),
                                _mm256_madd_epi16(odd[h], query_odd),
                            );
                            sums[q][g][h] = _mm256_add_epi32(sums[q][g][h], products);
                        }
                    }
                }
            }
            sums
        }
    }

    halves!();
}
