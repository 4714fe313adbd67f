//! The look-ahead of a run: which pages the coming steps will have to read, and which pages are evicted for them.
//!
//! The look-ahead steps a [`CacheModel`] through the planned steps, starting with the pages that are in memory now. It decides
//! nothing that a simulation would not decide: both step the same model.
//!
//! In the middle of a step that walks its view in batches, the plan of the coming steps does not know which pages this step
//! still needs. So the step says so ([`UseInStep`]), and pages that it still needs are evicted after all others.
//!
//! Invariants: 1. the steps are played once for each step of the run; 2. nothing here moves a page; 3. pages that a step needs
//! again are evicted only for pages that it needs earlier.

use super::batches::pages_per_batch;
use super::cache_model::{CacheModel, STEPS_AHEAD, StepChange};
use super::views::ViewPlan;
use crate::base::ids::PageNo;
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::frames::table::{FrameState, FrameTable};
use crate::scene::page_meta::PageMeta;
use std::collections::BTreeMap;

/// The coming steps (counted from the present step) whose page lists are made again before the look-ahead, by the
/// current bounds: the next step, the last step that is played, and a step so far ahead that pages are kept for it. A
/// list may be two epochs old, and rows have moved since. Without the last two, a cache for half of a small survey read
/// 8 % more, and for half of a large survey 2 % more.
const REFRESHED: [u32; 3] = [1, STEPS_AHEAD, 4 * STEPS_AHEAD];
/// Bounds of pages that [`LookAhead::refresh_near`] tests for a step: some .3 ms.
const NEAR_BOUNDS: usize = 50_000;

/// Next use of a page that a coming batch of the present step needs: before every step.
pub(in crate::paging) const COMING: u32 = 0;

/// How the present step, which walks its view in batches, still uses a page.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum UseInStep {
    /// A batch that is still to come in the present pass needs the page.
    Coming,
    /// The page has been in, and the pass out needs the page again.
    Returning,
    /// The step is done with the page.
    Done,
}

/// A page that a coming step will have to read.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(in crate::paging) struct Admit {
    pub page: PageNo,
    pub step: u32,
    /// The page that is evicted for it; `None` where a frame is free.
    pub leaves: Option<PageNo>,
}

/// The plan of the coming views, and what follows from it for the frames.
#[derive(Debug)]
pub(in crate::paging) struct LookAhead {
    pub views: ViewPlan,
    /// Next uses of the pages that the present step still needs, where it walks its view in batches.
    in_step: BTreeMap<PageNo, u32>,
    /// The step that was played last.
    pub played: Option<u32>,
    /// The pages that the played steps will have to read, in order.
    pub admits: Vec<Admit>,
    model: CacheModel,
}

impl LookAhead {
    /// A look-ahead whose plan takes at most about `plan_bytes` bytes.
    pub fn new(policy: EvictPolicy, plan_bytes: usize) -> LookAhead {
        LookAhead {
            views: ViewPlan::new(plan_bytes),
            in_step: BTreeMap::new(),
            played: None,
            admits: Vec::new(),
            model: CacheModel::new(0, policy).reading_ahead(),
        }
    }

    /// The next use of a page: in the present step if it walks its view in batches, else the first planned step.
    pub fn next_use(&self, page: PageNo) -> u32 {
        self.in_step.get(&page).copied().unwrap_or_else(|| self.views.next_use(page))
    }

    /// Tells the frame table of next uses that changed.
    pub fn apply_changed<M>(&mut self, frames: &mut FrameTable<M>) {
        self.views.take_changed().into_iter().for_each(|page| frames.set_next_use(page, self.next_use(page)));
    }

    /// Notes how the present step still uses these pages.
    pub fn set_use_in_step<M>(
        &mut self,
        step: u32,
        pages: impl IntoIterator<Item = PageNo>,
        how: UseInStep,
        frames: &mut FrameTable<M>,
    ) {
        if how == UseInStep::Done && self.in_step.is_empty() {
            return;
        }
        for page in pages {
            match how {
                UseInStep::Coming => self.in_step.insert(page, COMING),
                UseInStep::Returning => self.in_step.insert(page, step),
                UseInStep::Done => self.in_step.remove(&page),
            };
            frames.set_next_use(page, self.next_use(page));
        }
    }

    /// The present step has ended: it uses no page any more.
    pub fn end_step<M>(&mut self, frames: &mut FrameTable<M>) {
        let pages = std::mem::take(&mut self.in_step);
        pages.into_keys().for_each(|page| frames.set_next_use(page, self.next_use(page)));
    }

    /// Makes the page lists anew that the next [`LookAhead::play`] depends on most.
    pub fn refresh(&mut self, step: u32, index: &[PageMeta]) {
        REFRESHED.into_iter().for_each(|far| self.views.refresh(step.saturating_add(far), index));
    }

    /// Makes the page lists of the coming steps again, for as many steps as [`NEAR_BOUNDS`] allows: for all steps in a
    /// small scene. A tier above that holds few pages needs this, since an inexact next use would evict the wrong page.
    pub fn refresh_near(&mut self, step: u32, index: &[PageMeta]) {
        let steps = (NEAR_BOUNDS / index.len().max(1)) as u32;
        let planned = self.views.planned_to().saturating_sub(step);
        (1..=steps.min(planned)).for_each(|far| self.views.refresh(step + far, index));
    }

    /// Plays the steps after `step`, whose pages are pinned, with the pages that `frames` holds. The result is in
    /// `admits`.
    pub fn play<M>(&mut self, step: u32, index: &[PageMeta], frames: &FrameTable<M>) {
        self.played = Some(step);
        self.admits.clear();
        let held = |pinned: bool| {
            frames.held().filter(move |(state, _)| (*state == FrameState::Pinned) == pinned).map(|(_, page)| page)
        };
        self.model.restart(step, frames.free_frames(), held(true).map(|c| c.page), held(false));
        let (mut pages, mut change) = (Vec::new(), StepChange::default());
        for coming in step + 1..=step.saturating_add(STEPS_AHEAD) {
            let Some(planned) = self.views.pages(coming) else { break };
            pages.clear();
            pages.extend(planned.iter().copied().filter(|page| index[page.index()].rows > 0));
            // A step that walks its view in batches ends the look-ahead, with its first batch.
            let per_batch = pages_per_batch(pages.len(), self.model.frames());
            let is_cut = per_batch < pages.len();
            if is_cut {
                pages.sort_unstable_by_key(|page| index[page.index()].id);
                pages.truncate(per_batch);
            }
            let next_use = |page| self.views.next_use_after(page, coming);
            if self.model.step(coming, &pages, next_use, &mut change).is_err() {
                break;
            }
            self.admits.extend(change.pairs().map(|(page, leaves)| Admit { page, step: coming, leaves }));
            if is_cut {
                break;
            }
        }
    }
}
