//! Which instructions to use, asked of the machine once.

use std::ops::Range;
use std::sync::LazyLock;

use super::banded::{self, BandQuery, BandTop2, BandedRows, NearestQueries};
use super::cells::CellRows;
use super::scalar::{self, Scalar};
use super::{PackedDescriptors, Top2, kernel};
use crate::math::Grouped;
use crate::scene::Descriptor;

/// A set of instructions a kernel is written for. All give identical results.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Tier {
    /// The target's baseline.
    Scalar,
    /// 256-bit integers with 16-bit products.
    #[cfg(target_arch = "x86_64")]
    Avx2,
    /// 256-bit byte dot products.
    #[cfg(target_arch = "x86_64")]
    AvxVnni,
    /// 512-bit byte dot products.
    #[cfg(target_arch = "x86_64")]
    Avx512Vnni,
    /// 128-bit integers with 16-bit products.
    #[cfg(target_arch = "aarch64")]
    Neon,
}

impl Tier {
    /// Every tier this program was built with, slowest first.
    pub const ALL: &[Self] = &[
        Self::Scalar,
        #[cfg(target_arch = "x86_64")]
        Self::Avx2,
        #[cfg(target_arch = "x86_64")]
        Self::AvxVnni,
        #[cfg(target_arch = "x86_64")]
        Self::Avx512Vnni,
        #[cfg(target_arch = "aarch64")]
        Self::Neon,
    ];

    /// The fastest tier of this machine.
    pub fn detected() -> Self {
        static DETECTED: LazyLock<Tier> =
            LazyLock::new(|| Tier::ALL.iter().copied().rev().find(|tier| tier.is_available()).unwrap_or(Tier::Scalar));
        *DETECTED
    }

    /// Whether this machine has the instructions.
    pub fn is_available(self) -> bool {
        match self {
            Self::Scalar => true,
            #[cfg(target_arch = "x86_64")]
            Self::Avx2 => std::is_x86_feature_detected!("avx2"),
            #[cfg(target_arch = "x86_64")]
            Self::AvxVnni => std::is_x86_feature_detected!("avx2") && std::is_x86_feature_detected!("avxvnni"),
            #[cfg(target_arch = "x86_64")]
            Self::Avx512Vnni => {
                std::is_x86_feature_detected!("avx512f")
                    && std::is_x86_feature_detected!("avx512bw")
                    && std::is_x86_feature_detected!("avx512vnni")
            }
            #[cfg(target_arch = "aarch64")]
            Self::Neon => true,
        }
    }

    /// [`super::top2`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn top2(self, queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<Top2>) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => kernel::top2::<Scalar, 4, 1>(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::top2_avx2(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::top2_avx_vnni(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::top2_avx512_vnni(queries, packed, out),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => kernel::top2::<super::neon::Neon, 6, 1>(queries, packed, out),
            }
        }
    }

    /// [`super::top2_both`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn top2_both(
        self,
        queries: &[Descriptor],
        packed: &PackedDescriptors,
        of_queries: &mut Vec<Top2>,
        of_rows: &mut Vec<Top2>,
    ) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => kernel::top2_both::<Scalar, 4, 1>(queries, packed, of_queries, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::top2_both_avx2(queries, packed, of_queries, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::top2_both_avx_vnni(queries, packed, of_queries, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::top2_both_avx512_vnni(queries, packed, of_queries, of_rows),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => kernel::top2_both::<super::neon::Neon, 6, 1>(queries, packed, of_queries, of_rows),
            }
        }
    }

    /// [`super::distances_sq`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn distances_sq(self, queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<u32>) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => kernel::distances_sq::<Scalar, 4>(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::distances_avx2(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::distances_avx_vnni(queries, packed, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::distances_avx512_vnni(queries, packed, out),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => kernel::distances_sq::<super::neon::Neon, 6>(queries, packed, out),
            }
        }
    }

    /// [`super::top2_in_cells`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn top2_in_cells(
        self,
        queries: &[Descriptor],
        visitors: &Grouped<u32>,
        rows: &CellRows,
        of_queries: &mut Vec<Option<Top2>>,
        of_slots: &mut Vec<Option<Top2>>,
    ) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => kernel::top2_in_cells::<Scalar, 4, 1>(queries, visitors, rows, of_queries, of_slots),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::in_cells_avx2(queries, visitors, rows, of_queries, of_slots),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::in_cells_avx_vnni(queries, visitors, rows, of_queries, of_slots),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::in_cells_avx512_vnni(queries, visitors, rows, of_queries, of_slots),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => {
                    kernel::top2_in_cells::<super::neon::Neon, 6, 1>(queries, visitors, rows, of_queries, of_slots);
                }
            }
        }
    }

    /// [`CellRows::top2_of`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn top2_of_cells(self, query: &Descriptor, cells: &[u32], rows: &CellRows) -> Option<Top2> {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => kernel::top2_of_cells::<Scalar, 1>(query, cells, rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::of_cells_avx2(query, cells, rows),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::of_cells_avx_vnni(query, cells, rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::of_cells_avx512_vnni(query, cells, rows),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => kernel::top2_of_cells::<super::neon::Neon, 2>(query, cells, rows),
            }
        }
    }

    /// [`super::least_distance_sq`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them or an index is out of range.
    pub fn least_distance_sq(self, query: &Descriptor, descriptors: &[Descriptor], indices: &[u32]) -> Option<u32> {
        self.assert_available();
        match self {
            Self::Scalar => scalar::least_distance_sq(query, descriptors, indices),
            #[cfg(target_arch = "x86_64")]
            // SAFETY: all of these have the instructions of AVX2.
            Self::Avx2 | Self::AvxVnni | Self::Avx512Vnni => unsafe {
                x86::least_distance_sq_avx2(query, descriptors, indices)
            },
            #[cfg(target_arch = "aarch64")]
            Self::Neon => scalar::least_distance_sq(query, descriptors, indices),
        }
    }

    /// [`super::top2_in_bands`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn top2_in_bands(
        self,
        queries: &[BandQuery<'_>],
        windows: &[Range<u32>],
        rows: &BandedRows,
        out: &mut Vec<BandTop2>,
        of_rows: &mut NearestQueries,
    ) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => banded::scan::<Scalar, 4>(queries, windows, rows, out, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::in_bands_avx2(queries, windows, rows, out, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::in_bands_avx_vnni(queries, windows, rows, out, of_rows),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::in_bands_avx512_vnni(queries, windows, rows, out, of_rows),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => banded::scan::<super::neon::Neon, 6>(queries, windows, rows, out, of_rows),
            }
        }
    }

    /// [`super::nearest_off_bands`] with these instructions.
    ///
    /// # Panics
    /// When the machine lacks them.
    pub fn nearest_off_bands(
        self,
        queries: &[BandQuery<'_>],
        ranks: &[u32],
        rows: &BandedRows,
        out: &mut Vec<Option<u32>>,
    ) {
        self.assert_available();
        // SAFETY: the instructions are there.
        unsafe {
            match self {
                Self::Scalar => banded::scan_off::<Scalar, 4>(queries, ranks, rows, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx2 => x86::off_bands_avx2(queries, ranks, rows, out),
                #[cfg(target_arch = "x86_64")]
                Self::AvxVnni => x86::off_bands_avx_vnni(queries, ranks, rows, out),
                #[cfg(target_arch = "x86_64")]
                Self::Avx512Vnni => x86::off_bands_avx512_vnni(queries, ranks, rows, out),
                #[cfg(target_arch = "aarch64")]
                Self::Neon => banded::scan_off::<super::neon::Neon, 6>(queries, ranks, rows, out),
            }
        }
    }

    fn assert_available(self) {
        assert!(self <= Self::detected() || self.is_available(), "this machine has no {self:?} instructions");
    }
}

/// The generic scan compiled for each set of instructions, with the tile that fits its registers.
#[cfg(target_arch = "x86_64")]
mod x86 {
    use std::ops::Range;

    use super::super::banded::{self, BandQuery, BandTop2, BandedRows, NearestQueries};
    use super::super::cells::CellRows;
    use super::super::x86::{Avx2, Avx512Vnni, AvxVnni};
    use super::super::{PackedDescriptors, Top2, kernel, scalar};
    use crate::math::Grouped;
    use crate::scene::Descriptor;

    macro_rules! compile {
        ($features:literal, $kernel:ty, $queries:literal, $groups:literal, $one_way:ident, $both_ways:ident) => {
            #[target_feature(enable = $features)]
            pub(super) fn $one_way(queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<Top2>) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { kernel::top2::<$kernel, $queries, $groups>(queries, packed, out) }
            }

            #[target_feature(enable = $features)]
            pub(super) fn $both_ways(
                queries: &[Descriptor],
                packed: &PackedDescriptors,
                of_queries: &mut Vec<Top2>,
                of_rows: &mut Vec<Top2>,
            ) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { kernel::top2_both::<$kernel, $queries, $groups>(queries, packed, of_queries, of_rows) }
            }
        };
    }

    macro_rules! compile_celled {
        (
            $features:literal, $kernel:ty, $queries:literal, $groups:literal, $distances:ident, $in_cells:ident,
            $of_cells:ident
        ) => {
            /// Four groups at a time: one alone waits for its own sums.
            #[target_feature(enable = $features)]
            pub(super) fn $of_cells(query: &Descriptor, cells: &[u32], rows: &CellRows) -> Option<Top2> {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { kernel::top2_of_cells::<$kernel, 4>(query, cells, rows) }
            }

            #[target_feature(enable = $features)]
            pub(super) fn $distances(queries: &[Descriptor], packed: &PackedDescriptors, out: &mut Vec<u32>) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { kernel::distances_sq::<$kernel, $queries>(queries, packed, out) }
            }

            #[target_feature(enable = $features)]
            pub(super) fn $in_cells(
                queries: &[Descriptor],
                visitors: &Grouped<u32>,
                rows: &CellRows,
                of_queries: &mut Vec<Option<Top2>>,
                of_slots: &mut Vec<Option<Top2>>,
            ) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe {
                    kernel::top2_in_cells::<$kernel, $queries, $groups>(queries, visitors, rows, of_queries, of_slots)
                }
            }
        };
    }

    macro_rules! compile_banded {
        ($features:literal, $kernel:ty, $queries:literal, $in_bands:ident, $off_bands:ident) => {
            #[target_feature(enable = $features)]
            pub(super) fn $in_bands(
                queries: &[BandQuery<'_>],
                windows: &[Range<u32>],
                rows: &BandedRows,
                out: &mut Vec<BandTop2>,
                of_rows: &mut NearestQueries,
            ) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { banded::scan::<$kernel, $queries>(queries, windows, rows, out, of_rows) }
            }

            #[target_feature(enable = $features)]
            pub(super) fn $off_bands(
                queries: &[BandQuery<'_>],
                ranks: &[u32],
                rows: &BandedRows,
                out: &mut Vec<Option<u32>>,
            ) {
                // SAFETY: this function is only called on machines that have its features.
                unsafe { banded::scan_off::<$kernel, $queries>(queries, ranks, rows, out) }
            }
        };
    }

    #[target_feature(enable = "avx2")]
    pub(super) fn least_distance_sq_avx2(
        query: &Descriptor,
        descriptors: &[Descriptor],
        indices: &[u32],
    ) -> Option<u32> {
        scalar::least_distance_sq(query, descriptors, indices)
    }

    compile_celled!("avx2", Avx2, 4, 1, distances_avx2, in_cells_avx2, of_cells_avx2);
    compile_celled!("avx2,avxvnni", AvxVnni, 5, 1, distances_avx_vnni, in_cells_avx_vnni, of_cells_avx_vnni);
    compile_celled!(
        "avx512f,avx512bw,avx512vnni",
        Avx512Vnni,
        6,
        2,
        distances_avx512_vnni,
        in_cells_avx512_vnni,
        of_cells_avx512_vnni
    );
    compile_banded!("avx2", Avx2, 4, in_bands_avx2, off_bands_avx2);
    compile_banded!("avx2,avxvnni", AvxVnni, 4, in_bands_avx_vnni, off_bands_avx_vnni);
    compile_banded!("avx512f,avx512bw,avx512vnni", Avx512Vnni, 8, in_bands_avx512_vnni, off_bands_avx512_vnni);
    compile!("avx2", Avx2, 4, 1, top2_avx2, top2_both_avx2);
    compile!("avx2,avxvnni", AvxVnni, 5, 1, top2_avx_vnni, top2_both_avx_vnni);
    compile!("avx512f,avx512bw,avx512vnni", Avx512Vnni, 6, 2, top2_avx512_vnni, top2_both_avx512_vnni);
}
