//! The pager hands out the pages of a view and takes them back, and makes them durable.
//!
//! The pager composes parts that do not know it: `tier` (which pages are in memory, and what moves), `look_ahead`
//! (what the coming steps need), `fetch` (brings pages in for a caller who waits), `prefetch` (reads ahead of steps).
//!
//! A commit is either done at once, between two steps ([`Pager::flush`], [`Pager::commit`]), or beside training
//! ([`Pager::freeze`] to [`Pager::commit_frozen`]; `cut` says how). A view that is larger than the frames is pinned part by part:
//! [`Pager::begin_view`] lists the pages, and [`super::plan::batches`] says how many of them are pinned at once.
//!
//! Invariants: 1. `acquire` gives every page that the view may see by the bounds as they are now, whatever was planned;
//! 2. a page's buffer is in one place: in its frame, with the mover, or with the caller who pinned it; 3. what a step
//! reads and writes never depends on frames, plan or store; 4. a page with rows that is not in memory has a slot, and the
//! slot holds exactly what was last released; 5. after [`Pager::flush`] nothing is in flight and no page in memory is dirty;
//! 6. a commit names every page with rows, by exactly the version that was last released; 7. a frozen page is never pinned, so what is
//! written is what the page was at the cut; 8. when a write fails, the cut is given up; 9. entries from a store are taken over only
//! if their slots can hold what they say.

use super::cut::{Cuts, Frozen, nowhere};
use super::error::PagingError;
use super::fetch::Fetch;
use super::frames::evict::EvictPolicy;
use super::frames::table::{FrameState, FrameTable};
use super::index::PageIndex;
use super::mover::Mover;
use super::pinned::PinnedPage;
use super::plan::batches::pages_per_batch;
use super::plan::look_ahead::{LookAhead, UseInStep};
use super::prefetch::{Prefetch, Transfers};
use super::stats::{Counters, PagerStats, SlotSpace};
use super::stored::PageLimits;
use super::tier::{Asker, Tier};
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::{HEADER_BYTES, transfer_bytes};
use crate::page::map::commit::{CommitError, Commits, Cut};
use crate::page::map::opening::StoredPage;
use crate::page::versions::paged_store::PagedStore;
use crate::scene::camera::Camera;
use crate::scene::page_layout::{PageLayout, capacity_bytes};
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;

/// Sizes of a pager. None of them changes a bit of the rows.
#[derive(Debug, Clone, Copy)]
pub struct PagerConfig {
    /// The most rows of a page.
    pub page_rows: usize,
    /// Degree of the scene: a frame holds a full page of that degree.
    pub sh_degree: u8,
    /// The most pages in memory; `usize::MAX` for no limit.
    pub frames: usize,
    /// Which page is evicted first.
    pub policy: EvictPolicy,
    /// The most bytes that [`Pager::prefetch`] has in flight, reads and writes each.
    pub prefetch_bytes: usize,
    /// Bytes for the plan of the coming steps; what does not fit is planned later.
    pub plan_bytes: usize,
    /// When planned transfers go on.
    pub transfers: Transfers,
}

impl PagerConfig {
    /// Everything in memory, for pages of `page_rows` rows.
    pub fn in_memory(page_rows: usize, sh_degree: u8) -> PagerConfig {
        let (policy, transfers) = (EvictPolicy::default(), Transfers::default());
        PagerConfig { page_rows, sh_degree, frames: usize::MAX, policy, prefetch_bytes: 0, plan_bytes: 0, transfers }
    }

    /// Bytes of one frame: header space and the payload of a full page, as a slot has them.
    pub fn frame_bytes(&self) -> usize {
        transfer_bytes(capacity_bytes(self.page_rows, self.sh_degree))
    }
}

/// The pages of a scene: the parts that hold, move and plan them.
#[derive(Debug)]
pub struct Pager {
    config: PagerConfig,
    tier: Tier,
    look_ahead: LookAhead,
}

impl Pager {
    /// A pager with `config.frames` frames over a store whose slots are as large as the frames.
    pub fn new(config: PagerConfig, store: PagedStore) -> Pager {
        let mut pager = Pager::in_memory(config);
        pager.tier.mover.attach(store);
        pager
    }

    /// A pager that keeps every page in memory, in as many frames as needed.
    pub fn in_memory(config: PagerConfig) -> Pager {
        let tier = Tier {
            index: PageIndex::default(),
            frames: FrameTable::new(config.frames, config.policy),
            mover: Mover::new(config.frame_bytes(), config.prefetch_bytes),
            cuts: Cuts::default(),
            counters: Counters::default(),
        };
        let look_ahead = LookAhead::new(config.policy, config.plan_bytes);
        Pager { tier, look_ahead, config }
    }

    /// A pager over a store that holds these pages, none of them in memory. `events` is the length of the event log.
    /// Errors: an entry contradicts itself or its slot.
    pub fn open(
        config: PagerConfig,
        store: PagedStore,
        pages: &[StoredPage],
        events: usize,
    ) -> Result<Pager, CommitError> {
        let mut pager = Pager::new(config, store);
        for stored in pages {
            let limits = PageLimits { page_rows: config.page_rows, sh_degree: config.sh_degree, events };
            let meta = limits
                .meta_of(stored.page, &stored.slot, &stored.label)
                .map_err(|what| CommitError::Contradiction(format!("page {}: {what}", stored.page)))?;
            pager.tier.index.push(meta, Some(stored.slot));
            pager.tier.cuts.add_committed(stored.page, stored.slot.generation);
        }
        Ok(pager)
    }

    /// Gives a pager whose pages never left memory a store of its frames' size, which is empty: from here on the pager can be
    /// committed. Nothing is written before that.
    pub fn attach(&mut self, store: PagedStore) {
        self.tier.mover.attach(store);
        // These pages are in memory: no cache would have had to read them.
        (0..self.index().len()).for_each(|page| self.tier.counters.bound.add(PageNo(page as u32)));
    }

    /// Continues the counters of an earlier life of the run.
    pub fn restore_stats(&mut self, past: PagerStats) {
        self.tier.counters.stats = past;
    }

    /// Adds an initial page. `fill` writes its rows into the payload space (all of it is given; see
    /// [`crate::scene::page_layout::write_page`]), in the layout that `meta` names.
    /// Errors: the store failed while a frame was emptied.
    pub fn insert(&mut self, meta: PageMeta, fill: impl FnOnce(&mut [u8])) -> Result<PageNo, PagingError> {
        if meta.rows == 0 {
            return Ok(self.tier.add_entry(meta));
        }
        self.tier.write_behind()?;
        let mut buffer = self.tier.frame_for(Asker::Other)?;
        fill(&mut buffer.as_mut_slice()[HEADER_BYTES..]);
        let page = self.tier.add_entry(meta);
        self.tier.frames.adopt(page);
        self.tier.frames.unpin(page, buffer, true);
        Ok(page)
    }

    /// Raises the number of frames, once the memory that is left for them is known.
    pub fn allow_frames(&mut self, frames: usize) {
        self.tier.frames.allow_frames(frames);
    }

    /// Lowers the number of frames to `frames`. To be called between steps: pages are evicted, and dirty pages written back,
    /// until no frame is in excess; the time counts as waited. If a page cannot be written, the next step gets the error, and the
    /// frame is given up once the page is written.
    pub fn limit_frames(&mut self, frames: usize) {
        self.tier.frames.limit_frames(frames);
        while self.tier.frames.excess() > 0 {
            match self.tier.make_room(0, Asker::Step) {
                Ok(true) => {}
                Ok(false) if self.tier.mover.in_flight() == 0 => return,
                Ok(false) => self.tier.poll(true),
                Err(error) => {
                    self.tier.mover.keep_failure(error);
                    return;
                }
            }
        }
    }

    /// Begins to move pages between memory and the store: for a pager whose pages were all in memory, and whose store holds all
    /// of them. The sizes are those of [`PagerConfig`].
    pub fn begin_paging(&mut self, frames: usize, prefetch_bytes: usize, plan_bytes: usize) {
        assert!(self.tier.mover.has_store(), "pages that leave memory have a store to go to");
        self.tier.mover.ahead_max = prefetch_bytes;
        self.config.plan_bytes = plan_bytes;
        self.look_ahead = LookAhead::new(self.config.policy, plan_bytes);
        self.limit_frames(frames);
    }

    /// Limits the plan of the coming steps to about `bytes` bytes from now on: the farthest steps are dropped from it.
    pub fn limit_plan(&mut self, bytes: usize) {
        self.config.plan_bytes = bytes;
        self.look_ahead.views.limit(bytes);
    }

    /// Plans the coming steps in at least about `bytes` bytes also where no page leaves memory: a tier above asks for next uses.
    pub fn plan_for_tier_above(&mut self, bytes: usize) {
        if self.config.plan_bytes < bytes {
            self.limit_plan(bytes);
        }
    }

    /// Makes the page lists of some coming steps again, by the current bounds, for a tier above. Where pages leave
    /// memory, prefetch does so for the farther ones.
    pub fn refresh_plan(&mut self, step: u32) {
        if self.config.plan_bytes > 0 && self.frames_max() == usize::MAX {
            self.look_ahead.refresh(step, self.tier.index.metas());
        }
        self.look_ahead.refresh_near(step, self.tier.index.metas());
        self.look_ahead.apply_changed(&mut self.tier.frames);
    }

    /// The most bytes that [`Pager::prefetch`] has in flight, reads and writes together.
    pub fn prefetch_bytes(&self) -> usize {
        2 * self.tier.mover.ahead_max
    }

    /// Memory of buffers for encoded pages, bytes: the most that was ever in use at once. The limit is
    /// [`Pager::prefetch_bytes`], but a few pages are always allowed, and some more where nothing is read ahead.
    pub fn staging_bytes(&self) -> u64 {
        self.tier.mover.staging_bytes()
    }

    pub fn frame_bytes(&self) -> usize {
        self.tier.mover.frame_bytes
    }

    /// Layout of a full page.
    pub fn largest_page(&self) -> PageLayout {
        PageLayout { rows: self.config.page_rows, sh_degree: self.config.sh_degree }
    }

    /// The metas of all pages, by number.
    pub fn index(&self) -> &[PageMeta] {
        self.tier.index.metas()
    }

    /// Plans the coming views: `cameras[i]` at step `first_step + i`. Replaces the plan before; views that are planned already
    /// cost nothing.
    pub fn look_ahead(&mut self, first_step: u32, cameras: &[&Camera]) {
        if self.tier.mover.has_store() || self.config.plan_bytes > 0 {
            self.look_ahead.views.renew(first_step, cameras, self.tier.index.metas());
            self.look_ahead.apply_changed(&mut self.tier.frames);
        }
    }

    /// The next use of a page: in the present step if it walks its view in batches, else the first planned step.
    pub fn next_use(&self, page: PageNo) -> u32 {
        self.look_ahead.next_use(page)
    }

    /// Pins every page with rows that `camera` may see by the bounds as they are now, ascending by id: a view of one batch.
    /// `step` is the 0-based step that uses them. Blocks only for pages that are not in memory.
    /// Errors: the working set is larger than the frames; a page cannot be read; a page could not be written, now or
    /// since the last call. Nothing is pinned then, and every page keeps what it holds.
    pub fn acquire(&mut self, step: u32, camera: &Camera) -> Result<Vec<PinnedPage>, PagingError> {
        let pages = self.begin_view(step, camera)?;
        self.pin_batch(step, &pages, false)
    }

    /// Begins 0-based `step` on the view of `camera`; returns every page with rows that the camera may see by the bounds as
    /// they are now, ascending by id. [`Pager::pin_batch`] pins them.
    /// Errors: a page could not be written since the last call.
    pub fn begin_view(&mut self, step: u32, camera: &Camera) -> Result<Vec<PageNo>, PagingError> {
        self.tier.mover.writes_stopped = false;
        if let Some(error) = self.tier.mover.failed_write.take() {
            return Err(error);
        }
        let pages = self.pages_of_view(camera);
        let planned = self.look_ahead.views.pages(step).map(<[PageNo]>::to_vec);
        self.look_ahead.views.pass(step.saturating_add(1));
        self.look_ahead.views.add_pages(self.tier.index.metas());
        self.look_ahead.apply_changed(&mut self.tier.frames);
        self.tier.frames.begin_step(step);
        if let Some(planned) = planned {
            let missed = |p: &&PageNo| planned.binary_search(p).is_err() && !self.is_in_memory(**p);
            self.tier.counters.stats.late_misses += pages.iter().filter(missed).count() as u64;
        }
        Ok(pages)
    }

    /// The most pages of a view of `pages` pages that a step pins at once.
    pub fn pages_per_batch(&self, pages: usize) -> usize {
        pages_per_batch(pages, self.frames_max())
    }

    /// Pages with rows that `camera` may see by the bounds as they are now, ascending by id.
    pub fn pages_of_view(&self, camera: &Camera) -> Vec<PageNo> {
        let (mut pages, index) = (Vec::new(), &self.tier.index);
        visible_pages(index.metas(), camera, &mut pages);
        pages.retain(|&p| index.has_rows(p));
        pages.sort_unstable_by_key(|&p| index.meta(p).id);
        pages
    }

    pub fn rows_of(&self, pages: &[PageNo]) -> u64 {
        pages.iter().map(|&page| u64::from(self.tier.index.meta(page).rows)).sum()
    }

    /// Pins the next batch of a step's view, in this order, without pages that have no rows. `is_again`: the batch is pinned a second time, in
    /// the pass out. The step has changed rows then, so a failed write is left to the next step. Blocks only for pages that are not in memory.
    /// Errors: as [`Pager::acquire`]. Nothing of this batch is pinned then.
    pub fn pin_batch(&mut self, step: u32, pages: &[PageNo], is_again: bool) -> Result<Vec<PinnedPage>, PagingError> {
        let asker = if is_again { Asker::RestOfStep } else { Asker::Step };
        let what = format!("the view of step {step}");
        let pinned = Fetch::pin(&mut self.tier, &self.look_ahead, what, pages, asker);
        let pinned = pinned.map_err(|error| self.failed_write_or(error))?;
        if self.tier.mover.has_store() {
            let Tier { index, frames, counters, .. } = &mut self.tier;
            let pages = pinned.iter().map(|p| (p.page, index.transfer_bytes(p.page)));
            counters.bound.step(frames.frames_max(), pages);
        }
        Ok(pinned)
    }

    /// Pins the listed pages (none of them pinned already, none twice) in this order, leaving out those without rows:
    /// for evaluation and export. The pins do not count as uses. After failed writes the call still works, at least for one page
    /// at a time.
    /// Errors: as [`Pager::acquire`], but without earlier failures.
    pub fn acquire_pages(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        Fetch::pin(&mut self.tier, &self.look_ahead, "a list of pages".to_string(), pages, Asker::Other)
    }

    /// As [`Pager::acquire_pages`], for the rest of a step that has changed rows already: hits, reads and the time waited
    /// count as the step's.
    /// Errors: as [`Pager::acquire_pages`].
    pub fn acquire_in_step(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let pinned =
            Fetch::pin(&mut self.tier, &self.look_ahead, "a list of pages".to_string(), pages, Asker::RestOfStep);
        pinned.map_err(|error| self.failed_write_or(error))
    }

    /// The error of a step that could not pin its pages: the failed write that left no frame says more than the lack of frames.
    fn failed_write_or(&mut self, error: PagingError) -> PagingError {
        match error {
            PagingError::WorkingSet { .. } => self.tier.mover.failed_write.take().unwrap_or(error),
            error => error,
        }
    }

    /// Says how the present step, which walks its view in batches, still uses these pages.
    pub fn set_use_in_step(&mut self, step: u32, pages: impl IntoIterator<Item = PageNo>, how: UseInStep) {
        self.look_ahead.set_use_in_step(step, pages, how, &mut self.tier.frames);
    }

    /// The step has ended, well or not: it uses no page any more.
    pub fn end_batches(&mut self) {
        self.look_ahead.end_step(&mut self.tier.frames);
    }

    /// Makes sure that the drive has room for everything that may be written back before `pages` pages of the present step are
    /// updated: these pages, the dirty pages in memory, and the pages of a cut.
    /// Errors: the drive is full.
    pub fn reserve_slots(&mut self, pages: usize) -> Result<(), PagingError> {
        let Tier { frames, mover, .. } = &mut self.tier;
        let pages = (pages + frames.held().filter(|(_, held)| frames.is_dirty(held.page)).count()) as u64;
        let reserved = mover.store_mut().map_or(Ok(()), |store| store.reserve(pages));
        reserved.map_err(|source| PagingError::Room { pages, source })
    }

    /// Starts reads for the steps after `step`, and write-backs of the dirty pages that are evicted for these reads, as [`Transfers`] says.
    /// Call this when the pages of `step` are pinned. Further calls during the step start the transfers that have become possible since.
    pub fn prefetch(&mut self, step: u32) {
        if self.config.transfers != Transfers::Demand && self.tier.mover.has_store() {
            self.tier.poll(false);
            let transfers = self.config.transfers;
            self.prefetching().coming_steps(step, transfers);
        }
    }

    /// Begins to read the pages of the next batch of the present step, as far as frames and the limit on bytes in
    /// flight allow. Evicts no page that the step needs earlier. Never blocks. Further calls continue.
    pub fn prefetch_batch(&mut self, pages: &[PageNo]) {
        if self.config.transfers != Transfers::Demand && self.tier.mover.has_store() {
            self.prefetching().listed(pages, Asker::Step);
        }
    }

    /// As [`Pager::prefetch_batch`], between steps: of pages that are acquired next.
    pub fn prefetch_pages(&mut self, pages: impl Iterator<Item = PageNo>) {
        if self.config.transfers != Transfers::Demand && self.tier.mover.has_store() {
            let pages: Vec<PageNo> = pages.collect();
            // So that none of them is evicted for another one.
            self.set_use_in_step(0, pages.iter().copied(), UseInStep::Coming);
            self.prefetching().listed(&pages, Asker::Other);
            self.end_batches();
        }
    }

    fn prefetching(&mut self) -> Prefetch<'_> {
        Prefetch { tier: &mut self.tier, look_ahead: &mut self.look_ahead }
    }

    /// A frame for the upper half of a page that splits; its bytes are whatever was there before. Goes back by
    /// [`Pager::add_split`] or [`Pager::return_frame`]. If only drive space is missing, the call returns one frame more
    /// than allowed, so that a step which has begun to change pages can finish; the next step gets the error.
    /// Errors: every frame is pinned, or the store failed while one was emptied.
    pub fn take_frame(&mut self) -> Result<PageBuffer, PagingError> {
        let error = match self.tier.frame_for(Asker::Step) {
            Err(error) => error,
            frame => return frame,
        };
        let cause = self.tier.mover.failed_write.take().unwrap_or(error);
        if !cause.is_out_of_space() {
            return Err(cause);
        }
        self.tier.mover.keep_failure(cause);
        self.tier.frames.add_frame();
        self.tier.frame_for(Asker::Step)
    }

    /// Gives back a frame that was taken and is not needed.
    pub fn return_frame(&mut self, buffer: PageBuffer) {
        self.tier.frames.take_back(buffer);
    }

    /// Adds the upper half of a page that split: the half gets a number, is pinned and dirty. The lower half keeps the number of
    /// the page; [`Pager::release`] takes its new meta over.
    pub fn add_split(&mut self, meta: PageMeta, buffer: PageBuffer) -> PinnedPage {
        let page = self.tier.add_entry(meta);
        self.tier.frames.adopt(page);
        self.tier.counters.count_pinned(self.tier.frames.count(FrameState::Pinned));
        PinnedPage { page, meta, dirty: true, buffer }
    }

    /// Unpins pages: all that a step has pinned, or some of them. Metas and dirty flags are taken over. A page
    /// that has lost all rows gives up its frame and its slot.
    pub fn release(&mut self, pages: Vec<PinnedPage>) {
        for pinned in pages {
            self.note_meta(&pinned);
            let (PinnedPage { page, meta, dirty, buffer }, tier) = (pinned, &mut self.tier);
            if meta.rows > 0 {
                tier.frames.unpin(page, buffer, dirty);
                continue;
            }
            tier.frames.drop_pinned(page, buffer);
            if let Some(slot) = tier.index.set_slot(page, None) {
                tier.mover.free(&slot, None);
            }
        }
    }

    /// Takes over the entry of a page that stays pinned: its new bounds count from now on.
    pub fn note_meta(&mut self, pinned: &PinnedPage) {
        let PinnedPage { page, meta, dirty, .. } = *pinned;
        debug_assert!(meta == *self.tier.index.meta(page) || dirty, "a page whose entry changes is dirty");
        self.tier.index.set_meta(page, meta);
    }

    /// Sets how many pinned pages no batch uses: these do not count in the largest number of pinned pages.
    pub fn set_held(&mut self, pages: usize) {
        self.tier.counters.held = pages;
    }

    /// The counters, over all lives of the run.
    pub fn stats(&self) -> PagerStats {
        self.tier.counters.total(self.tier.mover.traffic())
    }

    pub fn frames(&self) -> usize {
        self.tier.frames.frames()
    }

    /// The limit on frames; `usize::MAX` for no limit.
    pub fn frames_max(&self) -> usize {
        self.tier.frames.frames_max()
    }

    /// Seconds that steps lost to commits beside them: they waited for frozen pages, or spent the time on writing them.
    pub fn commit_seconds(&self) -> f64 {
        self.tier.counters.commit_seconds
    }

    /// Pages that have a frame.
    pub fn pages_in_memory(&self) -> usize {
        (0..self.index().len()).filter(|&page| self.is_in_memory(PageNo(page as u32))).count()
    }

    /// Whether a page has a frame.
    pub fn is_in_memory(&self, page: PageNo) -> bool {
        self.tier.frames.state(page).is_some()
    }

    /// The payload in the frame of a page, without the header; `None` for a page that is not in memory, is pinned, or is
    /// moving.
    pub fn payload(&self, page: PageNo) -> Option<&[u8]> {
        self.tier.frames.memory(page).map(|buffer| &buffer.as_slice()[HEADER_BYTES..])
    }

    /// How full the store is; `None` for a pager without a store.
    pub fn slot_space(&self) -> Option<SlotSpace> {
        self.tier.mover.slot_space()
    }

    /// Writes every dirty page back and waits until nothing is in flight. To be called between steps, when no page is pinned. A cut
    /// that is not committed is given up.
    /// Errors: a page could not be written. It is still in memory, and the call may be repeated.
    pub fn flush(&mut self) -> Result<(), PagingError> {
        let tier = &mut self.tier;
        debug_assert_eq!(tier.frames.count(FrameState::Pinned), 0, "a step holds pages");
        tier.cuts.frozen = None;
        // Pages whose write failed are still dirty: they are written again here.
        tier.mover.failed_write = None;
        tier.mover.writes_stopped = false;
        tier.wait_until_below(1)?;
        let mut dirty: Vec<PageNo> =
            tier.frames.held().map(|(_, held)| held.page).filter(|&p| tier.frames.is_dirty(p)).collect();
        dirty.sort_unstable();
        let mut dirty = dirty.into_iter();
        tier.write_all(|_| dirty.next())
    }

    /// Commits the pages as they are, right after [`Pager::flush`], under the name `pin` if there is one; returns the
    /// generation, `None` for a pager without a store.
    /// Errors: as [`Commits::commit`].
    pub fn commit(
        &mut self,
        commits: &mut Commits,
        run_state: &[u8],
        note: &[u8],
        pin: Option<&str>,
    ) -> Result<Option<u64>, CommitError> {
        let Tier { index, mover, cuts, .. } = &mut self.tier;
        debug_assert!(mover.in_flight() == 0, "a commit comes after a flush");
        let Some(store) = mover.store_mut() else { return Ok(None) };
        let (changes, now) = cuts.changes(index)?;
        let cut = Cut { changes: &changes, run_state, note, pin };
        let result = commits.commit(store, &mut Vec::new(), &cut);
        cuts.end_commit(now, result).map(Some)
    }

    /// Freezes the pages as they are. To be called between steps, when no page is pinned. An earlier cut that was not committed is
    /// given up. Without a store nothing is frozen.
    /// Errors: a write that ended meanwhile had failed.
    pub fn freeze(&mut self) -> Result<(), PagingError> {
        debug_assert_eq!(self.tier.frames.count(FrameState::Pinned), 0, "a step holds pages");
        self.abort_cut();
        self.tier.collect_writes(None)?;
        let Tier { index, frames, mover, cuts, .. } = &mut self.tier;
        let Some(store) = mover.store_mut() else { return Ok(()) };
        cuts.freeze(store.cut(), index, frames);
        Ok(())
    }

    /// Gives up a cut that is not committed.
    pub fn abort_cut(&mut self) {
        self.tier.cuts.frozen = None;
    }

    /// Whether there is a cut that is not committed yet; a failed write has given it up.
    pub fn is_frozen(&self) -> bool {
        self.tier.cuts.frozen.is_some()
    }

    /// Whether every page of the cut is written.
    pub fn is_frozen_written(&self) -> bool {
        self.tier.cuts.is_written()
    }

    /// Writes what is left of the cut, and waits until nothing is in flight.
    /// Errors: a page could not be written: the cut is given up.
    pub fn finish_frozen(&mut self) -> Result<(), PagingError> {
        self.tier.write_all(|tier| tier.cuts.next_waiting())
    }

    /// Commits the cut, right after [`Pager::finish_frozen`]; returns its generation and the bytes that were written for
    /// it, `None` where nothing is frozen.
    /// Errors: as [`Commits::commit`]: the cut is given up.
    pub fn commit_frozen(
        &mut self,
        commits: &mut Commits,
        run_state: &[u8],
        note: &[u8],
    ) -> Result<Option<(u64, u64)>, CommitError> {
        let Tier { mover, cuts, .. } = &mut self.tier;
        debug_assert!(mover.in_flight() == 0, "a commit comes after its writes");
        let Some(frozen) = cuts.frozen.take() else { return Ok(None) };
        let Frozen { generation, mut changes, now, bytes, nowhere: lost, .. } = frozen;
        if let Some(page) = lost {
            return Err(nowhere(page));
        }
        changes.extend(cuts.removed_since(&now));
        let Some(store) = mover.store_mut() else { return Ok(None) };
        let cut = Cut { changes: &changes, run_state, note, pin: None };
        let result = commits.commit_cut(store, &mut Vec::new(), generation, &cut);
        cuts.end_commit(now, result).map(|generation| Some((generation, bytes)))
    }
}
