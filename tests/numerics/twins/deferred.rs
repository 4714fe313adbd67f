//! Deferred Adam of single values in f32, from the words of its tables: the twin of `shaders/shared/deferred.wgsl`.
//!
//! Not here: the words (`gsscale::kernels::deferred`), the CPU's own optimizer (`gsscale::optim`).

use gsscale::kernels::deferred::DeferredTables;
use gsscale::scene::optimizer_numbers::SeriesSums;

/// Steps of a movement without end.
pub const FOR_EVER: u32 = u32::MAX;

/// The words of a run's tables, as a device reads them.
#[derive(Debug, Clone, Copy)]
pub struct TableWords<'a>(&'a [u32]);

impl<'a> From<&'a DeferredTables> for TableWords<'a> {
    fn from(tables: &'a DeferredTables) -> TableWords<'a> {
        TableWords(tables.words())
    }
}

impl TableWords<'_> {
    fn float(&self, at: usize) -> f32 {
        f32::from_bits(self.0[at])
    }

    /// Entry `i` of the table at `place` of the header, of `N` floats; beyond its end, the last.
    fn entry<const N: usize>(&self, place: usize, i: usize) -> [f32; N] {
        let first = self.0[place] as usize + N * i.min(self.0[place + 1] as usize - 1);
        std::array::from_fn(|k| self.float(first + k))
    }

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
        let (root, terms) = (v.sqrt(), (end - stamp).min(self.0[7]));
        let decay_powers = self.0[6] as usize;
        let mut sum = 0.0;
        for left in (1..=terms as usize).rev() {
            let t = stamp as usize + left;
            let [inv_bias1, inv_root] = self.entry(2, t);
            let [decay1, decay2] = [0, 1].map(|k| self.float(decay_powers + 2 * left + k));
            let [means, others] = self.entry(4, t - 1);
            let rate = if of_means { means } else { others };
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
