//! The kernel for AVX2 alone. The product of bytes (`vpmaddubsw`) adds pairs up in 16 bits and saturates, so there are
//! two ways.
//!
//! *Short*: with 64 taken from the query's bytes (all of them 0 to 191) a product is at most m v, where m = max |q - 64| and v
//! the row's byte, and four of them, from two quads, add up to no more than m times the row's sum of four. Where that is below
//! 2^15 nothing saturates: two products, one addition in 16 bits, and one `vpmaddwd` by ones take two quads to 32 bits. With
//! RootSIFT's bytes that holds for 996 of 1000 tiles or more.
//!
//! *Long*, for the others: a line is split into its even and its odd bytes, as 16-bit numbers, and each half multiplied and
//! added up in pairs (`vpmaddwd`): a third more multiplications, and the splitting.

use std::arch::x86_64::*;

use super::super::kernel::Kernel;
use super::super::packed::{GROUP_ROWS, Group, QUADS, QUERY_OFFSET, SHORT_OFFSET};
use super::near_of_eight;
use crate::scene::Descriptor;

/// 256-bit vectors of AVX2, without byte dot products.
pub(in super::super) struct Avx2;

/// A query for both ways. No more than the short way needs, as queries are prepared almost as often as they are scanned.
#[derive(Clone, Copy)]
pub(in super::super) struct Avx2Query {
    /// The bytes less 64, modulo 256, four to an integer: the signed factors of the short way, where they fit.
    short: [i32; QUADS],
    /// The largest of them, either way; beyond all bounds where a byte does not fit.
    most: i32,
}

// SAFETY: needs AVX2, which `tier` asks for before it chooses this kernel.
unsafe impl Kernel for Avx2 {
    type Lanes = [__m256i; 2];
    type Query = Avx2Query;

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        let short = query.map(|byte| byte.wrapping_sub(SHORT_OFFSET));
        let most = query.iter().fold(0, |most, byte| byte.abs_diff(SHORT_OFFSET).max(most));
        Avx2Query {
            short: std::array::from_fn(|quad| i32::from_le_bytes(short.as_chunks().0[quad])),
            most: if most <= i8::MAX as u8 { i32::from(most) } else { i32::from(i16::MAX) + 1 },
        }
    }

    #[inline(always)]
    unsafe fn dots<const Q: usize, const G: usize>(
        queries: &[Self::Query; Q],
        groups: &[Group<'_>; G],
    ) -> [[Self::Lanes; G]; Q] {
        let of_queries = queries.iter().fold(0, |most, query| query.most.max(most));
        let of_rows = groups.iter().fold(0, |most, group| group.short.most.max(most));
        // SAFETY: the instructions are the caller's matter.
        unsafe {
            if of_queries * of_rows <= i32::from(i16::MAX) {
                short_dots(queries, groups)
            } else {
                long_dots(queries, groups)
            }
        }
    }

    halves!();
}

#[inline(always)]
unsafe fn short_dots<const Q: usize, const G: usize>(
    queries: &[Avx2Query; Q],
    groups: &[Group<'_>; G],
) -> [[[__m256i; 2]; G]; Q] {
    // SAFETY: a line is twice 32 aligned bytes; the instructions are the caller's matter.
    unsafe {
        let ones = _mm256_set1_epi16(1);
        let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
        for pair in 0..QUADS / 2 {
            for g in 0..G {
                let lines: *const __m256i = groups[g].lines.as_ptr().add(2 * pair).cast();
                for h in 0..2 {
                    let (a, b) = (_mm256_load_si256(lines.add(h)), _mm256_load_si256(lines.add(2 + h)));
                    for q in 0..Q {
                        let query_a = _mm256_set1_epi32(queries[q].short[2 * pair]);
                        let query_b = _mm256_set1_epi32(queries[q].short[2 * pair + 1]);
                        let products =
                            _mm256_add_epi16(_mm256_maddubs_epi16(a, query_a), _mm256_maddubs_epi16(b, query_b));
                        sums[q][g][h] = _mm256_add_epi32(sums[q][g][h], _mm256_madd_epi16(products, ones));
                    }
                }
            }
        }
        for g in 0..G {
            for h in 0..2 {
                let shifts = _mm256_loadu_si256(groups[g].short.shifts.as_ptr().add(8 * h).cast());
                for sums in &mut sums {
                    sums[g][h] = _mm256_sub_epi32(sums[g][h], shifts);
                }
            }
        }
        sums
    }
}

/// Apart, so that the other way stays small enough to be compiled in one piece with the scan around it.
#[cold]
#[inline(never)]
#[target_feature(enable = "avx2")]
unsafe fn long_dots<const Q: usize, const G: usize>(
    queries: &[Avx2Query; Q],
    groups: &[Group<'_>; G],
) -> [[[__m256i; 2]; G]; Q] {
    // SAFETY: a line is twice 32 aligned bytes; the instructions are the caller's matter.
    unsafe {
        let even_bytes = _mm256_set1_epi16(0xff);
        let (short_offset, offset) = (_mm256_set1_epi8(SHORT_OFFSET as i8), _mm256_set1_epi16(i16::from(QUERY_OFFSET)));
        let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
        for quad in 0..QUADS {
            for g in 0..G {
                let line: *const __m256i = (&raw const groups[g].lines[quad]).cast();
                let rows = [_mm256_load_si256(line), _mm256_load_si256(line.add(1))];
                let even: [__m256i; 2] = std::array::from_fn(|h| _mm256_and_si256(rows[h], even_bytes));
                let odd: [__m256i; 2] = std::array::from_fn(|h| _mm256_srli_epi16::<8>(rows[h]));
                for q in 0..Q {
                    let bytes = _mm256_add_epi8(_mm256_set1_epi32(queries[q].short[quad]), short_offset);
                    let query_even = _mm256_sub_epi16(_mm256_and_si256(bytes, even_bytes), offset);
                    let query_odd = _mm256_sub_epi16(_mm256_srli_epi16::<8>(bytes), offset);
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
