//! A small seeded generator. Streams are derived from (run seed, stage, item ids), never shared between threads, so that
//! results do not depend on the order of work.

/// PCG-XSH-RR 64/32 (O'Neill, "PCG: A family of simple fast space-efficient statistically good algorithms for random
/// number generation", 2014).
#[derive(Clone, Debug)]
pub struct Rng {
    state: u64,
    increment: u64,
}

/// The finaliser of SplitMix64 (Steele, Lea, Flood, "Fast splittable pseudorandom number generators", 2014).
fn mix(mut z: u64) -> u64 {
    z = z.wrapping_add(0x9e37_79b9_7f4a_7c15);
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

impl Rng {
    /// The stream of these parts, for example `[run seed, stage, image, image]`.
    pub fn from_parts(parts: &[u64]) -> Self {
        let mut key = 0;
        for &part in parts {
            key = mix(key ^ part);
        }
        let mut rng = Self { state: mix(key), increment: mix(key ^ 1) | 1 };
        rng.next_u32();
        rng
    }

    /// 32 uniform bits.
    #[inline]
    pub fn next_u32(&mut self) -> u32 {
        let old = self.state;
        self.state = old.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(self.increment);
        let shifted = (((old >> 18) ^ old) >> 27) as u32;
        shifted.rotate_right((old >> 59) as u32)
    }

    /// A uniform integer below `bound` (which must be positive), by Lemire's multiply-shift; its bias is below 2^-32.
    #[inline]
    pub fn below(&mut self, bound: usize) -> usize {
        debug_assert!(bound > 0);
        ((u64::from(self.next_u32()) * bound as u64) >> 32) as usize
    }

    /// A uniform number in [0, 1).
    #[inline]
    pub fn uniform(&mut self) -> f64 {
        let high = u64::from(self.next_u32() >> 5);
        let low = u64::from(self.next_u32() >> 6);
        ((high << 26) | low) as f64 / (1u64 << 53) as f64
    }

    /// A uniform number in [low, high).
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// A standard normal number (Box-Muller).
    pub fn normal(&mut self) -> f64 {
        let radius = (-2.0 * (1.0 - self.uniform()).ln()).sqrt();
        radius * (std::f64::consts::TAU * self.uniform()).cos()
    }

    /// `N` distinct indices below `bound`, in random order; `bound` must be at least `N`.
    pub fn distinct<const N: usize>(&mut self, bound: usize) -> [usize; N] {
        debug_assert!(bound >= N);
        let mut chosen = [0; N];
        for filled in 0..N {
            chosen[filled] = loop {
                let candidate = self.below(bound);
                if !chosen[..filled].contains(&candidate) {
                    break candidate;
                }
            };
        }
        chosen
    }

    /// Shuffles in place (Fisher-Yates).
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for last in (1..items.len()).rev() {
            items.swap(last, self.below(last + 1));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn streams_repeat_and_differ() {
        let draw = |parts: &[u64]| {
            (0..4)
                .map({
                    let mut rng = Rng::from_parts(parts);
                    move |_| rng.next_u32()
                })
                .collect::<Vec<_>>()
        };
        assert_eq!(draw(&[1, 2]), draw(&[1, 2]));
        assert_ne!(draw(&[1, 2]), draw(&[2, 1]));
    }

    #[test]
    fn moments_are_right() {
        let mut rng = Rng::from_parts(&[7]);
        let n = 100_000;
        let (mut sum, mut squares, mut uniform) = (0.0, 0.0, 0.0);
        for _ in 0..n {
            let x = rng.normal();
            sum += x;
            squares += x * x;
            uniform += rng.uniform();
        }
        assert!((sum / f64::from(n)).abs() < 0.02);
        assert!((squares / f64::from(n) - 1.0).abs() < 0.03);
        assert!((uniform / f64::from(n) - 0.5).abs() < 0.01);
    }
}
