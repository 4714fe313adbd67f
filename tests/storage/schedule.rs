//! The schedule, the cache model and the incremental lower bound on page reads against slow versions: next uses by
//! scanning all steps, fewest reads by trying every choice.

use gsscale::base::ids::PageNo;
use gsscale::base::rng::{Purpose, Stream};
use gsscale::paging::frames::evict::{EvictPolicy, NEVER};
use gsscale::paging::frames::table::FrameTable;
use gsscale::paging::plan::bound::FewestReads;
use gsscale::paging::plan::cache_model::{CacheModel, StepChange, TooFewFrames};
use gsscale::paging::plan::steps::{Plan, USE_BYTES};

type Steps = Vec<Vec<PageNo>>;

/// Steps that need `low..=high` of `pages` pages, in random order.
fn steps(draws: &mut Stream, count: usize, pages: u32, low: u64, high: u64) -> Steps {
    let step = |draws: &mut Stream| {
        let mut all: Vec<PageNo> = (0..pages).map(PageNo).collect();
        draws.shuffle(&mut all);
        all.truncate((low + draws.below(high - low + 1)) as usize);
        all
    };
    (0..count).map(|_| step(draws)).collect()
}

/// The first step at or after `from` that needs the page.
fn next_use(steps: &Steps, page: PageNo, from: usize) -> Option<u32> {
    (from..steps.len()).find(|&s| steps[s].contains(&page)).map(|s| s as u32)
}

fn set_of(pages: &[PageNo]) -> usize {
    pages.iter().fold(0, |set, p| set | 1 << p.0)
}

/// The fewest of `pages` pages that any cache can read: a search over all sets that may be cached after each step, of which
/// each has its number of frames and the pages that it needs.
fn least_reads(steps: &[(u32, usize)], pages: u32) -> u64 {
    let mut cost = vec![u64::MAX; 1 << pages];
    cost[0] = 0;
    for &(frames, needed) in steps {
        let mut after = vec![u64::MAX; 1 << pages];
        for (held, &reads) in cost.iter().enumerate().filter(|(_, c)| **c < u64::MAX) {
            let kept_at_most = held & !needed;
            // All subsets of the held pages that the step does not need.
            let mut kept = kept_at_most;
            loop {
                let now = kept | needed;
                if now.count_ones() <= frames {
                    after[now] = after[now].min(reads + u64::from((needed & !held).count_ones()));
                }
                if kept == 0 {
                    break;
                }
                kept = (kept - 1) & kept_at_most;
            }
        }
        cost = after;
    }
    cost.into_iter().min().unwrap()
}

/// Runs the model over all steps, checks the invariants of every change, and returns the reads.
fn reads(steps: &Steps, frames: usize, policy: EvictPolicy, next: impl Fn(PageNo, usize) -> Option<u32>) -> u64 {
    let mut cache = CacheModel::new(frames, policy);
    let mut held: Vec<PageNo> = Vec::new();
    let mut change = StepChange::default();
    let mut reads = 0;
    for (step, needed) in steps.iter().enumerate() {
        cache.step(step as u32, needed, |page| next(page, step + 1), &mut change).unwrap();
        assert!(change.evict.iter().all(|p| !needed.contains(p) && held.contains(p)));
        assert!(change.admit.iter().all(|p| needed.contains(p) && !held.contains(p)));
        held.retain(|p| !change.evict.contains(p));
        held.extend(&change.admit);
        assert!(held.len() <= frames && needed.iter().all(|p| held.contains(p)));
        assert!(change.evict.is_empty() || held.len() == frames, "no page leaves before its frame is needed");
        reads += change.admit.len() as u64;
    }
    reads
}

#[test]
fn farthest_next_use_reads_the_least_that_is_possible() {
    let mut draws = Stream::new(1, Purpose::Test, 50, 0);
    let (mut lru_total, mut least_total) = (0, 0);
    for _ in 0..150 {
        let frames = 3 + draws.below(4) as u32;
        let steps = steps(&mut draws, 14, 9, 1, u64::from(frames));
        let least = least_reads(&steps.iter().map(|pages| (frames, set_of(pages))).collect::<Vec<_>>(), 9);
        let known = |page, from| next_use(&steps, page, from);
        assert_eq!(reads(&steps, frames as usize, EvictPolicy::FarthestNextUse, known), least);
        lru_total += reads(&steps, frames as usize, EvictPolicy::LeastRecentlyUsed, known);
        least_total += least;
    }
    assert!(lru_total * 10 > least_total * 11, "these cases do not tell the policies apart");
}

#[test]
fn least_recent_use_is_what_a_queue_does() {
    let mut draws = Stream::new(2, Purpose::Test, 50, 0);
    for _ in 0..40 {
        let steps = steps(&mut draws, 80, 40, 1, 8);
        let mut queue: Vec<PageNo> = Vec::new();
        let mut want = 0;
        for needed in &steps {
            want += needed.iter().filter(|p| !queue.contains(p)).count() as u64;
            queue.retain(|p| !needed.contains(p));
            let mut sorted = needed.clone();
            sorted.sort_unstable();
            queue.extend(sorted);
            queue.drain(..queue.len().saturating_sub(12));
        }
        assert_eq!(reads(&steps, 12, EvictPolicy::LeastRecentlyUsed, |_, _| None), want);
        // Without knowledge of the future the planned cache does the same.
        assert_eq!(reads(&steps, 12, EvictPolicy::FarthestNextUse, |_, _| None), want);
    }
}

/// A simulation and the frame table of a run evict the same pages also where steps walk their views in several batches:
/// both count the last use of a page in steps.
#[test]
fn a_simulation_and_a_run_have_the_same_clock_of_last_uses() {
    let mut draws = Stream::new(5, Purpose::Test, 50, 0);
    for _ in 0..40 {
        let frames = 6 + draws.below(8) as usize;
        let mut cache = CacheModel::new(frames, EvictPolicy::LeastRecentlyUsed);
        let mut table: FrameTable<()> = FrameTable::new(frames, EvictPolicy::LeastRecentlyUsed);
        let (mut change, mut batch, mut evictions) = (StepChange::default(), 0, 0);
        for step in 0..40 {
            table.begin_step(step);
            for pages in steps(&mut draws, 1 + step as usize % 3, 30, 1, 3) {
                cache.batch(batch, step, &pages, |_| None, &mut change).unwrap();
                batch += 1;
                let held: Vec<PageNo> = pages.iter().copied().filter(|&p| table.pin(p, true).is_some()).collect();
                let mut evicted = Vec::new();
                for &page in pages.iter().filter(|p| !held.contains(p)) {
                    if !table.has_free() {
                        let victim = table.victim().unwrap().page;
                        table.evict(victim);
                        evicted.push(victim);
                    }
                    table.begin_load(page, NEVER, || ()).unwrap();
                    table.finish_load(page, ());
                    table.pin(page, true).unwrap();
                }
                assert_eq!(change.evict, evicted, "batch {batch} of step {step}");
                pages.iter().for_each(|&page| table.unpin(page, (), false));
                evictions += evicted.len();
            }
        }
        assert!(evictions > 40, "these cases evict too little");
    }
}

#[test]
fn a_window_that_moves_knows_what_lies_in_it_and_stays_within_its_bytes() {
    let mut draws = Stream::new(3, Purpose::Test, 50, 0);
    let all = steps(&mut draws, 400, 60, 0, 12);
    let mut plan = Plan::new(0, 1500);
    let (mut first, mut end) = (0, 0);
    while first < all.len() {
        while end < all.len() && plan.push(&all[end]) {
            end += 1;
        }
        assert!(end > first && plan.steps() == (first as u32..end as u32));
        for step in first..end {
            assert_eq!(plan.pages(step as u32), all[step]);
        }
        let window = all[..end].to_vec();
        for page in (0..60).map(PageNo) {
            for from in [first, first + 1, (first + end) / 2] {
                assert_eq!(plan.next_use(page, from as u32), next_use(&window, page, from));
            }
        }
        assert_eq!(plan.uses(), all[first..end].iter().map(Vec::len).sum::<usize>());
        assert!(plan.uses() * USE_BYTES <= 1500, "{} uses", plan.uses());
        let steps = 1 + draws.below(3) as usize;
        (0..steps.min(end - first)).for_each(|i| assert_eq!(plan.pop().as_ref(), Some(&all[first + i])));
        first += steps.min(end - first);
    }
    assert!(plan.steps().is_empty() && plan.pages(400).is_empty());
    plan.restart(7);
    assert!(
        plan.push(&(0..60).chain(0..60).map(PageNo).collect::<Vec<_>>()[..60])
            && plan.next_use(PageNo(3), 7) == Some(7)
    );
    // One step fits regardless of its bytes.
    assert!(Plan::new(0, 0).push(&all[1]));
}

#[test]
fn planned_changes_are_those_that_happen_and_print_exactly() {
    let all: Steps =
        [vec![0, 1], vec![1, 2], vec![0, 3], vec![1, 2]].map(|s| s.into_iter().map(PageNo).collect()).into();
    let mut plan = Plan::new(10, 1 << 20);
    assert!(all.iter().all(|step| plan.push(step)));
    let cache = CacheModel::new(3, EvictPolicy::FarthestNextUse);
    let planned = cache.changes(&plan, 10..99).unwrap();
    let text: Vec<String> = planned.iter().map(ToString::to_string).collect();
    assert_eq!(
        text,
        [
            "step 10: 2 pages, admit 2, evict 0\n  + 0 1",
            "step 11: 2 pages, admit 1, evict 0\n  + 2",
            // Pages 1 and 2 are next needed in the same step and were last used in the same step: the lower number is
            // evicted.
            "step 12: 2 pages, admit 1, evict 1\n  + 3\n  - 1",
            "step 13: 2 pages, admit 1, evict 1\n  + 1\n  - 0",
        ]
    );
    let small = CacheModel::new(1, EvictPolicy::FarthestNextUse);
    assert_eq!(small.changes(&plan, 10..11), Err(TooFewFrames { step: 10, needed: 2, frames: 1 }));
}

/// From an empty cache, or with first pages of the cache's own choice.
#[test]
fn the_bound_counts_what_the_cache_that_knows_the_future_reads() {
    let mut draws = Stream::new(5, Purpose::Test, 1, 1);
    for round in 0..300 {
        let pages = 4 + draws.below(20) as u32;
        let frames = 2 + draws.below(u64::from(pages)) as usize;
        let steps = steps(&mut draws, 40, pages, 1, frames.min(pages as usize) as u64);
        for is_warm in [false, true] {
            let mut bound = FewestReads::default();
            let mut first: Vec<PageNo> = (0..if is_warm { pages } else { 0 }).map(PageNo).collect();
            first.iter().for_each(|&page| bound.add(page));
            steps.iter().for_each(|pages| bound.step(frames, pages.iter().map(|&p| (p, 10))));
            first.sort_by_key(|&page| next_use(&steps, page, 0).unwrap_or(u32::MAX));
            first.truncate(frames);
            let made = first.len() as u64;
            let all: Steps = std::iter::once(first).chain(steps.iter().cloned()).collect();
            let known = |page, from| next_use(&all, page, from);
            let want = reads(&all, frames, EvictPolicy::FarthestNextUse, known) - made;
            assert_eq!(bound.bytes(), 10 * want, "round {round}, {frames} frames");
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
    assert_eq!(bound.bytes(), 0);
    // The two frames hold other pages, so the page is read.
    bound.step(2, [(PageNo(2), 7)].into_iter());
    assert_eq!(bound.bytes(), 7);
}

#[test]
fn frames_may_be_taken_away_and_given_back_between_steps() {
    let mut draws = Stream::new(6, Purpose::Test, 1, 1);
    let mut differs = 0;
    for round in 0..200 {
        let pages = 6;
        let mut frames = 5;
        let steps: Vec<(u32, usize)> = (0..14)
            .map(|_| {
                frames -= u32::from(frames > 2 && draws.below(3) == 0);
                frames += u32::from(frames < 5 && draws.below(6) == 0);
                let needed = (0..frames).fold(0, |needed, _| needed | 1 << draws.below(pages));
                (frames, needed)
            })
            .collect();
        let bound = |frames_at: &dyn Fn(u32) -> usize| {
            let mut bound = FewestReads::default();
            for &(frames, needed) in &steps {
                let list = (0..pages as u32).filter(|page| needed >> page & 1 == 1).map(|page| (PageNo(page), 1));
                bound.step(frames_at(frames), list);
            }
            bound.bytes()
        };
        assert_eq!(bound(&|frames| frames as usize), least_reads(&steps, pages as u32), "round {round}: {steps:?}");
        differs += u32::from(bound(&|frames| frames as usize) != bound(&|_| 5));
    }
    assert!(differs > 20, "in {differs} rounds the frames that were taken away made a difference");
}
