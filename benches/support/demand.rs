//! The pages that each step needed, and a lower bound on the reads of any cache for these steps.
//!
//! Invariant: the bound covers the same interval as the measured cache: from the pages in memory at the start of the
//! measurement to the last step. Bound and measurement differ by eviction decisions only.

use gsscale::base::ids::PageNo;
use gsscale::page::format::slot_header::transfer_bytes;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::pager::Pager;
use gsscale::paging::plan::cache_model::{CacheModel, StepChange};
use gsscale::scene::page_layout::PageLayout;
use gsscale::scene::page_meta::PageMeta;
use std::collections::BTreeSet;

/// The page requests of a measurement.
#[derive(Debug, Default)]
pub struct Demand {
    /// Pages in memory, or being read, before the first step.
    pub resident: Vec<PageNo>,
    /// Pages of each step.
    pub steps: Vec<Vec<PageNo>>,
}

impl Demand {
    /// Starts a measurement.
    pub fn begin(pager: &Pager) -> Demand {
        let all = (0..pager.index().len() as u32).map(PageNo);
        Demand { resident: all.filter(|p| pager.is_in_memory(*p)).collect(), steps: Vec::new() }
    }

    /// Pages and bytes that the optimal cache with `frames` frames reads; `bytes` is the size of each page on the
    /// drive. `None` if a step needs more frames.
    pub fn fewest_reads(&self, frames: usize, bytes: &[u64]) -> Option<(u64, u64)> {
        self.fewest_reads_of(&self.steps, frames, bytes)
    }

    /// As [`Demand::fewest_reads`], over caches that never let a step wait: at the end of a step, the pages of that
    /// step and of the next are in memory. If the two exceed the frames, only the first pages of the next step count,
    /// regardless of what is in memory; the result is then an estimate and may be too high.
    pub fn fewest_reads_in_time(&self, frames: usize, bytes: &[u64]) -> Option<(u64, u64)> {
        let both = |(i, pages): (usize, &Vec<PageNo>)| {
            let coming = self.steps.get(i + 1).into_iter().flatten().filter(|p| !pages.contains(p));
            let room = frames.saturating_sub(pages.len());
            pages.iter().chain(coming.take(room)).copied().collect()
        };
        let steps: Vec<Vec<PageNo>> = self.steps.iter().enumerate().map(both).collect();
        self.fewest_reads_of(&steps, frames, bytes)
    }

    fn fewest_reads_of(&self, steps: &[Vec<PageNo>], frames: usize, bytes: &[u64]) -> Option<(u64, u64)> {
        let mut uses: Vec<Vec<u32>> = vec![Vec::new(); bytes.len()];
        for (pages, step) in steps.iter().zip(1..) {
            pages.iter().for_each(|p| uses[p.index()].push(step));
        }
        let mut cache = CacheModel::new(frames, EvictPolicy::FarthestNextUse);
        let mut change = StepChange::default();
        let mut total = (0, 0);
        // The initial pages enter as an extra step, which is not counted.
        for (step, pages) in std::iter::once(&self.resident).chain(steps).enumerate() {
            let next_use = |page: PageNo| {
                let of_page = &uses[page.index()];
                of_page.get(of_page.partition_point(|&s| s <= step as u32)).copied()
            };
            cache.step(step as u32, pages, next_use, &mut change).ok()?;
            if step > 0 {
                total.0 += change.admit.len() as u64;
                total.1 += change.admit.iter().map(|p| bytes[p.index()]).sum::<u64>();
            }
        }
        Some(total)
    }

    /// Pages that no prefetch could have read in time: if the pages of two consecutive steps exceed the frames, some
    /// reads must wait for evictions after the first step.
    pub fn fewest_absent(&self, frames: usize) -> u64 {
        let mut both: BTreeSet<PageNo> = BTreeSet::new();
        let mut absent = 0;
        for pair in self.steps.windows(2) {
            both.clear();
            both.extend(pair.iter().flatten().copied());
            absent += both.len().saturating_sub(frames) as u64;
        }
        absent
    }
}

/// Bytes of every page on the drive, stored raw.
pub fn page_bytes(index: &[PageMeta]) -> Vec<u64> {
    let layout = |meta: &PageMeta| PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree };
    index.iter().map(|meta| transfer_bytes(layout(meta).bytes()) as u64).collect()
}
