//! The counters of a pager, and how full its store is.
//!
//! Invariants: 1. [`PagerStats`] is the only list of counters: `metrics.jsonl` and `summary.json` write it under the names below,
//! and the state of a run holds it; 2. the order of its fields is the order of the bytes in the state of a run, so a new counter
//! goes to the end, with a new version of the state.

use super::plan::bound::FewestReads;
use crate::page::versions::paged_store::PageTraffic;
use serde::{Deserialize, Serialize};

/// Totals over all lives of a run; subtract two of them for one step. Without a spill directory only commits write.
#[derive(Debug, Clone, Copy, Default, PartialEq, Serialize, Deserialize)]
pub struct PagerStats {
    /// Bytes read from the store.
    pub bytes_read: u64,
    pub bytes_written: u64,
    /// Pages read from the store.
    pub pages_read: u64,
    pub pages_written: u64,
    pub pages_needed: u64,
    /// Needed pages that were in memory.
    #[serde(rename = "page_hits")]
    pub hits: u64,
    /// Needed pages that were not in memory for the step: on their way, being written back, or still to be read.
    #[serde(rename = "page_misses")]
    pub misses: u64,
    /// Misses that the plan of a planned step had left out.
    pub late_misses: u64,
    /// Pages that lost their frame.
    pub evictions: u64,
    /// Seconds that steps waited for the store, commits between them included.
    pub stall_seconds: f64,
    /// The most pages pinned at once.
    #[serde(rename = "pages_pinned_max")]
    pub pinned_max: usize,
    /// Misses that were not even on their way.
    #[serde(rename = "page_absent")]
    pub absent: u64,
    /// Pages that evaluation, export and a look at the views before the first step needed.
    pub other_pages_needed: u64,
    /// Bytes read for those pages.
    pub other_bytes_read: u64,
    /// Seconds that evaluation, export, such a look and the import waited for the store.
    pub other_stall_seconds: f64,
    /// Bytes that a cache of this size which knows the future would have read for the steps
    /// ([`super::plan::bound::FewestReads`]); to compare with `bytes_read` less `other_bytes_read`.
    pub belady_bytes_read: u64,
}

/// The counters as a pager keeps them.
#[derive(Debug, Default)]
pub(super) struct Counters {
    /// All counters, but for this life of the run without those of the store and of the bound: [`Counters::total`] adds them.
    pub stats: PagerStats,
    /// Seconds that steps lost to commits beside them.
    pub commit_seconds: f64,
    /// What a cache that knows the future would have read for the steps of this life.
    pub bound: FewestReads,
    /// Pinned pages that no batch uses: a tier above has newer bytes of them.
    pub held: usize,
}

impl Counters {
    /// Notes that this many pages are pinned.
    pub fn count_pinned(&mut self, pinned: usize) {
        self.stats.pinned_max = self.stats.pinned_max.max(pinned.saturating_sub(self.held));
    }

    /// The counters over all lives, with what the store moved in this one.
    pub fn total(&self, traffic: PageTraffic) -> PagerStats {
        PagerStats {
            bytes_read: self.stats.bytes_read + traffic.bytes_read,
            bytes_written: self.stats.bytes_written + traffic.bytes_written,
            belady_bytes_read: self.stats.belady_bytes_read + self.bound.bytes(),
            ..self.stats
        }
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct SlotSpace {
    pub total: u64,
    /// Those that may be written at once.
    pub free: u64,
    /// Those with past versions, which commits make free.
    pub retired: u64,
    /// What the drive must have for more of them.
    pub segment_bytes: u64,
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::ids::PageNo;
    use crate::page::format::encoding;

    /// Other files hold them: bytes in the state of a run, names in the files of metrics.
    #[test]
    fn the_order_of_the_bytes_and_the_names_stay() {
        const NAMES: &str = "bytes_read bytes_written pages_read pages_written pages_needed page_hits page_misses late_misses \
                             evictions stall_seconds pages_pinned_max page_absent other_pages_needed other_bytes_read \
                             other_stall_seconds belady_bytes_read";
        let is_time = |name: &str| name.ends_with("_seconds");
        let named = NAMES.split_whitespace().zip(1u64..).map(|(name, value)| {
            let value = if is_time(name) { (value as f64).into() } else { value.into() };
            (name.to_string(), value)
        });
        let json = serde_json::Value::Object(named.collect());
        let stats: PagerStats = serde_json::from_value(json.clone()).unwrap();
        assert_eq!(serde_json::to_value(stats).unwrap(), json);
        let ascending = ([1u64, 2, 3, 4, 5, 6, 7, 8, 9], 10.0f64, [11u64, 12, 13, 14], 15.0f64, 16u64);
        assert_eq!(encoding::to_bytes(&stats).unwrap(), encoding::to_bytes(&ascending).unwrap());
    }

    #[test]
    fn restored_counters_continue_in_the_next_life() {
        let past = PagerStats { bytes_read: 5, misses: 3, belady_bytes_read: 7, ..PagerStats::default() };
        let mut counters = Counters { stats: past, ..Counters::default() };
        assert_eq!(counters.total(PageTraffic::default()), past);
        counters.bound.step(1, [(PageNo(0), 100)].into_iter());
        counters.stats.misses += 1;
        let traffic = PageTraffic { bytes_read: 10, ..PageTraffic::default() };
        let now = counters.total(traffic);
        assert_eq!((now.bytes_read, now.misses, now.belady_bytes_read), (15, 4, 107));
    }
}
