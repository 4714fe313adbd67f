//! Begins what the coming steps will wait for: reads of their pages, and writes of the pages that leave for them.
//!
//! The coming steps are played through with the pages in memory, as a cache would that knows the future and lets no step
//! wait: while step s computes, the pages of s and of s + 1 have to be there, and for every page of s + 1 that is missing
//! the page leaves that is needed last of all others. Where that one would be needed again soon, the pages of s may leave
//! as well, at the end of s, and s + 1 waits for what takes their place: see `FAR_STEPS`. What of all that can be done
//! already is done: the leaving page is free of use until then, so nothing is read that this cache would not have read. All
//! that leave in the time that is played through are alike: where the page that leaves first is in use still, another one
//! of them makes room. For the next step alone any other page does that is far from its next use, which may cost a read.
//!
//! Invariants: 1. never blocks, but for [`Transfers::Ahead`]; 2. never takes the frame of a page that the current step or
//! a step up to the one that the frame is for needs; 3. reads and writes in flight are bounded in bytes; 4. nothing here
//! changes what a step gets; 5. the steps are played once for each step, further calls in the same one cost what they begin.

use super::fetch::Asker;
use super::pager::Pager;
use super::transfers::{Failure, READS, WRITES};
use crate::base::ids::PageNo;
use crate::cache::evict::EvictPolicy;
use crate::cache::frame::FrameState;
use crate::cache::host_cache::Victim;
use crate::schedule::model::FAR_STEPS;
use crate::schedule::replay::STEPS_AHEAD;
use std::collections::{BinaryHeap, VecDeque};

/// Steps that are planned anew, by the bounds as they are now, counted from the present one: the next, the last that is
/// played through, and one far enough for pages to be kept for it. Pages were planned up to two epochs before, and their
/// rows move. Without the latter two a cache for half of a small survey read 8 % more, for half of a large one 2 %.
const PLANNED_ANEW: [u32; 3] = [1, STEPS_AHEAD, 4 * STEPS_AHEAD];

/// When pages move. None of these changes what a step gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transfers {
    /// Ahead of their step, while steps compute.
    #[default]
    Overlap,
    /// Ahead of their step, but whoever asked waits until they have moved: the plan without the overlap, for comparison.
    Ahead,
    /// When a step needs them: neither plan nor overlap, for comparison.
    Demand,
}

/// A page that a coming step will need.
#[derive(Debug)]
struct Admit {
    page: PageNo,
    step: u32,
    /// The page that leaves for it; `None` where a frame is free.
    leaves: Option<PageNo>,
}

/// What the steps after one will have to read, in order; kept between steps for its allocations.
#[derive(Debug, Default)]
pub(super) struct Coming {
    /// The step that it was played for.
    after: Option<u32>,
    admits: Vec<Admit>,
    play: Play,
}

/// The frames as they will be.
#[derive(Debug, Default)]
struct Play {
    policy: EvictPolicy,
    free: usize,
    /// By page: next use and time since the last use, while it is in memory.
    keys: Vec<Option<(u32, u32)>>,
    /// (next use, time since the last use, page), the last leaves first; entries that differ from `keys` are out of date.
    order: BinaryHeap<(u32, u32, PageNo)>,
    /// Pages that the step being played needs, ascending: in memory, and not in the order.
    present: Vec<PageNo>,
}

impl Pager {
    /// Starts reads for the steps after `step` and writes of the dirty pages that leave for them, as far as [`Transfers`] says. Call it
    /// when the pages of `step` are pinned. Calling it again during the step continues what became possible since.
    pub fn prefetch(&mut self, step: u32) {
        if self.transfers == Transfers::Demand {
            return;
        }
        self.settle_for_nobody(false);
        if self.store.is_none() {
            return;
        }
        self.write_frozen();
        let mut coming = std::mem::take(&mut self.coming);
        if coming.after != Some(step) {
            // By what is known now; a page that this step moves into the next one's view is a late miss at most.
            PLANNED_ANEW.into_iter().for_each(|far| self.window.refresh(step.saturating_add(far), &self.index));
            self.apply_changed_uses();
            self.play(step, &mut coming);
        }
        let mut clean = self.leaving(&coming.admits);
        let mut lacking = 0;
        for admit in &coming.admits {
            if !self.may_read_ahead() {
                break;
            }
            if self.cache.state(admit.page).is_none() && !self.bring(admit, &mut clean, step) && admit.step == step + 1
            {
                lacking += 1;
            }
        }
        self.clean_for_next_step(lacking, step);
        self.coming = coming;
        if let Some(store) = &mut self.store {
            store.begin_writes();
        }
        while self.transfers == Transfers::Ahead && self.in_flight() > 0 {
            self.settle_for_nobody(true);
        }
    }

    /// Takes the ends of transfers that nobody waits for.
    pub(super) fn settle_for_nobody(&mut self, wait: bool) {
        for Failure { is_write, error, .. } in self.settle(wait, &mut Vec::new()) {
            if is_write {
                // The next step gets the error.
                let _ = self.stop_writes(error, Asker::Other);
            }
        }
    }

    /// The pages that leave and can do so already: clean ones are returned, the first to leave first, dirty ones begin to
    /// be written. As all of them leave unused, whichever is taken for whichever page costs nothing.
    fn leaving(&mut self, admits: &[Admit]) -> VecDeque<Victim> {
        let mut clean = VecDeque::new();
        for Admit { leaves, step, .. } in admits {
            let now = leaves.and_then(|page| self.cache.as_victim(page)).filter(|v| v.next_use > *step);
            match now {
                Some(victim) if !victim.dirty => clean.push_back(victim),
                Some(victim) if self.may_write_ahead() => self.clean_early(victim),
                _ => {}
            }
        }
        clean
    }

    /// Begins to read a coming page, into a free frame or that of a page that leaves; `false` if there is none.
    fn bring(&mut self, admit: &Admit, clean: &mut VecDeque<Victim>, step: u32) -> bool {
        if !self.cache.has_free() {
            let leaves = std::iter::from_fn(|| clean.pop_front()).find(|v| v.next_use > admit.step);
            // For the next step any page that is not needed for long will do. It may have to be read once more than the
            // cache that knows the future would, but waiting costs more.
            let is_next = admit.step == step + 1;
            let other = || self.cache.clean_victim().filter(|v| is_next && is_far(v, step));
            let Some(victim) = leaves.or_else(other) else { return false };
            self.evict(victim.page);
        }
        self.begin_read(admit.page, true)
    }

    /// Begins to write as many pages that are not needed for long as the next step lacks frames.
    fn clean_for_next_step(&mut self, lacking: usize, step: u32) {
        while self.cache.count(FrameState::Writing) < lacking
            && self.may_write_ahead()
            && let Some(victim) = self.cache.dirty_victim().filter(|v| is_far(v, step))
        {
            self.clean_early(victim);
        }
    }

    fn clean_early(&mut self, victim: Victim) {
        if let Err(Failure { error, .. }) = self.begin_write(victim.page, true) {
            // The next step gets the error.
            let _ = self.stop_writes(error, Asker::Other);
        }
    }

    /// The pages that the steps after `step` will have to read, in order.
    fn play(&self, step: u32, coming: &mut Coming) {
        let Coming { after, admits, play } = coming;
        *after = Some(step);
        admits.clear();
        play.begin(self);
        let mut present = std::mem::take(&mut play.present);
        for s in step..step.saturating_add(STEPS_AHEAD) {
            let Some(next) = self.window.pages(s + 1) else { break };
            let first = admits.len();
            for &page in next {
                if present.binary_search(&page).is_ok() || play.take_out(page) || self.index[page.index()].rows == 0 {
                    continue;
                }
                admits.push(Admit { page, step: s + 1, leaves: None });
            }
            // What stays is known when all that the next step needs is out of the order.
            let is_past = |page: &PageNo| next.binary_search(page).is_err() && self.index[page.index()].rows > 0;
            let mut past = present.iter().copied().filter(is_past);
            let mut put_in =
                |play: &mut Play| past.by_ref().for_each(|p| play.put_in(p, self.window.next_use_after(p, s)));
            for i in first..admits.len() {
                let leaves = play.room((s + 1).saturating_add(FAR_STEPS)).or_else(|| {
                    put_in(play);
                    play.room(s + 1)
                });
                let Some(leaves) = leaves else {
                    play.present = present;
                    return admits.truncate(i);
                };
                admits[i].leaves = leaves;
            }
            put_in(play);
            present.clear();
            present.extend_from_slice(next);
        }
        play.present = present;
    }

    fn may_read_ahead(&self) -> bool {
        self.has_staging() && self.ahead[READS] + self.cache.frame_bytes() <= self.config.prefetch_bytes
    }

    pub(super) fn may_write_ahead(&self) -> bool {
        !self.writes_stopped
            && self.has_staging()
            && self.ahead[WRITES] + self.cache.frame_bytes() <= self.config.prefetch_bytes
    }
}

/// Whether a page is not needed for long after `step`.
fn is_far(victim: &Victim, step: u32) -> bool {
    victim.next_use > step.saturating_add(1 + FAR_STEPS)
}

impl Play {
    /// The frames as they are; those of the present step are apart.
    fn begin(&mut self, pager: &Pager) {
        self.policy = pager.config.policy;
        self.free = pager.cache.free_frames();
        self.keys.clear();
        self.keys.resize(pager.index.len(), None);
        let mut order = std::mem::take(&mut self.order).into_vec();
        order.clear();
        self.present.clear();
        for held in pager.cache.held() {
            if pager.cache.state(held.page) == Some(FrameState::Pinned) {
                self.present.push(held.page);
                continue;
            }
            let (next_use, idle) = self.key(held.next_use, u32::MAX - held.last_use);
            self.keys[held.page.index()] = Some((next_use, idle));
            order.push((next_use, idle, held.page));
        }
        self.order = BinaryHeap::from(order);
        self.present.sort_unstable();
    }

    fn key(&self, next_use: u32, idle: u32) -> (u32, u32) {
        match self.policy {
            EvictPolicy::FarthestNextUse => (next_use, idle),
            EvictPolicy::LeastRecentlyUsed => (0, idle),
        }
    }

    /// Takes a page that is in memory out of the order; `false` if it is not there.
    fn take_out(&mut self, page: PageNo) -> bool {
        self.keys[page.index()].take().is_some()
    }

    fn put_in(&mut self, page: PageNo, next_use: u32) {
        let (next_use, idle) = self.key(next_use, 0);
        self.keys[page.index()] = Some((next_use, idle));
        self.order.push((next_use, idle, page));
    }

    /// Room for one page: the page that leaves, `Some(None)` for a free frame, `None` when all that is left is in use or
    /// needed again up to step `last`.
    fn room(&mut self, last: u32) -> Option<Option<PageNo>> {
        if self.free > 0 {
            self.free -= 1;
            return Some(None);
        }
        while let Some((next_use, idle, page)) = self.order.pop() {
            if self.keys[page.index()] != Some((next_use, idle)) {
                continue;
            }
            if self.policy == EvictPolicy::FarthestNextUse && next_use <= last {
                self.order.push((next_use, idle, page));
                return None;
            }
            self.keys[page.index()] = None;
            return Some(Some(page));
        }
        None
    }
}
