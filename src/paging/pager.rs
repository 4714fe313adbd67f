//! Hands out the pages of a view and takes them back.
//!
//! Here are the pages' entries and the calls of the trainer; `fetch` brings what is missing, `ahead` what will be
//! missing, `transfers` talks to the store, `commit` makes what it holds last.
//!
//! Invariants: 1. `acquire` gives every page that the view may see by the bounds as they are now, whatever was planned;
//! 2. a page's buffer is in one place: with the cache, with the store, or with the caller who pinned it; 3. what a step
//! reads and writes never depends on frames, plan or store; 4. a page with rows that is not in memory has a slot, and the
//! slot holds exactly what was last released.

use super::error::PagingError;
use super::fetch::Asker;
use super::freeze::Frozen;
use super::pinned::PinnedPage;
use super::prefetch::Transfers;
use super::stats::{PagerStats, SlotSpace};
use crate::base::ids::{PageId, PageNo};
use crate::page::engine::buffer::PageBuffer;
use crate::page::format::slot_header::{HEADER_BYTES, SlotRef, transfer_bytes};
use crate::page::versions::paged_store::PagedStore;
use crate::paging::frames::evict::EvictPolicy;
use crate::paging::frames::frame::FrameState;
use crate::paging::frames::table::FrameTable;
use crate::paging::plan::bound::FewestReads;
use crate::paging::plan::look_ahead::LookAhead;
use crate::scene::camera::Camera;
use crate::scene::page_layout::{PageLayout, capacity_bytes};
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::collections::{BTreeMap, BTreeSet};

/// Sizes of a pager. None of them changes a bit of the rows.
#[derive(Debug, Clone, Copy)]
pub struct PagerConfig {
    /// Rows that a page holds at most.
    pub page_rows: usize,
    /// Degree of the scene: frames hold a full page of it.
    pub sh_degree: u8,
    /// Pages that memory holds at once; `usize::MAX` for as many as there are.
    pub frames: usize,
    /// Which page leaves first.
    pub policy: EvictPolicy,
    /// Bytes that [`Pager::prefetch`] has in flight at most, reads and writes each.
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

/// The pages of a scene.
#[derive(Debug)]
pub struct Pager {
    pub(super) config: PagerConfig,
    /// By page.
    pub(super) index: Vec<PageMeta>,
    /// By page: where its version on the drive is, current or not; `None` before its first write.
    pub(super) slots: Vec<Option<SlotRef>>,
    pub(super) frames: FrameTable<PageBuffer>,
    pub(super) look_ahead: LookAhead,
    /// `None` for a pager whose pages never leave memory.
    pub(super) store: Option<PagedStore>,
    /// Without what store and bound count themselves.
    pub(super) stats: PagerStats,
    pub(super) commit_seconds: f64,
    /// A write that failed while nobody waited for it.
    pub(super) failed_write: Option<PagingError>,
    /// After a failed write nothing is written until a step asks for pages again.
    pub(super) writes_stopped: bool,
    /// Reads and writes that were started ahead of their need and are still in flight, bytes.
    pub(super) ahead: [usize; 2],
    pub(super) transfers: Transfers,
    /// Pages of the last acknowledged commit, with the generations of their versions.
    pub(super) committed: BTreeMap<PageId, u64>,
    /// Pages of commits since then that were not acknowledged. One that found no space may have been durable all the
    /// same, and the next one goes on from it: of these, those that are gone by then must be taken away as well.
    pub(super) unsure: BTreeSet<PageId>,
    /// A cut that is being written.
    pub(super) frozen: Option<Frozen>,
    /// What the steps so far would have made the best of caches read.
    bound: FewestReads,
}

impl Pager {
    /// A pager with `config.frames` frames over a store whose slots are as large as the frames.
    pub fn new(config: PagerConfig, store: PagedStore) -> Pager {
        Pager { store: Some(store), ..Pager::in_memory(config) }
    }

    /// A pager that keeps every page in memory, in as many frames as needed.
    pub fn in_memory(config: PagerConfig) -> Pager {
        Pager {
            frames: FrameTable::new(config.frames, config.policy),
            look_ahead: LookAhead::new(config.policy, config.plan_bytes),
            config,
            index: Vec::new(),
            slots: Vec::new(),
            store: None,
            stats: PagerStats::default(),
            commit_seconds: 0.0,
            failed_write: None,
            writes_stopped: false,
            ahead: [0; 2],
            transfers: Transfers::default(),
            committed: BTreeMap::new(),
            unsure: BTreeSet::new(),
            frozen: None,
            bound: FewestReads::default(),
        }
    }

    /// Gives a pager whose pages never left memory a store of its frames' size, which is empty: from here on it can be
    /// committed. Nothing is written before that.
    pub fn attach(&mut self, store: PagedStore) {
        assert!(self.store.is_none(), "a pager has one store for life");
        self.store = Some(store);
        // They are there: no cache would have had to read them.
        (0..self.index.len()).for_each(|page| self.bound.add(PageNo(page as u32)));
    }

    /// Continues the counters of an earlier life of the run.
    pub fn restore_stats(&mut self, past: PagerStats) {
        self.stats = past;
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

    /// Allows more frames than the pager was made with, once it is known what memory is left for them.
    pub fn allow_frames(&mut self, frames: usize) {
        self.frames.allow_frames(frames);
        self.config.frames = self.frames.frames_max();
    }

    /// Allows no more than so many frames from now on. Between steps: pages leave until there are no more, and dirty ones
    /// are written for it; the time counts as waited for. If one could not be written the next step gets the error, and
    /// its frame goes when it is.
    pub fn limit_frames(&mut self, frames: usize) {
        self.frames.limit_frames(frames);
        self.config.frames = self.frames.frames_max();
        while self.frames.excess() > 0 {
            match self.make_room(0, Asker::Step) {
                Ok(true) => {}
                Ok(false) if self.in_flight() == 0 => return,
                Ok(false) => self.settle_for_nobody(true),
                Err(error) => {
                    self.failed_write.get_or_insert(error);
                    return;
                }
            }
        }
    }

    /// A pager whose pages were all in memory, and whose store holds all of them, keeps no more than so many frames from now
    /// on. The sizes are those of [`PagerConfig`].
    pub fn begin_paging(&mut self, frames: usize, prefetch_bytes: usize, plan_bytes: usize) {
        assert!(self.store.is_some(), "pages that leave memory have a store to go to");
        self.config = PagerConfig { prefetch_bytes, plan_bytes, ..self.config };
        self.look_ahead = LookAhead::new(self.config.policy, plan_bytes);
        self.limit_frames(frames);
    }

    /// Moves pages at these times from now on.
    pub fn set_transfers(&mut self, transfers: Transfers) {
        self.transfers = transfers;
    }

    /// Bytes that [`Pager::prefetch`] has in flight at most.
    pub fn prefetch_bytes(&self) -> usize {
        2 * self.config.prefetch_bytes
    }

    /// Memory of buffers for encoded pages, bytes: as much as was ever in use at once. At most [`Pager::prefetch_bytes`],
    /// but a few pages in any case, and some more where nothing is ever ahead.
    pub fn staging_bytes(&self) -> u64 {
        self.store.as_ref().map_or(0, PagedStore::staging_bytes)
    }

    /// Bytes of one frame.
    pub fn frame_bytes(&self) -> usize {
        self.config.frame_bytes()
    }

    /// The metas of all pages, by number.
    pub fn index(&self) -> &[PageMeta] {
        &self.index
    }

    /// Says which views come next: `cameras[i]` at step `first_step + i`. Replaces what was said before; what is known
    /// already for the same views costs nothing.
    pub fn look_ahead(&mut self, first_step: u32, cameras: &[&Camera]) {
        if self.store.is_some() {
            self.look_ahead.views.renew(first_step, cameras, &self.index);
            self.apply_changed_uses();
        }
    }

    /// Pins every page with rows that `camera` may see by the bounds as they are now, ascending by id. `step` is the
    /// 0-based step that uses them. Blocks only for pages that are not in memory.
    ///
    /// # Errors
    /// The working set is larger than the frames; a page cannot be read; a page could not be written, now or since the
    /// last call. Nothing is pinned then, and every page keeps what it holds.
    pub fn acquire(&mut self, step: u32, camera: &Camera) -> Result<Vec<PinnedPage>, PagingError> {
        self.writes_stopped = false;
        if let Some(error) = self.failed_write.take() {
            return Err(error);
        }
        let pages = self.pages_of_view(camera);
        let planned = self.look_ahead.views.pages(step).map(<[PageNo]>::to_vec);
        self.look_ahead.views.pass(step.saturating_add(1));
        self.look_ahead.views.add_pages(&self.index);
        self.apply_changed_uses();
        self.frames.begin_step(step);
        if let Some(planned) = planned {
            let missed = |p: &&PageNo| planned.binary_search(p).is_err() && self.frames.state(**p).is_none();
            self.stats.late_misses += pages.iter().filter(missed).count() as u64;
        }
        let pinned = self.fetch(&format!("the view of step {step}"), &pages, Asker::Step)?;
        self.count_bound(&pages);
        Ok(pinned)
    }

    /// Takes a step over into what the best of caches would have read.
    fn count_bound(&mut self, pages: &[PageNo]) {
        if self.store.is_none() {
            return;
        }
        let bytes = |page: PageNo| {
            let PageMeta { rows, sh_degree, .. } = self.index[page.index()];
            let raw = || transfer_bytes(PageLayout { rows: rows as usize, sh_degree }.bytes());
            self.slots[page.index()].map_or_else(raw, |slot| slot.transfer_bytes()) as u64
        };
        self.bound.step(self.frames.frames_max(), pages.iter().map(|&page| (page, bytes(page))));
    }

    /// Pages with rows that `camera` may see by the bounds as they are now, ascending by id.
    pub fn pages_of_view(&self, camera: &Camera) -> Vec<PageNo> {
        let mut pages = Vec::new();
        visible_pages(&self.index, camera, &mut pages);
        pages.retain(|p| self.index[p.index()].rows > 0);
        pages.sort_unstable_by_key(|p| self.index[p.index()].id);
        pages
    }

    /// Pins the listed pages (none of them pinned already, none twice) in this order, leaving out those without rows:
    /// for evaluation and export. They do not count as used. Works also after writes failed, at least one page at a
    /// time.
    ///
    /// # Errors
    /// As [`Pager::acquire`], but without earlier failures.
    pub fn acquire_pages(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|p| self.index[p.index()].rows > 0).collect();
        self.fetch("a list of pages", &pages, Asker::Other)
    }

    /// As [`Pager::acquire_pages`], for the rest of a step that has changed rows already: hits, reads and the time waited
    /// count as the step's.
    ///
    /// # Errors
    /// As [`Pager::acquire_pages`].
    pub fn acquire_in_step(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let pages: Vec<PageNo> = pages.iter().copied().filter(|p| self.index[p.index()].rows > 0).collect();
        self.fetch("a list of pages", &pages, Asker::RestOfStep)
    }

    /// Gives back a frame that was taken for nothing.
    pub fn return_frame(&mut self, buffer: PageBuffer) {
        self.frames.take_back(buffer);
    }

    /// Adds the upper half of a page that split: it gets a number, is pinned and dirty. The lower half keeps the number of
    /// the page; its new meta goes in by [`Pager::release`].
    pub fn add_split(&mut self, meta: PageMeta, buffer: PageBuffer) -> PinnedPage {
        let page = self.add_entry(meta);
        self.frames.adopt(page);
        self.count_pinned();
        PinnedPage { page, meta, dirty: true, buffer }
    }

    /// Takes pages back: all that a step has pinned, or some of them. Metas and dirty flags go into the index. A page
    /// that has no rows any more gives up its frame and its slot.
    pub fn release(&mut self, pages: Vec<PinnedPage>) {
        for PinnedPage { page, meta, dirty, buffer } in pages {
            debug_assert!(meta == self.index[page.index()] || dirty, "a page whose entry changes is dirty");
            self.index[page.index()] = meta;
            if meta.rows > 0 {
                self.frames.unpin(page, buffer, dirty);
            } else {
                self.frames.drop_pinned(page, buffer);
                self.free_slot(page);
            }
        }
    }

    /// The counters, over all lives of the run.
    pub fn stats(&self) -> PagerStats {
        let traffic = self.store.as_ref().map(PagedStore::traffic).unwrap_or_default();
        PagerStats {
            bytes_read: self.stats.bytes_read + traffic.bytes_read,
            bytes_written: self.stats.bytes_written + traffic.bytes_written,
            belady_bytes_read: self.stats.belady_bytes_read + self.bound.bytes(),
            ..self.stats
        }
    }

    /// Frames in use.
    pub fn frames(&self) -> usize {
        self.frames.frames()
    }

    /// The most frames that there may be; `usize::MAX` for as many as needed.
    pub fn frames_max(&self) -> usize {
        self.frames.frames_max()
    }

    /// Seconds that steps lost to commits beside them: they waited for frozen pages, or spent the time on writing them.
    pub fn commit_seconds(&self) -> f64 {
        self.commit_seconds
    }

    /// Whether a page has a frame.
    pub fn is_in_memory(&self, page: PageNo) -> bool {
        self.frames.state(page).is_some()
    }

    /// Where the versions of the pages on the drive are, by page: for the index of a commit, once nothing is dirty.
    pub fn slots(&self) -> &[Option<SlotRef>] {
        &self.slots
    }

    /// What the slots of the store are, and the bytes of a segment; `None` for a pager without a store.
    pub fn slot_space(&self) -> Option<SlotSpace> {
        let slots = self.store.as_ref()?.slots();
        let segment_bytes = slots.layout().segment_bytes();
        Some(SlotSpace { total: slots.total(), free: slots.free(), retired: slots.retired(), segment_bytes })
    }

    fn add_entry(&mut self, meta: PageMeta) -> PageNo {
        self.index.push(meta);
        self.slots.push(None);
        let page = PageNo(self.index.len() as u32 - 1);
        if self.store.is_some() {
            self.bound.add(page);
        }
        page
    }

    pub(super) fn count_pinned(&mut self) {
        self.stats.pinned_max = self.stats.pinned_max.max(self.frames.count(FrameState::Pinned));
    }

    /// Tells the cache of next uses that changed.
    pub(super) fn apply_changed_uses(&mut self) {
        for page in self.look_ahead.views.take_changed() {
            self.frames.set_next_use(page, self.look_ahead.views.next_use(page));
        }
    }
}
