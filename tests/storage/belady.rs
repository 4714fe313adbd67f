//! The incremental lower bound on page reads equals the reads of the cache that evicts by farthest next use.

use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::plan::bound::FewestReads;
use gsscale::paging::plan::cache_model::{CacheModel, StepChange};

/// Reads of the cache that evicts by farthest next use: from an empty cache, or with first pages of its own choice.
fn model(steps: &[Vec<PageNo>], frames: usize, pages: u32, is_warm: bool) -> u64 {
    let next = |page: PageNo, from: usize| (from..steps.len()).find(|&s| steps[s].contains(&page)).map(|s| s as u32);
    let mut cache = CacheModel::new(frames, EvictPolicy::FarthestNextUse);
    let mut change = StepChange::default();
    let mut read = 0;
    let mut first: Vec<PageNo> = (0..pages).map(PageNo).collect();
    first.sort_by_key(|&page| next(page, 0).unwrap_or(u32::MAX));
    first.truncate(if is_warm { frames } else { 0 });
    for (step, pages) in std::iter::once(&first).chain(steps).enumerate() {
        cache.step(step as u32, pages, |page| next(page, step).map(|s| s + 1), &mut change).unwrap();
        read += if step > 0 { change.admit.len() as u64 } else { 0 };
    }
    read
}

#[test]
fn counts_what_the_cache_that_knows_the_future_reads() {
    let mut draws = Stream::new(5, Purpose::Test, 1, 1);
    for round in 0..300 {
        let pages = 4 + draws.below(20) as u32;
        let frames = 2 + draws.below(u64::from(pages)) as usize;
        let steps: Vec<Vec<PageNo>> = (0..40)
            .map(|_| {
                let mut all: Vec<PageNo> = (0..pages).map(PageNo).collect();
                let count = 1 + draws.below(frames.min(pages as usize) as u64) as usize;
                (0..count).for_each(|i| all.swap(i, i + draws.below(u64::from(pages) - i as u64) as usize));
                all.truncate(count);
                all
            })
            .collect();
        for is_warm in [false, true] {
            let mut bound = FewestReads::default();
            (0..if is_warm { pages } else { 0 }).for_each(|p| bound.add(PageNo(p)));
            steps.iter().for_each(|pages| bound.step(frames, pages.iter().map(|&p| (p, 10))));
            let want = model(&steps, frames, pages, is_warm);
            assert_eq!((bound.pages(), bound.bytes()), (want, 10 * want), "round {round}, {frames} frames");
        }
    }
}

#[test]
fn pages_made_in_memory_are_not_read() {
    let mut bound = FewestReads::default();
    bound.add(PageNo(0));
    bound.step(2, [(PageNo(0), 1)].into_iter());
    bound.add(PageNo(1));
    bound.step(2, [(PageNo(0), 1), (PageNo(1), 1)].into_iter());
    assert_eq!(bound.pages(), 0);
    // The two frames hold other pages, so the page is read.
    bound.step(2, [(PageNo(2), 7)].into_iter());
    assert_eq!((bound.pages(), bound.bytes()), (1, 7));
}

/// The fewest pages that any cache reads when the number of frames differs from step to step: a search over all
/// contents.
fn fewest(steps: &[(usize, u32)], pages: u32) -> u64 {
    let mut reads: Vec<Option<u64>> = vec![None; 1 << pages];
    reads[0] = Some(0);
    for &(frames, needed) in steps {
        let mut next = vec![None; 1 << pages];
        for (held, read) in reads.iter().enumerate().filter_map(|(held, read)| read.map(|r| (held as u32, r))) {
            let then = read + u64::from((needed & !held).count_ones());
            for content in 0..1u32 << pages {
                let is_possible = content & needed == needed && content & !(held | needed) == 0;
                if is_possible && content.count_ones() as usize <= frames {
                    let best = &mut next[content as usize];
                    *best = Some(best.map_or(then, |b: u64| b.min(then)));
                }
            }
        }
        reads = next;
    }
    reads.into_iter().flatten().min().unwrap()
}

#[test]
fn frames_may_be_taken_away_and_given_back_between_steps() {
    let mut draws = Stream::new(6, Purpose::Test, 1, 1);
    let mut differs = 0;
    for round in 0..200 {
        let pages = 6;
        let mut frames = 5;
        let steps: Vec<(usize, u32)> = (0..14)
            .map(|_| {
                frames -= usize::from(frames > 2 && draws.below(3) == 0);
                frames += usize::from(frames < 5 && draws.below(6) == 0);
                let needed = (0..frames).fold(0, |needed, _| needed | 1u32 << draws.below(pages));
                (frames, needed)
            })
            .collect();
        let bound = |frames_at: &dyn Fn(usize) -> usize| {
            let mut bound = FewestReads::default();
            for &(frames, needed) in &steps {
                let list = (0..pages as u32).filter(|page| needed >> page & 1 == 1).map(|page| (PageNo(page), 1));
                bound.step(frames_at(frames), list);
            }
            bound.pages()
        };
        assert_eq!(bound(&|frames| frames), fewest(&steps, pages as u32), "round {round}: {steps:?}");
        differs += u32::from(bound(&|frames| frames) != bound(&|_| 5));
    }
    assert!(differs > 20, "in {differs} rounds the frames that were taken away made a difference");
}
