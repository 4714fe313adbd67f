//! Random draws as pure functions of their purpose.
//!
//! Invariants: 1. a [`Stream`] is keyed by (seed, purpose, two numbers), never by call order or thread, so a draw for
//! one Gaussian does not depend on who draws first; 2. only integer arithmetic, + - * / sqrt and `libm` are used, so
//! the bits are the same on every platform.

/// Purpose of a draw. The number is part of the key: never renumber.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[repr(u64)]
pub enum Purpose {
    /// Order of the views in an epoch; keys: epoch, 0.
    ViewOrder = 1,
    /// Initial rotations of Gaussians; keys: uid, 0.
    InitQuat = 2,
    /// Points in the view frusta if the dataset has none; keys: point index, 0.
    InitPoint = 3,
    /// Offsets of the two children of a split; keys: uid of the child, event.
    Split = 4,
    /// The generated city; keys: object, aspect.
    City = 5,
    /// Noise of generated photos; keys: view, pixel row.
    Sensor = 6,
    /// Tests and benchmarks; keys: free.
    Test = 7,
    /// Disturbances of a scene; keys: kind of draw, photo or point.
    Disturb = 8,
    /// Which rows get copies in a round; keys: uid, number of the round.
    Relocation = 9,
    /// Noise on means; keys: uid, step.
    MeanNoise = 10,
    /// Places that descriptions of corners compare; keys: 0, 0.
    CornerPattern = 11,
    /// Patches of photos whose depth is looked for; keys: view, patch.
    SweptPatch = 12,
}

/// Mixes one 64-bit word (the finaliser of SplitMix64: Steele, Lea, Flood 2014, "Fast splittable pseudorandom number
/// generators").
pub fn mix64(mut z: u64) -> u64 {
    z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
    z ^ (z >> 31)
}

/// Hash of several words, order-sensitive.
pub fn hash64(words: &[u64]) -> u64 {
    let mut h = 0x9e37_79b9_7f4a_7c15_u64;
    for &w in words {
        h = mix64(h ^ w).wrapping_add(0x9e37_79b9_7f4a_7c15);
    }
    mix64(h)
}

/// A stream of draws for one key.
#[derive(Debug, Clone)]
pub struct Stream {
    state: u64,
}

impl Stream {
    pub fn new(seed: u64, purpose: Purpose, a: u64, b: u64) -> Self {
        Stream { state: hash64(&[seed, purpose as u64, a, b]) }
    }

    /// Next 64 random bits.
    pub fn next_u64(&mut self) -> u64 {
        self.state = self.state.wrapping_add(0x9e37_79b9_7f4a_7c15);
        mix64(self.state)
    }

    /// Uniform in [0, 1), 53 bits.
    pub fn uniform(&mut self) -> f64 {
        (self.next_u64() >> 11) as f64 * (1.0 / (1u64 << 53) as f64)
    }

    /// Uniform in [low, high).
    pub fn range(&mut self, low: f64, high: f64) -> f64 {
        low + (high - low) * self.uniform()
    }

    /// Uniform integer in 0..n (n > 0), by multiplication; the bias is below n / 2^64.
    pub fn below(&mut self, n: u64) -> u64 {
        ((u128::from(self.next_u64()) * u128::from(n)) >> 64) as u64
    }

    /// Standard normal (Box-Muller).
    pub fn normal(&mut self) -> f64 {
        let u = 1.0 - self.uniform();
        let v = self.uniform();
        libm::sqrt(-2.0 * libm::log(u)) * libm::cos(2.0 * std::f64::consts::PI * v)
    }

    /// Standard normal truncated at `limit` sigmas, by drawing again.
    pub fn normal_within(&mut self, limit: f64) -> f64 {
        loop {
            let x = self.normal();
            if x.abs() <= limit {
                return x;
            }
        }
    }

    /// Fisher-Yates shuffle.
    pub fn shuffle<T>(&mut self, items: &mut [T]) {
        for i in (1..items.len()).rev() {
            let j = self.below(i as u64 + 1) as usize;
            items.swap(i, j);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_stream_depends_on_every_part_of_its_key() {
        let first = Stream::new(1, Purpose::Test, 2, 3).next_u64();
        assert_eq!(first, Stream::new(1, Purpose::Test, 2, 3).next_u64());
        for other in [
            Stream::new(2, Purpose::Test, 2, 3),
            Stream::new(1, Purpose::Split, 2, 3),
            Stream::new(1, Purpose::Test, 3, 2),
            Stream::new(1, Purpose::Test, 2, 4),
        ] {
            assert_ne!(first, other.clone().next_u64());
        }
    }

    #[test]
    fn normal_draws_have_the_right_moments() {
        let mut s = Stream::new(7, Purpose::Test, 0, 0);
        let n = 100_000;
        let draws: Vec<f64> = (0..n).map(|_| s.normal()).collect();
        let mean = draws.iter().sum::<f64>() / f64::from(n);
        let var = draws.iter().map(|x| x * x).sum::<f64>() / f64::from(n);
        // Five standard errors of the mean (1/sqrt n) and of the variance (sqrt(2/n)).
        assert!(mean.abs() < 0.016, "{mean}");
        assert!((var - 1.0).abs() < 0.023, "{var}");
    }
}
