//! The codebook of an attribute: 256 values, the nearest of which replaces each value. The codes are dense where values are dense.
//!
//! Invariants: 1. the smallest and the largest value are kept, so no value is off by more than half the distance between its
//! neighbours in the codebook; 2. the codebook depends on the values alone, not on their order.

pub const CODES: usize = 256;
/// Bins of the histogram that places the first codes.
const BINS: usize = 4096;
/// Rounds of Lloyd's algorithm. The first codes are near the best already.
const ROUNDS: usize = 12;

/// Ascending values.
#[derive(Debug, Clone, PartialEq)]
pub struct Codebook(Vec<f32>);

impl Codebook {
    /// The codebook of finite `values`, which this function sorts.
    pub fn of(values: &mut [f32]) -> Codebook {
        values.sort_unstable_by(f32::total_cmp);
        let (Some(&least), Some(&most)) = (values.first(), values.last()) else { return Codebook(vec![0.0; CODES]) };
        let mut codes = spread(values, least, most);
        let mut sums = Vec::with_capacity(values.len() + 1);
        sums.push(0.0);
        let mut sum = 0.0;
        for &value in &*values {
            sum += f64::from(value);
            sums.push(sum);
        }
        for _ in 0..ROUNDS {
            let mut from = 0;
            for i in 0..CODES {
                let to = if i + 1 == CODES {
                    values.len()
                } else {
                    let border = (f64::from(codes[i]) + f64::from(codes[i + 1])) / 2.0;
                    from + values[from..].partition_point(|&v| f64::from(v) <= border)
                };
                if to > from && i > 0 && i + 1 < CODES {
                    codes[i] = ((sums[to] - sums[from]) / (to - from) as f64) as f32;
                }
                from = to;
            }
        }
        codes.sort_unstable_by(f32::total_cmp);
        Codebook(codes)
    }

    /// The code of the nearest value; the lower code if two are equally near.
    pub fn code(&self, value: f32) -> u8 {
        let above = self.0.partition_point(|&v| v < value).min(CODES - 1);
        let below = above.saturating_sub(1);
        let off = |i: usize| (f64::from(self.0[i]) - f64::from(value)).abs();
        (if off(below) <= off(above) { below } else { above }) as u8
    }

    pub fn values(&self) -> &[f32] {
        &self.0
    }
}

/// Initial codes. Their density is proportional to the cube root of the density of values, which minimises the squared error (Panter
/// and Dite).
fn spread(values: &[f32], least: f32, most: f32) -> Vec<f32> {
    let (low, width) = (f64::from(least), (f64::from(most) - f64::from(least)) / BINS as f64);
    let mut counts = vec![0u32; BINS];
    for &value in values {
        let bin = ((f64::from(value) - low) / width) as usize;
        counts[bin.min(BINS - 1)] += 1;
    }
    let weights: Vec<f64> = counts.iter().map(|&n| libm::cbrt(f64::from(n))).collect();
    let step = weights.iter().sum::<f64>() / (CODES - 1) as f64;
    let (mut codes, mut passed, mut bin) = (vec![least], 0.0, 0);
    while codes.len() < CODES - 1 {
        let at = codes.len() as f64 * step;
        while bin + 1 < BINS && passed + weights[bin] < at {
            passed += weights[bin];
            bin += 1;
        }
        let within = if weights[bin] > 0.0 { ((at - passed) / weights[bin]).clamp(0.0, 1.0) } else { 0.0 };
        codes.push(((low + (bin as f64 + within) * width) as f32).clamp(least, most));
    }
    codes.push(most);
    codes
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::mix64;

    #[test]
    fn values_are_near_their_codes() {
        let uniform = |i: u64| (mix64(i) >> 40) as f32 / (1 << 24) as f32;
        let normal: Vec<f32> = (0..50_000).map(|i| (0..12).map(|k| uniform(12 * i + k)).sum::<f32>() - 6.0).collect();
        let book = Codebook::of(&mut normal.clone());
        let error = |v: f32| f64::from(book.values()[usize::from(book.code(v))]) - f64::from(v);
        let mean_square = normal.iter().map(|&v| error(v).powi(2)).sum::<f64>() / normal.len() as f64;
        // The least error of 256 codes for a normal distribution is sqrt(3) pi / 2 / 256^2 = 4.2e-5 (Panter and Dite). The codebook
        // exceeds it by a quarter, because it keeps both extremes and takes few rounds.
        assert!(mean_square < 5.5e-5, "{mean_square}");
        assert!(book.values().is_sorted());
        let reversed = Codebook::of(&mut normal.iter().rev().copied().collect::<Vec<_>>());
        assert_eq!(book, reversed);
    }

    #[test]
    fn few_or_equal_or_extreme_values_are_kept() {
        for given in [vec![], vec![1.5], vec![1.5; 9], vec![-2.0, 0.25, 7.0], vec![-1e30, 0.0, 1e30]] {
            let book = Codebook::of(&mut given.clone());
            assert_eq!(book.values().len(), CODES);
            assert!(book.values().is_sorted() && book.values().iter().all(|v| v.is_finite()));
            for value in given {
                let off = (book.values()[usize::from(book.code(value))] - value).abs();
                assert!(off <= 4e-3 * value.abs().max(1.0), "{value} is off by {off}");
            }
        }
    }
}
