//! Kernels for x86-64: AVX2, AVX-VNNI (256 bits) and AVX-512 VNNI.

use std::arch::x86_64::*;

use super::kernel::Kernel;
use super::packed::{GROUP_ROWS, Group, Line, QUADS, QUERY_OFFSET, SHORT_OFFSET, ShortSums, bias};
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
    *biases = rows.map(bias);
    ShortSums::new(rows, most_of_four(rows))
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

/// AVX2 alone. Its product of bytes (`vpmaddubsw`) adds pairs up in 16 bits and saturates, so there are two ways.
///
/// *Short*: with 64 taken from the query's bytes (all of them 0 to 191) a product is at most m v, where m = max |q - 64| and v
/// the row's byte, and four of them, from two quads, add up to no more than m times the row's sum of four. Where that is below
/// 2^15 nothing saturates: two products, one addition in 16 bits, and one `vpmaddwd` by ones take two quads to 32 bits. With
/// RootSIFT's bytes that holds for 997 of 1000 tiles or more.
///
/// *Long*, for the others: a line is split into its even and its odd bytes, as 16-bit numbers, and each half multiplied and
/// added up in pairs (`vpmaddwd`): a third more multiplications, and the splitting.
pub(super) struct Avx2;

/// A query for both ways.
#[derive(Clone, Copy)]
pub(super) struct Avx2Query {
    /// For every quad its even bytes and its odd bytes, less 128, two 16-bit numbers to an integer.
    long: [[i32; 2]; QUADS],
    /// The bytes less 64, four to an integer.
    short: [i32; QUADS],
    /// The largest of these, either way; beyond all bounds where a byte does not fit.
    most: i32,
}

// SAFETY: needs AVX2, which `tier` asks for before it chooses this kernel.
unsafe impl Kernel for Avx2 {
    type Lanes = [__m256i; 2];
    type Query = Avx2Query;

    #[inline(always)]
    fn prepare(query: &Descriptor) -> Self::Query {
        let signed = |at: usize| i32::from(query[at]) - i32::from(QUERY_OFFSET);
        let pair = |low: usize| (signed(low) & 0xffff) | (signed(low + 2) << 16);
        let less = |byte: u8| i32::from(byte) - i32::from(SHORT_OFFSET);
        let most = query.iter().fold(0, |most, &byte| less(byte).abs().max(most));
        Avx2Query {
            long: std::array::from_fn(|quad| [pair(4 * quad), pair(4 * quad + 1)]),
            short: std::array::from_fn(|quad| {
                i32::from_le_bytes(std::array::from_fn(|byte| less(query[4 * quad + byte]) as u8))
            }),
            most: if most <= i32::from(i8::MAX) { most } else { i32::from(i16::MAX) + 1 },
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
                let lines: *const __m256i = (&raw const groups[g].lines[2 * pair]).cast();
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
        let mut sums = [[[_mm256_setzero_si256(); 2]; G]; Q];
        for quad in 0..QUADS {
            for g in 0..G {
                let line: *const __m256i = (&raw const groups[g].lines[quad]).cast();
                let rows = [_mm256_load_si256(line), _mm256_load_si256(line.add(1))];
                let even: [__m256i; 2] = std::array::from_fn(|h| _mm256_and_si256(rows[h], even_bytes));
                let odd: [__m256i; 2] = std::array::from_fn(|h| _mm256_srli_epi16::<8>(rows[h]));
                for q in 0..Q {
                    let [query_even, query_odd] = queries[q].long[quad].map(|pair| _mm256_set1_epi32(pair));
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
