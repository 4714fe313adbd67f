//! A drive that completes a transfer only when somebody waits for it: bytes in flight stay within their bound, and
//! pages that were not prefetched are counted.

use super::world::{self, camera, config};
use gsscale::base::ids::PageNo;
use gsscale::page::engine::memory::MemoryEngine;
use gsscale::page::engine::page_engine::{Completion, Direction, PageEngine, Transfer};
use gsscale::page::format::codec::Codec;
use gsscale::paging::pager::{Pager, PagerConfig};
use gsscale::scene::camera::Camera;
use std::collections::VecDeque;
use std::io;
use std::sync::{Arc, Mutex};

const PAGES: u32 = 100;
const FRAMES: usize = 40;

/// Bytes in flight: reads, writes.
type OnTheWay = Arc<Mutex<[usize; 2]>>;

/// A store in memory whose transfers complete one by one, oldest first, and only while somebody waits.
struct SlowStore {
    inner: MemoryEngine,
    queue: VecDeque<Transfer>,
    on_the_way: OnTheWay,
}

fn kind(transfer: &Transfer) -> usize {
    usize::from(transfer.direction == Direction::Write)
}

impl PageEngine for SlowStore {
    fn name(&self) -> &'static str {
        "slow"
    }

    fn create_segment(&mut self, segment: u32, bytes: u64) -> io::Result<()> {
        self.inner.create_segment(segment, bytes)
    }

    fn check_segment(&self, segment: u32, bytes: u64) -> io::Result<()> {
        self.inner.check_segment(segment, bytes)
    }

    fn submit(&mut self, transfer: Transfer) {
        self.on_the_way.lock().unwrap()[kind(&transfer)] += transfer.bytes;
        self.queue.push_back(transfer);
    }

    fn complete(&mut self, wait: bool, done: &mut Vec<Completion>) {
        let Some(transfer) = self.queue.pop_front_if(|_| wait) else { return };
        self.on_the_way.lock().unwrap()[kind(&transfer)] -= transfer.bytes;
        self.inner.submit(transfer);
        self.inner.complete(true, done);
    }

    fn in_flight(&self) -> usize {
        self.queue.len()
    }

    fn sync(&mut self) -> io::Result<()> {
        self.inner.sync()
    }
}

fn slow_pager(config: PagerConfig) -> (Pager, OnTheWay) {
    let on_the_way = OnTheWay::default();
    let inner = MemoryEngine::new();
    let engine = SlowStore { inner, queue: VecDeque::new(), on_the_way: Arc::clone(&on_the_way) };
    let mut pager = Pager::new(config, world::store_over(Box::new(engine), Codec::Raw));
    world::insert_pages(&mut pager, PAGES);
    (pager, on_the_way)
}

#[test]
fn what_moves_ahead_at_a_slow_drive_is_bounded_in_bytes() {
    // No view overlaps the last. If every page changes, evictions are as fast as writes.
    let cameras: Vec<Camera> = (0..120).map(|i| camera(f64::from(i * 37 % 97))).collect();
    let coming: Vec<&Camera> = cameras.iter().collect();
    for (pages_ahead, touches) in [1, 3, 10].into_iter().flat_map(|pages| [(pages, true), (pages, false)]) {
        let bound = pages_ahead * 8192;
        let (mut pager, on_the_way) = slow_pager(PagerConfig { prefetch_bytes: bound, ..config(FRAMES) });
        assert_eq!(pager.frame_bytes(), 8192);
        let mut most = [0, 0];
        for (step, camera) in cameras.iter().enumerate() {
            pager.look_ahead(step as u32, &coming[step..]);
            let mut pages = pager.acquire(step as u32, camera).unwrap();
            for _ in 0..4 {
                pager.prefetch(step as u32);
                let now = *on_the_way.lock().unwrap();
                most = std::array::from_fn(|i| most[i].max(now[i]));
            }
            pages.iter_mut().for_each(|p| p.dirty = touches);
            pager.release(pages);
        }
        let [reads, writes] = most;
        assert!(reads <= bound && writes <= bound, "{pages_ahead} pages, {touches}: {most:?} of {bound}");
        let is_full = if touches { writes == bound } else { reads == bound };
        assert!(is_full, "{pages_ahead} pages, {touches}: {most:?} of {bound}, so the bound bounds nothing");
    }
}

/// A page that moves into a later view after that view was planned, and was evicted by then, is a late miss. Replanning
/// avoids late misses.
#[test]
fn a_page_that_comes_as_a_surprise_is_counted() {
    const LATER: usize = 12;
    let at = |step: usize| match step {
        0 => 0.0,
        LATER => 80.0,
        _ => 10.0 + 5.0 * step as f64,
    };
    let cameras: Vec<Camera> = (0..=LATER).map(|step| camera(at(step))).collect();
    let coming: Vec<&Camera> = cameras.iter().collect();
    for is_planned_anew in [false, true] {
        let (mut pager, _) = slow_pager(config(14));
        for (step, camera) in cameras.iter().enumerate() {
            if step == 0 || is_planned_anew {
                pager.look_ahead(step as u32, &coming[step..]);
            }
            let mut pages = pager.acquire(step as u32, camera).unwrap();
            let surprises = u64::from(step == LATER && !is_planned_anew);
            assert_eq!(pager.stats().late_misses, surprises, "step {step}, planned anew: {is_planned_anew}");
            if is_planned_anew {
                pager.prefetch(step as u32);
            }
            if step == 0 {
                assert_eq!(pages[0].page, PageNo(0));
                pages[0].meta = world::meta(pages[0].meta.id, at(LATER), 3, 1);
                pages[0].dirty = true;
            }
            pager.release(pages);
        }
    }
}
