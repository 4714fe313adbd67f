//! Prefetch: begins the reads that the coming steps will wait for, and the write-backs of the pages that are evicted for them.
//!
//! The look-ahead (`plan::look_ahead`) says which pages the coming steps will read and which pages are evicted for them: while
//! step s computes, the pages of s and of s + 1 have to be in memory. Prefetch begins those of these transfers that are possible
//! already. An evicted page has no use up to the step that gets its frame, so a prefetch reads nothing that the look-ahead's cache
//! would not read. All pages that the look-ahead evicts are equally good victims: if the first is still in use, another makes room.
//! For the next step alone, prefetch may also evict any other page that is far from its next use, which may cost a read.
//!
//! Invariants: 1. prefetch never blocks, but for [`Transfers::Ahead`]; 2. prefetch never evicts a page that is needed by the current
//! step, by the step that gets the frame, or by a step between them; 3. reads and writes in flight are bounded in bytes; 4. nothing
//! here changes what a step gets; 5. the look-ahead runs once for each step, and further calls in the same step cost what they begin.

use super::frames::table::{FrameState, Victim};
use super::plan::cache_model::FAR_STEPS;
use super::plan::look_ahead::{Admit, COMING, LookAhead};
use super::tier::{Asker, Tier};
use crate::base::ids::PageNo;
use std::collections::VecDeque;

/// When pages move. No choice changes what a step gets.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Transfers {
    /// Ahead of their step, while steps compute.
    #[default]
    Overlap,
    /// Ahead of their step, but every call waits until its pages have moved: the plan without the overlap, for comparison.
    Ahead,
    /// When a step needs them: neither plan nor overlap, for comparison.
    Demand,
}

/// What a prefetch works on.
pub(super) struct Prefetch<'a> {
    pub tier: &'a mut Tier,
    pub look_ahead: &'a mut LookAhead,
}

impl Prefetch<'_> {
    /// Starts reads for the steps after `step` and writes of the dirty pages that leave for them.
    pub fn coming_steps(&mut self, step: u32, transfers: Transfers) {
        self.tier.write_frozen();
        // Without a limit on the frames nothing is read or evicted.
        if self.tier.frames.frames_max() < usize::MAX && self.look_ahead.played != Some(step) {
            // By what is known now; a page that this step moves into the next one's view is a late miss at most.
            self.look_ahead.refresh(step, self.tier.index.metas());
            self.look_ahead.apply_changed(&mut self.tier.frames);
            self.look_ahead.play(step, self.tier.index.metas(), &self.tier.frames);
        }
        let admits = std::mem::take(&mut self.look_ahead.admits);
        let mut clean = self.leaving(&admits);
        let mut lacking = 0;
        for admit in &admits {
            if !self.tier.mover.may_read_ahead() {
                break;
            }
            if self.tier.frames.state(admit.page).is_none()
                && !self.begin_read(admit, &mut clean, step)
                && admit.step == step + 1
            {
                lacking += 1;
            }
        }
        // Write-backs of pages that are not needed for long, one for each frame that the next step lacks.
        while self.tier.frames.count(FrameState::Writing) < lacking
            && self.tier.mover.may_write_ahead()
            && let Some(victim) = self.tier.frames.dirty_victim().filter(|v| is_far(v, step))
        {
            self.tier.write_back_early(victim.page);
        }
        self.look_ahead.admits = admits;
        self.tier.mover.begin_writes();
        while transfers == Transfers::Ahead && self.tier.mover.in_flight() > 0 {
            self.tier.poll(true);
        }
    }

    /// The pages that the look-ahead evicts and that are unused already: clean pages are returned, the first to be evicted first,
    /// and write-backs of dirty pages begin. All of them are evicted unused, so any of them may make room for any page.
    fn leaving(&mut self, admits: &[Admit]) -> VecDeque<Victim> {
        let mut clean = VecDeque::new();
        for Admit { leaves, step, .. } in admits {
            let now = leaves.and_then(|page| self.tier.frames.as_victim(page)).filter(|v| v.next_use > *step);
            match now {
                Some(victim) if !victim.dirty => clean.push_back(victim),
                Some(victim) if self.tier.mover.may_write_ahead() => self.tier.write_back_early(victim.page),
                _ => {}
            }
        }
        clean
    }

    /// Begins to read a coming page, into a free frame or that of an evicted page; `false` if there is neither.
    fn begin_read(&mut self, admit: &Admit, clean: &mut VecDeque<Victim>, step: u32) -> bool {
        if !self.tier.frames.has_free() {
            let leaves = std::iter::from_fn(|| clean.pop_front()).find(|v| v.next_use > admit.step);
            // The next step may also evict any page that is not needed for long. That page may be read once more than by a cache
            // that knows the future, but waiting costs more.
            let is_next = admit.step == step + 1;
            let other = || self.tier.frames.clean_victim().filter(|v| is_next && is_far(v, step));
            let Some(victim) = leaves.or_else(other) else { return false };
            self.tier.evict(victim.page);
        }
        self.tier.begin_read(admit.page, self.look_ahead.next_use(admit.page), true)
    }

    /// Begins to read the listed pages, as far as frames and the limit on bytes in flight allow. Evicts no page that
    /// the present step needs earlier.
    pub fn listed(&mut self, pages: &[PageNo], asker: Asker) {
        self.tier.poll(false);
        self.tier.write_frozen();
        let mut lacking = 0;
        for &page in pages {
            if !self.tier.index.has_rows(page) || self.tier.frames.state(page).is_some() {
                continue;
            }
            if !self.tier.mover.may_read_ahead() {
                break;
            }
            if !self.tier.frames.has_free() {
                match self.tier.frames.victim().filter(|victim| victim.next_use > COMING) {
                    Some(victim) if !victim.dirty => self.tier.evict(victim.page),
                    Some(victim) => {
                        lacking += 1;
                        if self.tier.frames.count(FrameState::Writing) < lacking && self.tier.mover.may_write_ahead() {
                            self.tier.write_back_early(victim.page);
                        }
                        continue;
                    }
                    None => break,
                }
            }
            if self.tier.begin_read(page, self.look_ahead.next_use(page), true) {
                self.tier.count_read(page, asker);
            }
        }
        self.tier.mover.begin_writes();
    }
}

/// Whether a page is not needed for long after `step`.
fn is_far(victim: &Victim, step: u32) -> bool {
    victim.next_use > step.saturating_add(1 + FAR_STEPS)
}
