//! The frame table: which pages a tier of memory holds, in which frames and in what state, and which page is evicted next.
//!
//! The table is generic over `M`, the memory of one frame: a buffer of the host today, a slot of a device later. The table
//! never looks into `M` and moves no bytes. Whoever moves bytes tells the table what began and how it ended. Methods panic
//! when a page's state does not allow the call: such a call is a bug of the caller, and going on would lose a page.
//!
//! Invariants: 1. a page is in at most one frame; 2. there are at most as many frames as allowed, and each keeps its memory:
//! memory moves between frame, mover and caller, and is never copied. When the limit is lowered, free frames give their memory
//! back at once and others as they become free; 3. exactly the resident frames are in the eviction order; 4. only clean pages
//! are evicted: a dirty page is written back first; 5. a frame has its memory exactly when it is free or resident. Otherwise somebody
//! else has the memory: the mover (loading, writing), the caller (pinned, lent), or the system (retired).

use super::evict::{Candidate, EvictOrder, EvictPolicy, NEVER};
use crate::base::ids::PageNo;

/// In `frame_from_page`: not in memory.
const ABSENT: u32 = u32::MAX;

/// What a frame is doing.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum FrameState {
    /// Holds no page.
    Free,
    /// Reserved for a page that has no number yet; the caller has the memory.
    Lent,
    /// The page is being read into the memory.
    Loading,
    /// Holds a page that can be pinned, written or evicted.
    Resident,
    /// The caller has the page's memory.
    Pinned,
    /// The page is being written back; it can be neither pinned nor evicted until the write ends.
    Writing,
    /// Has no memory: the memory was given back to the system, and may be allocated again.
    Retired,
}

impl FrameState {
    const COUNT: usize = FrameState::Retired as usize + 1;
}

/// A frame and what the table knows of its page.
#[derive(Debug)]
struct Frame<M> {
    state: FrameState,
    /// The page; meaningless for free, lent and retired frames.
    page: PageNo,
    /// Whether the page differs from its version in the tier below.
    dirty: bool,
    /// The next planned step that needs the page, or [`NEVER`].
    next_use: u32,
    /// Time of the last pin.
    last_use: u32,
    memory: Option<M>,
}

impl<M> Frame<M> {
    fn lent() -> Frame<M> {
        Frame { state: FrameState::Lent, page: PageNo(0), dirty: false, next_use: NEVER, last_use: 0, memory: None }
    }

    fn candidate(&self) -> Candidate {
        Candidate { page: self.page, next_use: self.next_use, last_use: self.last_use }
    }
}

/// A resident page that could be evicted.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Victim {
    pub page: PageNo,
    /// Whether the page must be written back first.
    pub dirty: bool,
    /// The next planned step that needs the page.
    pub next_use: u32,
}

/// Frames of one size.
#[derive(Debug)]
pub struct FrameTable<M> {
    frames_max: usize,
    frames: Vec<Frame<M>>,
    free: Vec<u32>,
    lent: Vec<u32>,
    /// Frames without memory.
    retired: Vec<u32>,
    frame_from_page: Vec<u32>,
    clean: EvictOrder,
    dirty: EvictOrder,
    /// Frames by state, indexed by `FrameState as usize`.
    counts: [usize; FrameState::COUNT],
    /// Number of steps begun.
    clock: u32,
}

impl<M> FrameTable<M> {
    /// A table of at most `frames_max` frames (`usize::MAX`: as many as needed). The memory of a frame is made by the caller
    /// when the frame is first used.
    pub fn new(frames_max: usize, policy: EvictPolicy) -> FrameTable<M> {
        FrameTable {
            frames_max,
            frames: Vec::new(),
            free: Vec::new(),
            lent: Vec::new(),
            retired: Vec::new(),
            frame_from_page: Vec::new(),
            clean: EvictOrder::new(policy),
            dirty: EvictOrder::new(policy),
            counts: [0; FrameState::COUNT],
            clock: 0,
        }
    }

    /// The most frames that are allowed.
    pub fn frames_max(&self) -> usize {
        self.frames_max
    }

    /// Frames that have memory.
    pub fn frames(&self) -> usize {
        self.frames.len() - self.retired.len()
    }

    /// Frames that have memory beyond the limit: they lose it as they become free.
    pub fn excess(&self) -> usize {
        self.frames().saturating_sub(self.frames_max)
    }

    pub fn count(&self, state: FrameState) -> usize {
        self.counts[state as usize]
    }

    /// Frames that the callers hold: pinned pages and lent frames.
    pub fn held_by_callers(&self) -> usize {
        self.count(FrameState::Pinned) + self.count(FrameState::Lent)
    }

    /// Raises the limit; never lowers it.
    pub fn allow_frames(&mut self, frames_max: usize) {
        self.frames_max = self.frames_max.max(frames_max);
    }

    /// Lowers the limit; never raises it. Free frames give their memory back at once, the others as they become free.
    pub fn limit_frames(&mut self, frames_max: usize) {
        self.frames_max = self.frames_max.min(frames_max);
        while self.excess() > 0
            && let Some(frame) = self.free.pop()
        {
            self.retire(frame as usize);
        }
    }

    /// Allows one frame more than there are, or than were allowed.
    pub fn add_frame(&mut self) {
        self.frames_max = self.frames_max.max(self.frames()).saturating_add(1);
    }

    /// The state of a page's frame; `None` for a page that is not in memory.
    pub fn state(&self, page: PageNo) -> Option<FrameState> {
        self.find(page).map(|frame| self.frames[frame].state)
    }

    /// The memory of a page's frame; `None` for a page that is not resident.
    pub fn memory(&self, page: PageNo) -> Option<&M> {
        let frame = &self.frames[self.find(page)?];
        frame.memory.as_ref().filter(|_| frame.state == FrameState::Resident)
    }

    /// Frames that can be used without evicting.
    pub fn free_frames(&self) -> usize {
        self.free.len() + self.frames_max.saturating_sub(self.frames())
    }

    /// Whether a frame can be used without evicting.
    pub fn has_free(&self) -> bool {
        self.free_frames() > 0
    }

    /// All pages in memory with the states of their frames.
    pub fn held(&self) -> impl Iterator<Item = (FrameState, Candidate)> {
        let holds_page = |f: &&Frame<M>| !matches!(f.state, FrameState::Free | FrameState::Lent | FrameState::Retired);
        self.frames.iter().filter(holds_page).map(|f| (f.state, f.candidate()))
    }

    /// A page as a victim; `None` if it is not resident.
    pub fn as_victim(&self, page: PageNo) -> Option<Victim> {
        let frame = self.find(page).map(|frame| &self.frames[frame]).filter(|f| f.state == FrameState::Resident)?;
        Some(Victim { page, dirty: frame.dirty, next_use: frame.next_use })
    }

    /// Whether a page in memory differs from its version in the tier below.
    pub fn is_dirty(&self, page: PageNo) -> bool {
        self.find(page).is_some_and(|frame| self.frames[frame].dirty)
    }

    /// A step begins: pins count as uses of this step from now on.
    pub fn begin_step(&mut self, step: u32) {
        self.clock = step.saturating_add(1);
    }

    /// Takes a free frame for a page that has no number yet, with memory from `make` where the frame has none; `None` when no
    /// frame is free. Ends with [`FrameTable::adopt`] or [`FrameTable::take_back`].
    pub fn lend(&mut self, make: impl FnOnce() -> M) -> Option<M> {
        let frame = match self.free.pop() {
            Some(frame) => frame,
            None if self.frames() >= self.frames_max => return None,
            None => self.retired.pop().unwrap_or_else(|| {
                self.frames.push(Frame::lent());
                self.counts[FrameState::Lent as usize] += 1;
                self.frames.len() as u32 - 1
            }),
        };
        self.set_state(frame as usize, FrameState::Lent);
        self.lent.push(frame);
        Some(self.frames[frame as usize].memory.take().unwrap_or_else(make))
    }

    /// Takes a lent frame back.
    pub fn take_back(&mut self, memory: M) {
        let frame = self.any_lent();
        self.set_free(frame, memory);
    }

    /// Gives a lent frame to a new page, which the caller has pinned.
    pub fn adopt(&mut self, page: PageNo) {
        let frame = self.any_lent();
        self.give(frame, page, FrameState::Pinned);
        self.frames[frame].last_use = self.clock;
    }

    /// A read of `page` begins, into a free frame; `None` when no frame is free. `make` is as for [`FrameTable::lend`].
    pub fn begin_load(&mut self, page: PageNo, next_use: u32, make: impl FnOnce() -> M) -> Option<M> {
        assert!(self.find(page).is_none(), "a page in memory is not loaded");
        let memory = self.lend(make)?;
        let frame = self.any_lent();
        self.give(frame, page, FrameState::Loading);
        self.frames[frame].next_use = next_use;
        Some(memory)
    }

    /// A read ended well: the page is resident and clean.
    pub fn finish_load(&mut self, page: PageNo, memory: M) {
        let frame = self.frame_in(page, FrameState::Loading);
        self.set_resident(frame, memory);
    }

    /// A read failed: its frame is free again.
    pub fn fail_load(&mut self, page: PageNo, memory: M) {
        let frame = self.frame_in(page, FrameState::Loading);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, memory);
    }

    /// Pins a resident page; returns its memory and whether it is dirty, or `None` when it is not resident. With `stamp` the
    /// pin counts as a use.
    pub fn pin(&mut self, page: PageNo, stamp: bool) -> Option<(M, bool)> {
        let frame = self.find(page).filter(|&f| self.frames[f].state == FrameState::Resident)?;
        let memory = self.unqueue(frame, FrameState::Pinned);
        if stamp {
            self.frames[frame].last_use = self.clock;
        }
        Some((memory, self.frames[frame].dirty))
    }

    /// Unpins a page. It is dirty if it was dirty before or `dirty` says so.
    pub fn unpin(&mut self, page: PageNo, memory: M, dirty: bool) {
        let frame = self.frame_in(page, FrameState::Pinned);
        self.frames[frame].dirty |= dirty;
        self.set_resident(frame, memory);
    }

    /// A pinned page lost its last row: its frame is free.
    pub fn drop_pinned(&mut self, page: PageNo, memory: M) {
        let frame = self.frame_in(page, FrameState::Pinned);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, memory);
    }

    /// The write-back of a resident dirty page begins.
    pub fn begin_write(&mut self, page: PageNo) -> M {
        let frame = self.frame_in(page, FrameState::Resident);
        assert!(self.frames[frame].dirty, "a clean page is not written");
        self.unqueue(frame, FrameState::Writing)
    }

    /// A write-back ended: the page is resident, and clean if the write went well.
    pub fn finish_write(&mut self, page: PageNo, memory: M, well: bool) {
        let frame = self.frame_in(page, FrameState::Writing);
        self.frames[frame].dirty = !well;
        self.set_resident(frame, memory);
    }

    /// Evicts a resident clean page. Its frame is free, or retired if there are more frames than allowed.
    pub fn evict(&mut self, page: PageNo) {
        let frame = self.frame_in(page, FrameState::Resident);
        assert!(!self.frames[frame].dirty, "a dirty page is written before it is evicted");
        let memory = self.unqueue(frame, FrameState::Free);
        self.frame_from_page[page.index()] = ABSENT;
        self.set_free(frame, memory);
    }

    /// The page that is evicted first.
    pub fn victim(&mut self) -> Option<Victim> {
        if self.clean.first_key() > self.dirty.first_key() { self.clean_victim() } else { self.dirty_victim() }
    }

    /// The clean page that is evicted first.
    pub fn clean_victim(&mut self) -> Option<Victim> {
        self.clean.first().map(|c| Victim { page: c.page, dirty: false, next_use: c.next_use })
    }

    /// The dirty page that is evicted first.
    pub fn dirty_victim(&mut self) -> Option<Victim> {
        self.dirty.first().map(|c| Victim { page: c.page, dirty: true, next_use: c.next_use })
    }

    /// Sets the next planned step that needs a page; nothing for a page that is not in memory.
    pub fn set_next_use(&mut self, page: PageNo, next_use: u32) {
        let Some(frame) = self.find(page) else { return };
        if self.frames[frame].next_use == next_use {
            return;
        }
        self.frames[frame].next_use = next_use;
        if self.frames[frame].state == FrameState::Resident {
            let candidate = self.frames[frame].candidate();
            self.order_of(frame).insert(candidate);
        }
    }

    fn order_of(&mut self, frame: usize) -> &mut EvictOrder {
        if self.frames[frame].dirty { &mut self.dirty } else { &mut self.clean }
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

    /// The frame that was lent last: all lent frames are alike, since their memory is with the callers.
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

    fn set_free(&mut self, frame: usize, memory: M) {
        if self.excess() > 0 {
            return self.retire(frame);
        }
        self.set_state(frame, FrameState::Free);
        self.frames[frame].memory = Some(memory);
        self.free.push(frame as u32);
    }

    /// Drops the memory of a frame without a page.
    fn retire(&mut self, frame: usize) {
        self.set_state(frame, FrameState::Retired);
        self.frames[frame].memory = None;
        self.retired.push(frame as u32);
    }

    fn set_resident(&mut self, frame: usize, memory: M) {
        self.set_state(frame, FrameState::Resident);
        self.frames[frame].memory = Some(memory);
        let candidate = self.frames[frame].candidate();
        self.order_of(frame).insert(candidate);
    }

    /// Takes a resident frame out of the eviction order and its memory out of the frame.
    fn unqueue(&mut self, frame: usize, state: FrameState) -> M {
        let page = self.frames[frame].page;
        let was_there = self.order_of(frame).remove(page);
        debug_assert!(was_there, "a resident page is in the eviction order");
        self.set_state(frame, state);
        match self.frames[frame].memory.take() {
            Some(memory) => memory,
            None => panic!("a resident frame has its memory"),
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    /// A frame's memory here is one number.
    type Cache = FrameTable<u8>;

    fn load(cache: &mut Cache, page: u32, next_use: u32, mark: u8) {
        cache.begin_load(PageNo(page), next_use, || 0).unwrap();
        cache.finish_load(PageNo(page), mark);
    }

    #[test]
    fn frames_are_bounded_and_memory_stays_with_their_pages() {
        let mut cache = Cache::new(3, EvictPolicy::FarthestNextUse);
        (0..3).for_each(|i| load(&mut cache, i, 10 + i, i as u8));
        assert!(!cache.has_free() && cache.lend(|| 0).is_none() && cache.begin_load(PageNo(9), 1, || 0).is_none());
        assert_eq!(cache.victim().unwrap().page, PageNo(2));
        let (_, dirty) = cache.pin(PageNo(2), true).unwrap();
        assert!(!dirty && cache.pin(PageNo(2), true).is_none() && cache.pin(PageNo(9), true).is_none());
        assert_eq!(cache.victim().unwrap().page, PageNo(1), "pinned pages do not leave");
        cache.unpin(PageNo(2), 77, true);
        assert_eq!(cache.victim(), Some(Victim { page: PageNo(2), dirty: true, next_use: 12 }));
        assert_eq!(cache.clean_victim().unwrap().page, PageNo(1));
        // A failed write leaves it dirty, a good one clean; then it can go.
        for (well, dirty) in [(false, true), (true, false)] {
            let buffer = cache.begin_write(PageNo(2));
            assert_eq!((cache.state(PageNo(2)), buffer), (Some(FrameState::Writing), 77));
            cache.finish_write(PageNo(2), buffer, well);
            assert_eq!(cache.is_dirty(PageNo(2)), dirty);
        }
        cache.evict(PageNo(2));
        assert_eq!((cache.state(PageNo(2)), cache.frames(), cache.free_frames()), (None, 3, 1));
        cache.begin_load(PageNo(5), NEVER, || 0).map(|b| cache.fail_load(PageNo(5), b)).unwrap();
        assert_eq!((cache.state(PageNo(5)), cache.free_frames()), (None, 1));
        // The upper half of a split.
        let buffer = cache.lend(|| 0).unwrap();
        cache.adopt(PageNo(7));
        cache.unpin(PageNo(7), buffer, true);
        assert_eq!(cache.victim().unwrap().page, PageNo(7));
        let buffer = cache.pin(PageNo(7), false).unwrap().0;
        cache.drop_pinned(PageNo(7), buffer);
        let buffer = cache.lend(|| 0).unwrap();
        assert!(!cache.has_free());
        cache.take_back(buffer);
        assert_eq!((cache.free_frames(), cache.held().count()), (1, 2));
        let (first, last) = (cache.pin(PageNo(0), true).unwrap().0, cache.pin(PageNo(1), true).unwrap().0);
        assert_eq!((first, last), (0, 1));
        assert!(cache.victim().is_none() && cache.count(FrameState::Pinned) == 2);
    }

    #[test]
    #[should_panic(expected = "a dirty page is written before it is evicted")]
    fn dirty_pages_are_never_evicted() {
        let mut cache = Cache::new(1, EvictPolicy::LeastRecentlyUsed);
        load(&mut cache, 0, 1, 0);
        let buffer = cache.pin(PageNo(0), true).unwrap().0;
        cache.unpin(PageNo(0), buffer, true);
        cache.evict(PageNo(0));
    }
}
