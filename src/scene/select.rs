//! Finds the key of a given rank among streamed keys, exactly, in 512 KiB.
//!
//! Invariants: 1. the order of the keys does not matter; 2. at most four passes.

const PASS_BITS: u32 = 16;

/// A search in passes: call [`RankSearch::count`] for every key, then [`RankSearch::next_pass`], until done.
#[derive(Debug, Clone)]
pub struct RankSearch {
    /// Rank among the keys that share the known prefix.
    rank: u64,
    /// The known leading bits, in place.
    prefix: u64,
    known: u32,
    bins: Vec<u64>,
    exists: bool,
}

impl RankSearch {
    /// Searches for the key with `rank` smaller ones among `count` keys, all different.
    pub fn new(rank: u64, count: u64) -> RankSearch {
        let exists = rank < count;
        RankSearch { rank, prefix: 0, known: if exists { 0 } else { u64::BITS }, bins: vec![0; 1 << PASS_BITS], exists }
    }

    pub fn is_done(&self) -> bool {
        self.known == u64::BITS
    }

    #[inline]
    pub fn count(&mut self, key: u64) {
        // In the first pass nothing is known, and a shift by 64 would be no shift.
        if self.known == 0 || (key ^ self.prefix) >> (u64::BITS - self.known) == 0 {
            let bin = key >> (u64::BITS - PASS_BITS - self.known) & ((1 << PASS_BITS) - 1);
            self.bins[bin as usize] += 1;
        }
    }

    pub fn next_pass(&mut self) {
        let mut bin = 0;
        while bin + 1 < self.bins.len() && self.rank >= self.bins[bin] {
            self.rank -= self.bins[bin];
            bin += 1;
        }
        self.known += PASS_BITS;
        self.prefix |= (bin as u64) << (u64::BITS - self.known);
        self.bins.fill(0);
    }

    /// The key found; `None` before the last pass, or if there are not more keys than its rank.
    pub fn key(&self) -> Option<u64> {
        (self.exists && self.is_done()).then_some(self.prefix)
    }
}

/// Unsigned key in the order of [`f32::total_cmp`].
#[inline(always)]
pub fn float_key(x: f32) -> u32 {
    let bits = x.to_bits();
    // Negative: flip all bits, so that larger magnitudes come first. Positive: flip only the sign.
    bits ^ (((bits as i32 >> 31) as u32) | 0x8000_0000)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    #[test]
    fn every_rank_is_found() {
        let mut draws = Stream::new(1, Purpose::Test, 5, 5);
        // Three values in the upper half, so that the lower half decides.
        let mut keys: Vec<u64> = (0..300).map(|i| draws.below(3) << 40 | i).collect();
        let mut want = keys.clone();
        want.sort_unstable();
        draws.shuffle(&mut keys);
        for (rank, &want) in want.iter().enumerate() {
            let mut search = RankSearch::new(rank as u64, 300);
            while !search.is_done() {
                assert_eq!(search.key(), None);
                keys.iter().for_each(|&k| search.count(k));
                search.next_pass();
            }
            assert_eq!(search.key(), Some(want));
        }
        assert_eq!(RankSearch::new(300, 300).key(), None);
    }

    #[test]
    fn float_keys_order_like_total_cmp() {
        let values = [f32::NEG_INFINITY, -2.0, -1e-40, -0.0, 0.0, 1e-40, 0.5, 3.0, f32::INFINITY, f32::NAN];
        assert!(values.windows(2).all(|w| float_key(w[0]) < float_key(w[1])));
    }
}
