//! The tables of deferred Adam as words, as `shaders/shared/deferred.wgsl` reads them.
//!
//! The CPU's own optimizer is in `optim`. What devices compute from these words is written a second time in
//! `tests/numerics/twins/deferred.rs`, and judged by dense Adam in f64.

use crate::scene::optimizer_numbers::RunNumbers;

/// Words of the tables before their entries.
const HEADER_WORDS: usize = 16;

/// The tables of a run, as a device holds them: a header of places, lengths and numbers, then the tables.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DeferredTables {
    words: Vec<u32>,
}

impl DeferredTables {
    pub fn new(numbers: &RunNumbers) -> DeferredTables {
        let mut words = vec![0; HEADER_WORDS];
        let mut put = |place: usize, entries: usize, floats: &[f32]| {
            (words[place], words[place + 1]) = (words.len() as u32, entries as u32);
            words.extend(floats.iter().map(|x| x.to_bits()));
        };
        put(0, numbers.limits.len(), numbers.limits.as_flattened());
        put(2, numbers.bias.len(), numbers.bias.as_flattened());
        put(4, numbers.rate_factors.len(), numbers.rate_factors.as_flattened());
        put(6, numbers.decay_powers.len().saturating_sub(1), numbers.decay_powers.as_flattened());
        put(8, numbers.decays.len(), numbers.decays.as_flattened());
        let [one_minus_beta1, one_minus_beta2] = numbers.one_minus_betas;
        let [low, high] = numbers.log_scales;
        let floats = [numbers.eps, numbers.floor, one_minus_beta1, one_minus_beta2, low, high];
        words[10..HEADER_WORDS].copy_from_slice(&floats.map(f32::to_bits));
        DeferredTables { words }
    }

    pub fn words(&self) -> &[u32] {
        &self.words
    }
}
