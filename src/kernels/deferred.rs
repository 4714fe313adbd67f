//! Deferred Adam of single values in f32, with its tables as words: the twin of `shaders/shared/deferred.wgsl`.
//!
//! The CPU's own optimizer is in `optim`, in other words and with a direct sum in f64. This form is what devices
//! compute; the tests judge both by dense Adam in f64.
//!
//! Invariant: a device and this twin read the same words.

use crate::scene::optimizer_numbers::{RunNumbers, SeriesSums};

/// Words of the tables before their entries.
const HEADER_WORDS: usize = 16;
/// Steps of a movement without end.
pub const FOR_EVER: u32 = u32::MAX;

/// The tables of a run, as a device holds them: a header of places, lengths and numbers, then the tables.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeferredTables {
    words: Vec<u32>,
}

impl DeferredTables {
    /// The tables with these numbers.
    pub fn new(numbers: &RunNumbers) -> DeferredTables {
        let mut words = vec![0; HEADER_WORDS];
        let mut put = |place: usize, entries: usize, floats: &[f32]| {
            (words[place], words[place + 1]) = (words.len() as u32, entries as u32);
            words.extend(floats.iter().map(|x| x.to_bits()));
        };
        put(0, numbers.limits.len(), numbers.limits.as_flattened());
        put(2, numbers.bias.len(), numbers.bias.as_flattened());
        put(4, numbers.means_factor.len(), &numbers.means_factor);
        put(6, numbers.decay_powers.len().saturating_sub(1), numbers.decay_powers.as_flattened());
        put(8, numbers.decays.len(), numbers.decays.as_flattened());
        let [one_minus_beta1, one_minus_beta2] = numbers.one_minus_betas;
        let [low, high] = numbers.log_scales;
        let floats = [numbers.eps, numbers.floor, one_minus_beta1, one_minus_beta2, low, high];
        words[10..HEADER_WORDS].copy_from_slice(&floats.map(f32::to_bits));
        DeferredTables { words }
    }

    /// The words, for a device.
    pub fn words(&self) -> &[u32] {
        &self.words
    }

    fn float(&self, at: usize) -> f32 {
        f32::from_bits(self.words[at])
    }

    /// Entry `i` of the table at `place` of the header, of `N` floats; beyond its end, the last.
    fn entry<const N: usize>(&self, place: usize, i: usize) -> [f32; N] {
        let first = self.words[place] as usize + N * i.min(self.words[place + 1] as usize - 1);
        std::array::from_fn(|k| self.float(first + k))
    }

    /// Adam's epsilon.
    pub fn eps(&self) -> f32 {
        self.float(10)
    }

    /// 1 - beta1, 1 - beta2.
    pub fn one_minus_betas(&self) -> [f32; 2] {
        [self.float(12), self.float(13)]
    }

    /// Least and greatest log-scale that an update leaves.
    pub fn log_scales(&self) -> [f32; 2] {
        [self.float(14), self.float(15)]
    }

    /// Decay of the moments over `k` steps: factor of the first, factor of the second, share that the second loses.
    pub fn decay(&self, k: u32) -> [f32; 3] {
        self.entry(8, k as usize)
    }

    /// The movement at unit base rate, term by term, smallest terms first.
    fn direct_sum(&self, m: f32, v: f32, stamp: u32, end: u32, of_means: bool) -> f32 {
        let (root, terms) = (v.sqrt(), (end - stamp).min(self.words[7]));
        let decay_powers = self.words[6] as usize;
        let mut sum = 0.0;
        for left in (1..=terms as usize).rev() {
            let t = stamp as usize + left;
            let [inv_bias1, inv_root] = self.entry(2, t);
            let [decay1, decay2] = [0, 1].map(|k| self.float(decay_powers + 2 * left + k));
            let [rate] = if of_means { self.entry(4, t - 1) } else { [1.0] };
            sum += rate * inv_bias1 * decay1 * m / (root * decay2 * inv_root + self.eps());
        }
        sum
    }

    /// The value of a state of `stamp` steps, with these moments, after `end` steps ([`FOR_EVER`]: its limit). `recent`
    /// holds the sums of step `end` by missed steps.
    pub fn evaluate(
        &self,
        [value, m, v]: [f32; 3],
        stamp: u32,
        end: u32,
        recent: &[SeriesSums],
        of_means: bool,
        rate: f32,
    ) -> f32 {
        if stamp >= end || m == 0.0 {
            return value;
        }
        if v <= self.float(11) {
            return flush(value - self.direct_sum(m, v, stamp, end, of_means) * rate);
        }
        let sums: SeriesSums = match recent.get((end - stamp) as usize) {
            Some(sums) => *sums,
            None => self.entry(0, stamp as usize),
        };
        let [first, second, third] = if of_means { [sums[0], sums[1], sums[2]] } else { [sums[4], sums[5], sums[6]] };
        let inv = 1.0 / v.sqrt();
        let e = self.eps() * inv;
        flush(value - (m * inv) * (first - e * (second - e * third)) * rate)
    }
}

/// Flushes values below the smallest normal float to zero.
pub fn flush(x: f32) -> f32 {
    if x.abs() < f32::MIN_POSITIVE { 0.0 } else { x }
}
