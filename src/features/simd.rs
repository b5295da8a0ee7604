//! Choice of instruction set. A kernel is one always-inlined body; `stamp!` compiles it once portably and once each for
//! AVX2 with FMA and for AVX-512, and picks at run time. The compiler vectorises each copy for its own registers.

/// The instruction set that kernels use. Only [`Isa::detect`] and, in tests, [`Isa::available`] make values above
/// `Portable`, and only those that this processor has; the `unsafe` calls in `stamp!` rest on that.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Isa(pub(super) Level);

/// See [`Isa`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Level {
    Portable,
    #[cfg(target_arch = "x86_64")]
    Avx2,
    #[cfg(target_arch = "x86_64")]
    Avx512,
}

impl Isa {
    /// The best set of this processor.
    pub(super) fn detect() -> Self {
        #[cfg(target_arch = "x86_64")]
        if is_x86_feature_detected!("avx2") && is_x86_feature_detected!("fma") {
            let wide = is_x86_feature_detected!("avx512f")
                && is_x86_feature_detected!("avx512vl")
                && is_x86_feature_detected!("avx512bw")
                && is_x86_feature_detected!("avx512dq");
            return Self(if wide { Level::Avx512 } else { Level::Avx2 });
        }
        Self(Level::Portable)
    }

    /// Whether there are 32 registers of the set's widest vectors, not 16.
    pub(super) fn has_many_registers(self) -> bool {
        match self.0 {
            Level::Portable => cfg!(target_arch = "aarch64"),
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => false,
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => true,
        }
    }

    /// Every set of this processor, the portable one first.
    #[cfg(test)]
    pub(super) fn available() -> Vec<Self> {
        match Self::detect().0 {
            Level::Portable => vec![Self(Level::Portable)],
            #[cfg(target_arch = "x86_64")]
            Level::Avx2 => vec![Self(Level::Portable), Self(Level::Avx2)],
            #[cfg(target_arch = "x86_64")]
            Level::Avx512 => vec![Self(Level::Portable), Self(Level::Avx2), Self(Level::Avx512)],
        }
    }
}

/// `a * b + c`, fused where the instruction set has it (elsewhere fusing would be a slow library call).
#[inline(always)]
pub(super) fn mul_add<const FMA: bool>(a: f32, b: f32, c: f32) -> f32 {
    if FMA || cfg!(target_arch = "aarch64") { a.mul_add(b, c) } else { a * b + c }
}

/// The whole number nearest to a number of [0, 2^22]. Adding 2^23 leaves it in the low bits of the sum; an `as` conversion
/// checks for values out of range, one lane after the other, and does not vectorise.
#[inline(always)]
pub(super) fn whole_number(value: f32) -> u32 {
    const SHIFT: f32 = 8_388_608.0;
    (value + SHIFT).to_bits() & 0x7f_ffff
}

/// Defines `fn name(isa, arguments)` that runs `body::<FMA>(arguments)` compiled for `isa`.
macro_rules! stamp {
    ($(#[$doc:meta])* $name:ident => $body:ident ( $($arg:ident : $kind:ty),* $(,)? ) $(-> $out:ty)?) => {
        $(#[$doc])*
        #[allow(clippy::too_many_arguments)]
        pub(super) fn $name(isa: $crate::features::simd::Isa, $($arg: $kind),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2,fma")]
            #[allow(clippy::too_many_arguments)]
            fn avx2($($arg: $kind),*) $(-> $out)? {
                $body::<true>($($arg),*)
            }
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f,avx512vl,avx512bw,avx512dq,avx2,fma")]
            #[allow(clippy::too_many_arguments)]
            fn avx512($($arg: $kind),*) $(-> $out)? {
                $body::<true>($($arg),*)
            }
            match isa.0 {
                $crate::features::simd::Level::Portable => $body::<false>($($arg),*),
                #[cfg(target_arch = "x86_64")]
                // SAFETY: `Isa` holds this level only where the processor was found to have these features.
                $crate::features::simd::Level::Avx2 => unsafe { avx2($($arg),*) },
                #[cfg(target_arch = "x86_64")]
                // SAFETY: as above.
                $crate::features::simd::Level::Avx512 => unsafe { avx512($($arg),*) },
            }
        }
    };
}
pub(super) use stamp;
