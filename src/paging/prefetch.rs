//! Prefetch: begins the reads that the coming steps will wait for, and the write-backs of the pages that are evicted for them.
//!
//! The look-ahead (`plan::look_ahead`) says which pages the coming steps will read and which pages are evicted for them: while
//! step s computes, the pages of s and of s + 1 have to be in memory. Prefetch does as much of that as is possible already. An
//! evicted page is unused until the step that it leaves for, so a prefetch reads nothing that the look-ahead's cache would not
//! read. Any page that the look-ahead evicts is an equally good victim: if the first of them is in use, another one makes room.
//! For the next step alone prefetch may also evict any other page that is far from its next use, which may cost a read.
//!
//! Invariants: 1. prefetch never blocks, but for [`Transfers::Ahead`]; 2. prefetch never evicts a page that the current step or a
//! step up to the one that the frame is for needs; 3. reads and writes in flight are bounded in bytes; 4. nothing here changes
//! what a step gets; 5. the look-ahead runs once for each step, and further calls in the same step cost what they begin.

use super::frames::frame::FrameState;
use super::frames::table::Victim;
use super::pager::Pager;
use super::plan::cache_model::FAR_STEPS;
use super::plan::look_ahead::Admit;
use super::timing::Transfers;
use super::transfers::Failure;
use std::collections::VecDeque;

impl Pager {
    /// Starts reads for the steps after `step` and writes of the dirty pages that leave for them, as far as [`Transfers`] says. Call it
    /// when the pages of `step` are pinned. Calling it again during the step continues what became possible since.
    pub fn prefetch(&mut self, step: u32) {
        if self.transfers == Transfers::Demand {
            return;
        }
        self.poll_completions(false);
        if !self.mover.has_store() {
            return;
        }
        self.write_frozen();
        // Without a limit on the frames nothing is read or evicted.
        if self.frames.frames_max() < usize::MAX && self.look_ahead.is_due(step) {
            // By what is known now; a page that this step moves into the next one's view is a late miss at most.
            self.look_ahead.refresh(step, self.index.metas());
            self.apply_changed_uses();
            self.look_ahead.play(step, self.index.metas(), &self.frames);
        }
        let admits = self.look_ahead.take_admits();
        let mut clean = self.leaving(&admits);
        let mut lacking = 0;
        for admit in &admits {
            if !self.mover.may_read_ahead() {
                break;
            }
            if self.frames.state(admit.page).is_none()
                && !self.begin_prefetch(admit, &mut clean, step)
                && admit.step == step + 1
            {
                lacking += 1;
            }
        }
        self.clean_for_next_step(lacking, step);
        self.look_ahead.return_admits(admits);
        self.mover.begin_writes();
        while self.transfers == Transfers::Ahead && self.mover.in_flight() > 0 {
            self.poll_completions(true);
        }
    }

    /// The pages that the look-ahead evicts and that are unused already: clean pages are returned, the first to be evicted first,
    /// and write-backs of dirty pages begin. All of them are evicted unused, so any of them may make room for any page.
    fn leaving(&mut self, admits: &[Admit]) -> VecDeque<Victim> {
        let mut clean = VecDeque::new();
        for Admit { leaves, step, .. } in admits {
            let now = leaves.and_then(|page| self.frames.as_victim(page)).filter(|v| v.next_use > *step);
            match now {
                Some(victim) if !victim.dirty => clean.push_back(victim),
                Some(victim) if self.mover.may_write_ahead() => self.write_back_early(victim),
                _ => {}
            }
        }
        clean
    }

    /// Begins to read a coming page, into a free frame or that of an evicted page; `false` if there is neither.
    fn begin_prefetch(&mut self, admit: &Admit, clean: &mut VecDeque<Victim>, step: u32) -> bool {
        if !self.frames.has_free() {
            let leaves = std::iter::from_fn(|| clean.pop_front()).find(|v| v.next_use > admit.step);
            // The next step may also evict any page that is not needed for long. That page may be read once more than by a cache
            // that knows the future, but waiting costs more.
            let is_next = admit.step == step + 1;
            let other = || self.frames.clean_victim().filter(|v| is_next && is_far(v, step));
            let Some(victim) = leaves.or_else(other) else { return false };
            self.evict(victim.page);
        }
        self.begin_read(admit.page, true)
    }

    /// Begins write-backs of pages that are not needed for long, one for each frame that the next step lacks.
    fn clean_for_next_step(&mut self, lacking: usize, step: u32) {
        while self.frames.count(FrameState::Writing) < lacking
            && self.mover.may_write_ahead()
            && let Some(victim) = self.frames.dirty_victim().filter(|v| is_far(v, step))
        {
            self.write_back_early(victim);
        }
    }

    pub(super) fn write_back_early(&mut self, victim: Victim) {
        if let Err(Failure { error, .. }) = self.begin_write(victim.page, true) {
            // The next step gets the error.
            let _ = self.mover.stop_writes(error, false);
        }
    }
}

/// Whether a page is not needed for long after `step`.
fn is_far(victim: &Victim, step: u32) -> bool {
    victim.next_use > step.saturating_add(1 + FAR_STEPS)
}
