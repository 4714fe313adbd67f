//! The frames of host memory and the pages in them.
//!
//! The cache answers where a page is and which page should leave; whoever moves bytes tells it what began and how it
//! ended. Methods panic when told of a move that the page's state does not allow: that is a bug of the caller, and going
//! on would lose a page.
//!
//! Invariants: 1. a page is in at most one frame; 2. no frame is taken while there are as many as allowed, and each keeps
//! its buffer: buffers move between frame, store and caller, and are never copied. Where fewer are allowed than there are,
//! those that are free or become free give their memory back until there are no more than that; 3. exactly the resident frames
//! are in the eviction order; 4. a dirty page leaves only through [`HostCache::evict`] of a clean one: it must be
//! written first.

use super::evict::{EvictPolicy, EvictQueue};
use super::frame::{Frame, FrameState};
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;

/// In the table of pages: not in memory.
const ABSENT: u32 = u32::MAX;

/// A page that could leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Victim {
    /// The page.
    pub page: PageNo,
    /// Whether it must be written before.
    pub dirty: bool,
    /// Next step that is known to need it.
    pub next_use: u32,
}

/// A page in memory.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Held {
    /// The page.
    pub page: PageNo,
    /// Next step that is known to need it.
    pub next_use: u32,
    /// Clock of its last use.
    pub last_use: u32,
}

/// Frames of one size.
#[derive(Debug)]
pub struct HostCache {
    frame_bytes: usize,
    frames_max: usize,
    frames: Vec<Frame>,
    free: Vec<u32>,
    lent: Vec<u32>,
    /// Frames without memory.
    retired: Vec<u32>,
    frame_from_page: Vec<u32>,
    clean: EvictQueue,
    dirty: EvictQueue,
    /// Frames by state, indexed by `FrameState as usize`.
    counts: [usize; FrameState::COUNT],
    clock: u32,
}

impl HostCache {
    /// At most `frames_max` frames of `frame_bytes` bytes (`usize::MAX`: as many as needed); memory is taken as they
    /// are first used.
    pub fn new(frames_max: usize, frame_bytes: usize, policy: EvictPolicy) -> HostCache {
        HostCache {
            frame_bytes,
            frames_max,
            frames: Vec::new(),
            free: Vec::new(),
            lent: Vec::new(),
            retired: Vec::new(),
            frame_from_page: Vec::new(),
            clean: EvictQueue::new(policy),
            dirty: EvictQueue::new(policy),
            counts: [0; FrameState::COUNT],
            clock: 0,
        }
    }

    /// Frames that there may be.
    pub fn frames_max(&self) -> usize {
        self.frames_max
    }

    /// Frames that have memory.
    pub fn frames(&self) -> usize {
        self.frames.len() - self.retired.len()
    }

    /// Frames that have memory beyond those that there may be: they lose it as they become free.
    pub fn excess(&self) -> usize {
        self.frames().saturating_sub(self.frames_max)
    }

    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> usize {
        self.frame_bytes
    }

    /// Frames in a state.
    pub fn count(&self, state: FrameState) -> usize {
        self.counts[state as usize]
    }

    /// Allows more frames; never takes any away.
    pub fn allow_frames(&mut self, frames_max: usize) {
        self.frames_max = self.frames_max.max(frames_max);
    }

    /// Allows fewer frames; never more. Free ones give their memory back at once, others when their pages have left.
    pub fn limit_frames(&mut self, frames_max: usize) {
        self.frames_max = self.frames_max.min(frames_max);
        while self.excess() > 0
            && let Some(frame) = self.free.pop()
        {
            self.retire(frame as usize);
        }
    }

    /// Allows one frame more than there are, or than there may be.
    pub fn add_frame(&mut self) {
        self.frames_max = self.frames_max.max(self.frames()).saturating_add(1);
    }

    /// What a page's frame is doing; `None` for a page that is not in memory.
    pub fn state(&self, page: PageNo) -> Option<FrameState> {
        self.find(page).map(|frame| self.frames[frame].state)
    }

    /// Whether the store is filling a page's frame.
    pub fn is_loading(&self, page: PageNo) -> bool {
        self.state(page) == Some(FrameState::Loading)
    }

    /// Frames that could be taken without evicting.
    pub fn free_frames(&self) -> usize {
        self.free.len() + self.frames_max.saturating_sub(self.frames())
    }

    /// All pages in memory, whatever their frames are doing.
    pub fn held(&self) -> impl Iterator<Item = Held> {
        let holds_page = |f: &&Frame| !matches!(f.state, FrameState::Free | FrameState::Lent | FrameState::Retired);
        self.frames.iter().filter(holds_page).map(|f| Held { page: f.page, next_use: f.next_use, last_use: f.last_use })
    }

    /// A page as a victim; `None` if it is not resident.
    pub fn as_victim(&self, page: PageNo) -> Option<Victim> {
        let frame = self.find(page).filter(|&f| self.frames[f].state == FrameState::Resident)?;
        Some(self.victim_in(frame as u32))
    }

    /// Whether a page in memory differs from what the store holds.
    pub fn is_dirty(&self, page: PageNo) -> bool {
        self.find(page).is_some_and(|frame| self.frames[frame].dirty)
    }

    /// Advances the clock that [`HostCache::pin`] stamps frames with: once a step.
    pub fn tick(&mut self) {
        self.clock += 1;
    }

    /// Whether a frame is to be had without evicting.
    pub fn has_free(&self) -> bool {
        self.free_frames() > 0
    }

    /// Takes a free frame for a page without number; `None` when there is none. Ends with [`HostCache::adopt`] or
    /// [`HostCache::take_back`].
    pub fn lend(&mut self) -> Option<PageBuffer> {
        if let Some(frame) = self.free.pop() {
            self.set_state(frame as usize, FrameState::Lent);
            self.lent.push(frame);
            return self.frames[frame as usize].buffer.take();
        }
        (self.frames() < self.frames_max).then(|| {
            match self.retired.pop() {
                Some(frame) => {
                    self.set_state(frame as usize, FrameState::Lent);
                    self.lent.push(frame);
                }
                None => {
                    self.lent.push(self.frames.len() as u32);
                    self.frames.push(Frame::lent());
                    self.counts[FrameState::Lent as usize] += 1;
                }
            }
            PageBuffer::mapped(self.frame_bytes)
        })
    }

    /// Takes a lent frame back.
    pub fn take_back(&mut self, buffer: PageBuffer) {
        let frame = self.any_lent();
        self.set_free(frame, buffer);
    }

    /// Gives a lent frame to a new page, which is pinned by it.
    pub fn adopt(&mut self, page: PageNo) {
        let frame = self.any_lent();
        self.give(frame, page, FrameState::Pinned);
        self.frames[frame].last_use = self.clock;
    }

    /// A load of `page` begins, into a free frame; `None` when there is none.
    pub fn begin_load(&mut self, page: PageNo, next_use: u32) -> Option<PageBuffer> {
        assert!(self.find(page).is_none(), "a page in memory is not loaded");
        let buffer = self.lend()?;
        let frame = self.any_lent();
        self.give(frame, page, FrameState::Loading);
        self.frames[frame].next_use = next_use;
        Some(buffer)
    }

    /// A load ended well: the page is resident and clean.
    pub fn finish_load(&mut self, page: PageNo, buffer: PageBuffer) {
        let frame = self.frame_in(page, FrameState::Loading);
        self.set_resident(frame, buffer);
    }

    /// A load failed: its frame is free again.
    pub fn fail_load(&mut self, page: PageNo, buffer: PageBuffer) {
        let frame = self.frame_in(page, FrameState::Loading);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, buffer);
    }

    /// Hands out a resident page and whether it is dirty; `None` when it is not resident. With `stamp` it counts as
    /// used now.
    pub fn pin(&mut self, page: PageNo, stamp: bool) -> Option<(PageBuffer, bool)> {
        let frame = self.find(page).filter(|&f| self.frames[f].state == FrameState::Resident)?;
        let buffer = self.unqueue(frame, FrameState::Pinned);
        if stamp {
            self.frames[frame].last_use = self.clock;
        }
        Some((buffer, self.frames[frame].dirty))
    }

    /// Takes a pinned page back. It is dirty if it was before or `dirty` says so.
    pub fn unpin(&mut self, page: PageNo, buffer: PageBuffer, dirty: bool) {
        let frame = self.frame_in(page, FrameState::Pinned);
        self.frames[frame].dirty |= dirty;
        self.set_resident(frame, buffer);
    }

    /// A pinned page lost its last row: its frame is free.
    pub fn drop_pinned(&mut self, page: PageNo, buffer: PageBuffer) {
        let frame = self.frame_in(page, FrameState::Pinned);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, buffer);
    }

    /// A write of a resident dirty page begins.
    pub fn begin_write(&mut self, page: PageNo) -> PageBuffer {
        let frame = self.frame_in(page, FrameState::Resident);
        assert!(self.frames[frame].dirty, "a clean page is not written");
        self.unqueue(frame, FrameState::Writing)
    }

    /// A write ended: the page is resident, and clean if it went well.
    pub fn finish_write(&mut self, page: PageNo, buffer: PageBuffer, well: bool) {
        let frame = self.frame_in(page, FrameState::Writing);
        self.frames[frame].dirty = !well;
        self.set_resident(frame, buffer);
    }

    /// Evicts a resident clean page; its frame is free, or gone if there are more than there may be.
    pub fn evict(&mut self, page: PageNo) {
        let frame = self.frame_in(page, FrameState::Resident);
        assert!(!self.frames[frame].dirty, "a dirty page is written before it is evicted");
        let buffer = self.unqueue(frame, FrameState::Free);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, buffer);
    }

    /// The page that should leave first.
    pub fn victim(&self) -> Option<Victim> {
        let queue = if self.clean.first() > self.dirty.first() { &self.clean } else { &self.dirty };
        queue.first().map(|(_, _, frame)| self.victim_in(frame))
    }

    /// The clean page that should leave first.
    pub fn clean_victim(&self) -> Option<Victim> {
        self.clean.first().map(|(_, _, frame)| self.victim_in(frame))
    }

    /// The dirty page that should leave first.
    pub fn dirty_victim(&self) -> Option<Victim> {
        self.dirty.first().map(|(_, _, frame)| self.victim_in(frame))
    }

    /// Sets the next step that is known to need a page; nothing for a page that is not in memory.
    pub fn set_next_use(&mut self, page: PageNo, next_use: u32) {
        let Some(frame) = self.find(page) else { return };
        let Frame { state, dirty, next_use: old, last_use, .. } = self.frames[frame];
        if old == next_use {
            return;
        }
        self.frames[frame].next_use = next_use;
        if state == FrameState::Resident {
            let queue = if dirty { &mut self.dirty } else { &mut self.clean };
            queue.remove(frame as u32, old, last_use);
            queue.insert(frame as u32, next_use, last_use);
        }
    }

    fn victim_in(&self, frame: u32) -> Victim {
        let Frame { page, dirty, next_use, .. } = self.frames[frame as usize];
        Victim { page, dirty, next_use }
    }

    fn find(&self, page: PageNo) -> Option<usize> {
        self.frame_from_page.get(page.index()).filter(|&&frame| frame != ABSENT).map(|&frame| frame as usize)
    }

    fn frame_in(&self, page: PageNo, state: FrameState) -> usize {
        match self.find(page) {
            Some(frame) if self.frames[frame].state == state => frame,
            found => panic!("page number {} should be {state:?}, is {:?}", page.0, found.map(|f| self.frames[f].state)),
        }
    }

    /// The frame that was lent last: all lent frames are alike, their buffers are elsewhere.
    fn any_lent(&mut self) -> usize {
        match self.lent.pop() {
            Some(frame) => frame as usize,
            None => panic!("no frame is lent"),
        }
    }

    fn give(&mut self, frame: usize, page: PageNo, state: FrameState) {
        if self.frame_from_page.len() <= page.index() {
            self.frame_from_page.resize(page.index() + 1, ABSENT);
        }
        self.frame_from_page[page.index()] = frame as u32;
        self.set_state(frame, state);
        self.frames[frame] = Frame { page, state, ..Frame::lent() };
    }

    fn set_state(&mut self, frame: usize, state: FrameState) {
        self.counts[self.frames[frame].state as usize] -= 1;
        self.counts[state as usize] += 1;
        self.frames[frame].state = state;
    }

    fn set_free(&mut self, frame: usize, buffer: PageBuffer) {
        if self.excess() > 0 {
            return self.retire(frame);
        }
        self.set_state(frame, FrameState::Free);
        self.frames[frame].buffer = Some(buffer);
        self.free.push(frame as u32);
    }

    /// Takes the memory of a frame without a page.
    fn retire(&mut self, frame: usize) {
        self.set_state(frame, FrameState::Retired);
        self.frames[frame].buffer = None;
        self.retired.push(frame as u32);
    }

    fn set_resident(&mut self, frame: usize, buffer: PageBuffer) {
        self.set_state(frame, FrameState::Resident);
        let Frame { dirty, next_use, last_use, .. } = self.frames[frame];
        self.frames[frame].buffer = Some(buffer);
        let queue = if dirty { &mut self.dirty } else { &mut self.clean };
        queue.insert(frame as u32, next_use, last_use);
    }

    /// Takes a resident frame out of the eviction order and its buffer out of the frame.
    fn unqueue(&mut self, frame: usize, state: FrameState) -> PageBuffer {
        let Frame { dirty, next_use, last_use, .. } = self.frames[frame];
        let queue = if dirty { &mut self.dirty } else { &mut self.clean };
        queue.remove(frame as u32, next_use, last_use);
        self.set_state(frame, state);
        match self.frames[frame].buffer.take() {
            Some(buffer) => buffer,
            None => panic!("a resident frame has its buffer"),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::super::evict::NEVER;
    use super::*;

    fn load(cache: &mut HostCache, page: u32, next_use: u32, mark: u8) {
        let mut buffer = cache.begin_load(PageNo(page), next_use).unwrap();
        buffer.as_mut_slice()[0] = mark;
        cache.finish_load(PageNo(page), buffer);
    }

    #[test]
    fn frames_are_bounded_and_buffers_stay_with_their_pages() {
        let mut cache = HostCache::new(3, 4096, EvictPolicy::FarthestNextUse);
        (0..3).for_each(|i| load(&mut cache, i, 10 + i, i as u8));
        assert!(!cache.has_free() && cache.lend().is_none() && cache.begin_load(PageNo(9), 1).is_none());
        assert_eq!(cache.victim().unwrap().page, PageNo(2));
        let (mut buffer, dirty) = cache.pin(PageNo(2), true).unwrap();
        assert!(!dirty && cache.pin(PageNo(2), true).is_none() && cache.pin(PageNo(9), true).is_none());
        assert_eq!(cache.victim().unwrap().page, PageNo(1), "pinned pages do not leave");
        buffer.as_mut_slice()[0] = 77;
        cache.unpin(PageNo(2), buffer, true);
        assert_eq!(cache.victim(), Some(Victim { page: PageNo(2), dirty: true, next_use: 12 }));
        assert_eq!(cache.clean_victim().unwrap().page, PageNo(1));
        // A failed write leaves it dirty, a good one clean; then it can go.
        for (well, dirty) in [(false, true), (true, false)] {
            let buffer = cache.begin_write(PageNo(2));
            assert_eq!((cache.state(PageNo(2)), buffer.as_slice()[0]), (Some(FrameState::Writing), 77));
            cache.finish_write(PageNo(2), buffer, well);
            assert_eq!(cache.is_dirty(PageNo(2)), dirty);
        }
        cache.evict(PageNo(2));
        assert_eq!((cache.state(PageNo(2)), cache.frames(), cache.free_frames()), (None, 3, 1));
        cache.begin_load(PageNo(5), NEVER).map(|b| cache.fail_load(PageNo(5), b)).unwrap();
        assert_eq!((cache.state(PageNo(5)), cache.free_frames()), (None, 1));
        // The upper half of a split.
        let buffer = cache.lend().unwrap();
        cache.adopt(PageNo(7));
        cache.unpin(PageNo(7), buffer, true);
        assert_eq!(cache.victim().unwrap().page, PageNo(7));
        let buffer = cache.pin(PageNo(7), false).unwrap().0;
        cache.drop_pinned(PageNo(7), buffer);
        let buffer = cache.lend().unwrap();
        assert!(!cache.has_free());
        cache.take_back(buffer);
        assert_eq!((cache.free_frames(), cache.held().count()), (1, 2));
        let (first, last) = (cache.pin(PageNo(0), true).unwrap().0, cache.pin(PageNo(1), true).unwrap().0);
        assert_eq!((first.as_slice()[0], last.as_slice()[0]), (0, 1));
        assert!(cache.victim().is_none() && cache.count(FrameState::Pinned) == 2);
    }

    #[test]
    fn frames_that_are_taken_away_give_their_memory_back_as_their_pages_leave() {
        let mut cache = HostCache::new(6, 4096, EvictPolicy::FarthestNextUse);
        (0..5).for_each(|i| load(&mut cache, i, 10 + i, i as u8));
        let lent = cache.lend().unwrap();
        cache.take_back(lent);
        let pinned = cache.pin(PageNo(0), true).unwrap().0;
        cache.limit_frames(3);
        // The free one went at once.
        assert_eq!((cache.frames(), cache.frames_max(), cache.excess(), cache.free_frames()), (5, 3, 2, 0));
        cache.limit_frames(4);
        assert_eq!(cache.frames_max(), 3, "a limit allows no more than before");
        assert!(cache.lend().is_none() && cache.begin_load(PageNo(9), 1).is_none());
        cache.evict(PageNo(4));
        cache.drop_pinned(PageNo(0), pinned);
        assert_eq!((cache.frames(), cache.excess(), cache.free_frames(), cache.held().count()), (3, 0, 0, 3));
        // From now on a page that leaves makes room for another.
        cache.evict(PageNo(3));
        assert_eq!((cache.frames(), cache.free_frames()), (3, 1));
        load(&mut cache, 7, 1, 77);
        // One frame more, although there was an excess: frames that have no memory get it again.
        cache.limit_frames(1);
        assert_eq!(cache.excess(), 2);
        cache.add_frame();
        assert_eq!((cache.excess(), cache.free_frames()), (0, 1));
        load(&mut cache, 8, 2, 88);
        cache.allow_frames(6);
        (10..12).for_each(|i| load(&mut cache, i, 3, i as u8));
        assert_eq!((cache.frames(), cache.free_frames(), cache.count(FrameState::Retired)), (6, 0, 0));
        for (page, mark) in [(7, 77), (8, 88), (11, 11), (1, 1)] {
            assert_eq!(cache.pin(PageNo(page), true).unwrap().0.as_slice()[0], mark);
        }
    }

    #[test]
    fn next_uses_and_last_uses_order_the_leaving() {
        let mut cache = HostCache::new(usize::MAX, 4096, EvictPolicy::FarthestNextUse);
        (0..4).for_each(|i| load(&mut cache, i, NEVER, 0));
        cache.set_next_use(PageNo(3), 5);
        cache.tick();
        let buffer = cache.pin(PageNo(1), true).unwrap().0;
        cache.set_next_use(PageNo(1), NEVER - 1);
        cache.set_next_use(PageNo(1), NEVER);
        cache.unpin(PageNo(1), buffer, false);
        let mut left = Vec::new();
        while let Some(victim) = cache.victim() {
            left.push(victim.page.0);
            cache.evict(victim.page);
        }
        assert_eq!(left, [2, 0, 1, 3]);
    }

    #[test]
    #[should_panic(expected = "a dirty page is written before it is evicted")]
    fn dirty_pages_are_never_evicted() {
        let mut cache = HostCache::new(1, 4096, EvictPolicy::LeastRecentlyUsed);
        load(&mut cache, 0, 1, 0);
        let buffer = cache.pin(PageNo(0), true).unwrap().0;
        cache.unpin(PageNo(0), buffer, true);
        cache.evict(PageNo(0));
    }
}
