//! The pager hands out the pages of a view and takes them back.
//!
//! The pager composes parts that know nothing of each other: `index` (entries and slots of the pages), `frames` (which
//! pages are in memory), `plan` (what the coming steps need), `mover` (transfers), `cut` (commits). Calls that need several
//! parts stand in files of their own: `fetch` reads the pages of the current step, `prefetch` those of coming steps,
//! `batches` walks a view that is larger than the frames, `transfers` begins and ends reads and write-backs, `commit` makes
//! the pages durable.
//!
//! Invariants: 1. `acquire` gives every page that the view may see by the bounds as they are now, whatever was planned;
//! 2. a page's buffer is in one place: in its frame, with the mover, or with the caller who pinned it; 3. what a step
//! reads and writes never depends on frames, plan or store; 4. a page with rows that is not in memory has a slot, and the
//! slot holds exactly what was last released.

use super::cut::Cuts;
use super::error::PagingError;
use super::frames::evict::EvictPolicy;
use super::frames::frame::FrameState;
use super::frames::table::FrameTable;
use super::index::PageIndex;
use super::mover::Mover;
use super::pinned::PinnedPage;
use super::plan::look_ahead::LookAhead;
use super::stats::{Counters, PagerStats, SlotSpace};
use super::timing::{Asker, Transfers};
use crate::base::ids::PageNo;
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::{HEADER_BYTES, transfer_bytes};
use crate::page::versions::paged_store::PagedStore;
use crate::scene::camera::Camera;
use crate::scene::page_layout::capacity_bytes;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::collections::BTreeMap;

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
}

impl PagerConfig {
    /// Everything in memory, for pages of `page_rows` rows.
    pub fn in_memory(page_rows: usize, sh_degree: u8) -> PagerConfig {
        let policy = EvictPolicy::default();
        PagerConfig { page_rows, sh_degree, frames: usize::MAX, policy, prefetch_bytes: 0, plan_bytes: 0 }
    }

    /// Bytes of one frame: header space and the payload of a full page, as a slot has them.
    pub fn frame_bytes(&self) -> usize {
        transfer_bytes(capacity_bytes(self.page_rows, self.sh_degree))
    }
}

/// The pages of a scene: the parts that hold, move and plan them.
#[derive(Debug)]
pub struct Pager {
    pub(super) config: PagerConfig,
    pub(super) index: PageIndex,
    pub(super) frames: FrameTable<PageBuffer>,
    pub(super) look_ahead: LookAhead,
    pub(super) mover: Mover,
    pub(super) cuts: Cuts,
    pub(super) counters: Counters,
    pub(super) transfers: Transfers,
    /// Next uses of the pages that the present step still needs, where it walks its view in batches.
    pub(super) uses_in_step: BTreeMap<PageNo, u32>,
    /// Pinned pages that no batch uses: a tier above has newer bytes of them.
    pub(super) held: usize,
}

impl Pager {
    /// A pager with `config.frames` frames over a store whose slots are as large as the frames.
    pub fn new(config: PagerConfig, store: PagedStore) -> Pager {
        let mut pager = Pager::in_memory(config);
        pager.mover.attach(store);
        pager
    }

    /// A pager that keeps every page in memory, in as many frames as needed.
    pub fn in_memory(config: PagerConfig) -> Pager {
        Pager {
            index: PageIndex::default(),
            frames: FrameTable::new(config.frames, config.policy),
            look_ahead: LookAhead::new(config.policy, config.plan_bytes),
            mover: Mover::new(config.frame_bytes(), config.prefetch_bytes),
            cuts: Cuts::default(),
            counters: Counters::default(),
            transfers: Transfers::default(),
            uses_in_step: BTreeMap::new(),
            held: 0,
            config,
        }
    }

    /// Gives a pager whose pages never left memory a store of its frames' size, which is empty: from here on the pager can be
    /// committed. Nothing is written before that.
    pub fn attach(&mut self, store: PagedStore) {
        self.mover.attach(store);
        // These pages are in memory: no cache would have had to read them.
        (0..self.index.metas().len()).for_each(|page| self.counters.bound.add(PageNo(page as u32)));
    }

    /// Continues the counters of an earlier life of the run.
    pub fn restore_stats(&mut self, past: PagerStats) {
        self.counters.stats = past;
    }

    /// Adds an initial page. `fill` writes its rows into the payload space (all of it is given; see
    /// [`crate::scene::page_layout::write_page`]), in the layout that `meta` names.
    ///
    /// # Errors
    /// The store failed while a frame was emptied.
    pub fn insert(&mut self, meta: PageMeta, fill: impl FnOnce(&mut [u8])) -> Result<PageNo, PagingError> {
        if meta.rows == 0 {
            return Ok(self.add_entry(meta));
        }
        self.write_behind()?;
        let mut buffer = self.frame_for(Asker::Other)?;
        fill(&mut buffer.as_mut_slice()[HEADER_BYTES..]);
        let page = self.add_entry(meta);
        self.frames.adopt(page);
        self.frames.unpin(page, buffer, true);
        Ok(page)
    }

    /// Raises the number of frames, once the memory that is left for them is known.
    pub fn allow_frames(&mut self, frames: usize) {
        self.frames.allow_frames(frames);
        self.config.frames = self.frames.frames_max();
    }

    /// Lowers the number of frames to `frames`. To be called between steps: pages are evicted, and dirty pages written back,
    /// until no frame is in excess; the time counts as waited. If a page cannot be written, the next step gets the error, and the
    /// frame is given up once the page is written.
    pub fn limit_frames(&mut self, frames: usize) {
        self.frames.limit_frames(frames);
        self.config.frames = self.frames.frames_max();
        while self.frames.excess() > 0 {
            match self.make_room(0, Asker::Step) {
                Ok(true) => {}
                Ok(false) if self.mover.in_flight() == 0 => return,
                Ok(false) => self.poll_completions(true),
                Err(error) => {
                    self.mover.keep_failure(error);
                    return;
                }
            }
        }
    }

    /// Begins to move pages between memory and the store: for a pager whose pages were all in memory, and whose store holds all
    /// of them. The sizes are those of [`PagerConfig`].
    pub fn begin_paging(&mut self, frames: usize, prefetch_bytes: usize, plan_bytes: usize) {
        assert!(self.mover.has_store(), "pages that leave memory have a store to go to");
        self.config = PagerConfig { prefetch_bytes, plan_bytes, ..self.config };
        self.mover.set_ahead_max(prefetch_bytes);
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

    /// Lists the pages of some coming steps anew, by the bounds as they are now, for a tier above. Where pages leave memory, prefetch does
    /// it.
    pub fn refresh_plan(&mut self, step: u32) {
        if self.config.plan_bytes > 0 && self.frames.frames_max() == usize::MAX {
            self.look_ahead.refresh(step, self.index.metas());
        }
        self.look_ahead.refresh_near(step, self.index.metas());
        self.apply_changed_uses();
    }

    /// Sets when pages move.
    pub fn set_transfers(&mut self, transfers: Transfers) {
        self.transfers = transfers;
    }

    /// The most bytes that [`Pager::prefetch`] has in flight, reads and writes together.
    pub fn prefetch_bytes(&self) -> usize {
        2 * self.config.prefetch_bytes
    }

    /// Memory of buffers for encoded pages, bytes: the most that was ever in use at once. The limit is
    /// [`Pager::prefetch_bytes`], but a few pages are always allowed, and some more where nothing is read ahead.
    pub fn staging_bytes(&self) -> u64 {
        self.mover.staging_bytes()
    }

    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> usize {
        self.config.frame_bytes()
    }

    /// The metas of all pages, by number.
    pub fn index(&self) -> &[PageMeta] {
        self.index.metas()
    }

    /// Plans the coming views: `cameras[i]` at step `first_step + i`. Replaces the plan before; views that are planned already
    /// cost nothing.
    pub fn look_ahead(&mut self, first_step: u32, cameras: &[&Camera]) {
        if self.mover.has_store() || self.config.plan_bytes > 0 {
            self.look_ahead.views.renew(first_step, cameras, self.index.metas());
            self.apply_changed_uses();
        }
    }

    /// Pins every page with rows that `camera` may see by the bounds as they are now, ascending by id: a view of one batch.
    /// `step` is the 0-based step that uses them. Blocks only for pages that are not in memory.
    ///
    /// # Errors
    /// The working set is larger than the frames; a page cannot be read; a page could not be written, now or since the
    /// last call. Nothing is pinned then, and every page keeps what it holds.
    pub fn acquire(&mut self, step: u32, camera: &Camera) -> Result<Vec<PinnedPage>, PagingError> {
        let pages = self.begin_view(step, camera)?;
        self.pin_batch(step, &pages)
    }

    /// Begins 0-based `step` on the view of `camera`; returns every page with rows that the camera may see by the bounds as
    /// they are now, ascending by id. [`Pager::pin_batch`] pins them.
    ///
    /// # Errors
    /// A page could not be written since the last call.
    pub fn begin_view(&mut self, step: u32, camera: &Camera) -> Result<Vec<PageNo>, PagingError> {
        self.mover.resume_writes();
        if let Some(error) = self.mover.take_failure() {
            return Err(error);
        }
        let pages = self.pages_of_view(camera);
        let planned = self.look_ahead.views.pages(step).map(<[PageNo]>::to_vec);
        self.look_ahead.views.pass(step.saturating_add(1));
        self.look_ahead.views.add_pages(self.index.metas());
        self.apply_changed_uses();
        self.frames.begin_step(step);
        if let Some(planned) = planned {
            let missed = |p: &&PageNo| planned.binary_search(p).is_err() && self.frames.state(**p).is_none();
            self.counters.stats.late_misses += pages.iter().filter(missed).count() as u64;
        }
        Ok(pages)
    }

    /// Adds a batch of a step to the bound on reads.
    pub(super) fn count_bound(&mut self, pages: &[PageNo]) {
        if !self.mover.has_store() {
            return;
        }
        let (index, frames) = (&self.index, self.frames.frames_max());
        self.counters.bound.step(frames, pages.iter().map(|&page| (page, index.transfer_bytes(page))));
    }

    /// Pages with rows that `camera` may see by the bounds as they are now, ascending by id.
    pub fn pages_of_view(&self, camera: &Camera) -> Vec<PageNo> {
        let mut pages = Vec::new();
        visible_pages(self.index.metas(), camera, &mut pages);
        pages.retain(|&p| self.index.has_rows(p));
        pages.sort_unstable_by_key(|&p| self.index.meta(p).id);
        pages
    }

    /// Pins the listed pages (none of them pinned already, none twice) in this order, leaving out those without rows:
    /// for evaluation and export. The pins do not count as uses. After failed writes the call still works, at least for one page
    /// at a time.
    ///
    /// # Errors
    /// As [`Pager::acquire`], but without earlier failures.
    pub fn acquire_pages(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|&p| self.index.has_rows(p)).collect();
        self.fetch("a list of pages", &pages, Asker::Other)
    }

    /// As [`Pager::acquire_pages`], for the rest of a step that has changed rows already: hits, reads and the time waited
    /// count as the step's.
    ///
    /// # Errors
    /// As [`Pager::acquire_pages`].
    pub fn acquire_in_step(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|&p| self.index.has_rows(p)).collect();
        self.fetch("a list of pages", &pages, Asker::RestOfStep)
    }

    /// Gives back a frame that was taken and is not needed.
    pub fn return_frame(&mut self, buffer: PageBuffer) {
        self.frames.take_back(buffer);
    }

    /// Adds the upper half of a page that split: the half gets a number, is pinned and dirty. The lower half keeps the number of
    /// the page; [`Pager::release`] takes its new meta over.
    pub fn add_split(&mut self, meta: PageMeta, buffer: PageBuffer) -> PinnedPage {
        let page = self.add_entry(meta);
        self.frames.adopt(page);
        self.count_pinned();
        PinnedPage { page, meta, dirty: true, buffer }
    }

    /// Unpins pages: all that a step has pinned, or some of them. Metas and dirty flags are taken over. A page
    /// that has lost all rows gives up its frame and its slot.
    pub fn release(&mut self, pages: Vec<PinnedPage>) {
        for PinnedPage { page, meta, dirty, buffer } in pages {
            debug_assert!(meta == *self.index.meta(page) || dirty, "a page whose entry changes is dirty");
            self.index.set_meta(page, meta);
            if meta.rows > 0 {
                self.frames.unpin(page, buffer, dirty);
            } else {
                self.frames.drop_pinned(page, buffer);
                self.free_slot(page);
            }
        }
    }

    /// Takes over the entry of a page that stays pinned: its new bounds count from now on.
    pub fn note_meta(&mut self, pinned: &PinnedPage) {
        debug_assert!(
            pinned.dirty || pinned.meta == *self.index.meta(pinned.page),
            "a page whose entry changes is dirty"
        );
        self.index.set_meta(pinned.page, pinned.meta);
    }

    /// Says how many pinned pages no batch uses: the largest number of pinned pages is counted without them.
    pub fn set_held(&mut self, pages: usize) {
        self.held = pages;
    }

    /// The counters, over all lives of the run.
    pub fn stats(&self) -> PagerStats {
        self.counters.total(self.mover.traffic())
    }

    /// Frames in use.
    pub fn frames(&self) -> usize {
        self.frames.frames()
    }

    /// The limit on frames; `usize::MAX` for no limit.
    pub fn frames_max(&self) -> usize {
        self.frames.frames_max()
    }

    /// Seconds that steps lost to commits beside them: they waited for frozen pages, or spent the time on writing them.
    pub fn commit_seconds(&self) -> f64 {
        self.counters.commit_seconds
    }

    /// Whether a page has a frame.
    pub fn is_in_memory(&self, page: PageNo) -> bool {
        self.frames.state(page).is_some()
    }

    /// The payload in the frame of a page, without the header; `None` for a page that is not in memory, is pinned, or is
    /// moving.
    pub fn payload(&self, page: PageNo) -> Option<&[u8]> {
        self.frames.memory(page).map(|buffer| &buffer.as_slice()[HEADER_BYTES..])
    }

    /// How full the store is; `None` for a pager without a store.
    pub fn slot_space(&self) -> Option<SlotSpace> {
        self.mover.slot_space()
    }

    fn add_entry(&mut self, meta: PageMeta) -> PageNo {
        let page = self.index.push(meta, None);
        if self.mover.has_store() {
            self.counters.bound.add(page);
        }
        page
    }

    pub(super) fn count_pinned(&mut self) {
        let pinned = self.frames.count(FrameState::Pinned).saturating_sub(self.held);
        self.counters.stats.pinned_max = self.counters.stats.pinned_max.max(pinned);
    }

    /// The next use of a page: in the present step if it walks its view in batches, else the first planned step.
    pub fn next_use(&self, page: PageNo) -> u32 {
        self.uses_in_step.get(&page).copied().unwrap_or_else(|| self.look_ahead.views.next_use(page))
    }

    /// Tells the frame table of next uses that changed.
    pub(super) fn apply_changed_uses(&mut self) {
        for page in self.look_ahead.views.take_changed() {
            self.frames.set_next_use(page, self.next_use(page));
        }
    }
}
