//! The pager against a plain model: for any number of frames, plan, policy and store, every step gets exactly the pages
//! that its view needs, with the bytes last written to them.

mod beside;
mod failures;
mod full;
mod slow;
mod staging;
mod traffic;
mod world;

use crate::support::faulty_engine::Faults;
use gsscale::page::format::codec::Codec;
use gsscale::paging::error::PagingError;
use gsscale::paging::frames::evict::EvictPolicy;
use gsscale::paging::pager::{Pager, PagerConfig};
use world::{PAGE_ROWS, Run, SH_DEGREE, config, store};

const STEPS: usize = 150;
const PAGES: u32 = 60;

/// A whole run in memory, and the most pages that a view of it needs.
fn run_in_memory(seed: u64) -> (Run, usize) {
    let pager = Pager::in_memory(PagerConfig::in_memory(PAGE_ROWS, SH_DEGREE));
    let mut memory = Run::new(pager, seed, PAGES, STEPS).unwrap();
    (0..STEPS).for_each(|_| memory.step().unwrap());
    let most = memory.pager.stats().pinned_max;
    (memory, most)
}

#[test]
fn pages_hold_what_was_put_into_them_whatever_the_frames() {
    for seed in 0..8 {
        let (mut memory, fewest) = run_in_memory(seed);
        memory.check_all(7).unwrap();
        for (i, frames) in [fewest, fewest + 1, fewest + 5, fewest * 2, usize::MAX].into_iter().enumerate() {
            let ahead = EvictPolicy::ALL.map(|policy| (policy, 3, Codec::Raw));
            let planned = EvictPolicy::FarthestNextUse;
            for (policy, prefetch_pages, codec) in
                [(planned, 8, Codec::Raw), (planned, 0, Codec::Zstd { level: 1 })].into_iter().chain(ahead)
            {
                let faults = Faults::new();
                // With and without slow transfers that complete out of order.
                if (i as u64 + seed).is_multiple_of(2) {
                    faults.reorder(seed + 100);
                }
                let config = PagerConfig { policy, prefetch_bytes: prefetch_pages * 8192, ..config(frames) };
                let mut run = Run::new(Pager::new(config, store(codec, &faults)), seed, PAGES, STEPS).unwrap();
                (0..STEPS).for_each(|_| run.step().unwrap());
                run.check_all(fewest).unwrap();
                assert_eq!(run.model, memory.model);
                let stats = run.pager.stats();
                assert!(run.pager.frames() <= frames && stats.pinned_max == fewest);
                assert_eq!(stats.pages_needed, stats.hits + stats.misses);
                if frames < usize::MAX {
                    assert!(stats.pages_read > 0 && stats.pages_written > 0 && stats.evictions > 0);
                }
            }
        }
    }
}

#[test]
fn frames_that_are_taken_away_and_given_back_cost_no_page() {
    for seed in 0..8 {
        let (memory, fewest) = run_in_memory(seed);
        for codec in [Codec::Raw, Codec::Zstd { level: 1 }] {
            let faults = Faults::new();
            faults.reorder(seed + 100);
            let pager = Pager::new(config(3 * fewest), store(codec, &faults));
            let mut run = Run::new(pager, seed, PAGES, STEPS).unwrap();
            let mut is_least = false;
            for step in 0..STEPS {
                run.step().unwrap();
                let frames = (3 * fewest).saturating_sub(step * 4 * fewest / STEPS).max(fewest);
                if step < 3 * STEPS / 4 {
                    run.pager.limit_frames(frames);
                } else {
                    // The frames are given back.
                    run.pager.allow_frames(2 * fewest);
                }
                let (now, most) = (run.pager.frames(), run.pager.frames_max());
                assert!(now <= most, "step {step}: {now} of {most} frames");
                assert_eq!(most, if step < 3 * STEPS / 4 { frames } else { 2 * fewest });
                is_least |= now == fewest;
            }
            assert!(is_least && run.pager.frames() > fewest, "{:?}", run.pager.stats());
            run.check_all(fewest).unwrap();
            assert_eq!(run.model, memory.model);
        }
    }
}

#[test]
fn one_frame_less_than_the_largest_view_is_refused_with_the_need() {
    for seed in 0..4 {
        let (_, fewest) = run_in_memory(seed);
        let pager = Pager::new(config(fewest - 1), store(Codec::Raw, &Faults::new()));
        let mut run = Run::new(pager, seed, PAGES, STEPS).unwrap();
        let error = (0..STEPS).find_map(|_| run.step().err()).expect("the largest view does not fit");
        assert!(
            matches!(error, PagingError::WorkingSet { pages, frames, .. } if pages == fewest && frames == fewest - 1)
        );
        let text = error.to_string();
        let named = [format!("{fewest} pages"), format!("{} frames", fewest - 1), "--frames".into(), "KiB".into()];
        assert!(named.iter().all(|part| text.contains(part)), "{text}");
        assert!(text.contains(&format!("step {}", run.step)) || text.contains("splits"), "{text}");
        // Nothing is pinned or lost.
        run.check_all(3).unwrap();
    }
}
