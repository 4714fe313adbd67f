//! Begins what the coming steps will wait for: reads of their pages, and writes of the pages that leave for them.
//!
//! The coming steps are played through with the pages in memory, as a cache that knows the future would: for every page
//! that is missing at step s, the page leaves that is needed last of all that are there at s. What of that can be done
//! already is done: the leaving page is free of use until s, so nothing is read that the cache would not have read at s.
//! All that leave in the time that is played through are alike: where the page that leaves first is pinned still,
//! another one of them makes room.
//!
//! Invariants: 1. never blocks, but for [`Transfers::Ahead`]; 2. never takes the frame of a page that the current step or a step up to the one that
//! the frame is for needs; 3. reads and writes in flight are bounded in bytes; 4. nothing here changes what a step gets.

use super::pager::Pager;
use super::transfers::{Failure, READS, WRITES};
use crate::base::ids::PageNo;
use crate::cache::evict::EvictPolicy;
use crate::cache::host_cache::Victim;
use std::collections::{BTreeSet, HashMap, VecDeque};
use std::str::FromStr;

/// Steps that are played through at most.
const STEPS_AHEAD: u32 = 16;
/// A page that is not needed for so many steps may leave early for a page that the next step would wait for: at most one
/// read more in so many steps.
const FAR_STEPS: u32 = 4 * STEPS_AHEAD;

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

impl FromStr for Transfers {
    type Err = String;
    fn from_str(name: &str) -> Result<Self, String> {
        match name {
            "overlap" => Ok(Transfers::Overlap),
            "ahead" => Ok(Transfers::Ahead),
            "demand" => Ok(Transfers::Demand),
            _ => Err(format!("'{name}' is no time for transfers")),
        }
    }
}

/// A page that a coming step will need.
struct Admit {
    page: PageNo,
    step: u32,
    /// The page that leaves for it; `None` where a frame is free.
    leaves: Option<PageNo>,
}

/// The frames as they will be.
struct Play {
    policy: EvictPolicy,
    free: usize,
    /// Key of each page in memory.
    keys: HashMap<PageNo, (u32, u32)>,
    /// (next use, time since the last use, page), the last leaves first.
    order: BTreeSet<(u32, u32, PageNo)>,
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
        // The next step by what is known now; a page that this step moves into its view is a late miss at most.
        self.window.refresh(step + 1, &self.index);
        self.apply_changed_uses();
        let admits = self.play(step);
        let mut clean = self.leaving(&admits);
        for admit in admits {
            if !self.may_read_ahead() {
                break;
            }
            if self.cache.state(admit.page).is_none() {
                self.bring(&admit, &mut clean, admit.step == step + 1);
            }
        }
        while self.transfers == Transfers::Ahead && self.in_flight() > 0 {
            self.settle_for_nobody(true);
        }
    }

    /// Takes the ends of transfers that nobody waits for.
    fn settle_for_nobody(&mut self, wait: bool) {
        for Failure { is_write, error, .. } in self.settle(wait, &mut Vec::new()) {
            if is_write {
                // The next step gets the error.
                let _ = self.stop_writes(error, false);
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
                Some(victim) if self.may_write_ahead() => {
                    if let Err(Failure { error, .. }) = self.begin_write(victim.page, true) {
                        // The next step gets the error.
                        let _ = self.stop_writes(error, false);
                    }
                }
                _ => {}
            }
        }
        clean
    }

    /// Begins to read a coming page, into a free frame or that of a page that leaves.
    fn bring(&mut self, admit: &Admit, clean: &mut VecDeque<Victim>, is_next: bool) {
        if !self.cache.has_free() {
            let leaves = std::iter::from_fn(|| clean.pop_front()).find(|v| v.next_use > admit.step);
            // For the next step any page that is not needed for long will do. It may have to be read once more than the
            // cache that knows the future would, but waiting costs more.
            let far = admit.step.saturating_add(FAR_STEPS);
            let other = || self.cache.clean_victim().filter(|v| is_next && v.next_use > far);
            let Some(victim) = leaves.or_else(other) else { return };
            self.evict(victim.page);
        }
        self.begin_read(admit.page, true);
    }

    /// The pages that the steps after `step` will have to read, in order, as far as the transfers in flight may go.
    fn play(&self, step: u32) -> Vec<Admit> {
        let admits_max = 2 * (self.config.prefetch_bytes / self.cache.frame_bytes());
        let mut play = Play::new(self);
        let mut admits = Vec::new();
        for s in step + 1..=step.saturating_add(STEPS_AHEAD) {
            let Some(pages) = self.window.pages(s).filter(|_| admits.len() < admits_max) else { break };
            let missing: Vec<PageNo> = pages.iter().copied().filter(|p| !play.take_out(*p)).collect();
            for page in missing {
                if self.index[page.index()].rows == 0 {
                    continue;
                }
                let Some(leaves) = play.room() else { return admits };
                admits.push(Admit { page, step: s, leaves });
            }
            for &page in pages {
                play.put_in(page, self.window.next_use_after(page, s));
            }
        }
        admits
    }

    fn may_read_ahead(&self) -> bool {
        self.ahead[READS] + self.cache.frame_bytes() <= self.config.prefetch_bytes
    }

    pub(super) fn may_write_ahead(&self) -> bool {
        !self.writes_stopped && self.ahead[WRITES] + self.cache.frame_bytes() <= self.config.prefetch_bytes
    }
}

impl Play {
    fn new(pager: &Pager) -> Play {
        let policy = pager.config.policy;
        let mut play = Play { policy, free: pager.cache.free_frames(), keys: HashMap::new(), order: BTreeSet::new() };
        for held in pager.cache.held() {
            play.insert(held.page, held.next_use, u32::MAX - held.last_use);
        }
        play
    }

    fn insert(&mut self, page: PageNo, next_use: u32, idle: u32) {
        let next_use = match self.policy {
            EvictPolicy::FarthestNextUse => next_use,
            EvictPolicy::LeastRecentlyUsed => 0,
        };
        self.keys.insert(page, (next_use, idle));
        self.order.insert((next_use, idle, page));
    }

    /// Takes a page that is in memory out of the order; `false` if it is not there.
    fn take_out(&mut self, page: PageNo) -> bool {
        self.keys.remove(&page).is_some_and(|(next_use, idle)| self.order.remove(&(next_use, idle, page)))
    }

    fn put_in(&mut self, page: PageNo, next_use: u32) {
        self.insert(page, next_use, 0);
    }

    /// Room for one page: the page that leaves, `Some(None)` for a free frame, `None` when all that is left is in use.
    fn room(&mut self) -> Option<Option<PageNo>> {
        if self.free > 0 {
            self.free -= 1;
            return Some(None);
        }
        let (_, _, page) = self.order.pop_last()?;
        self.keys.remove(&page);
        Some(Some(page))
    }
}
