//! Hands out the pages of a view and takes them back.
//!
//! Invariants: 1. `acquire` gives every page that the view may see by the bounds as they are now, whatever was planned;
//! 2. a page's buffer is in one place: with the pager or with the caller who pinned it; 3. what a step reads and writes
//! never depends on the number of frames.

use super::error::PagingError;
use super::pinned::{HEADER_BYTES, PinnedPage};
use super::stats::PagerStats;
use super::visible::visible_pages;
use crate::base::ids::PageNo;
use crate::page::buffer::PageBuffer;
use crate::scene::camera::Camera;
use crate::scene::page_layout::capacity_bytes;
use crate::scene::page_meta::PageMeta;

/// Sizes of a pager.
#[derive(Debug, Clone, Copy)]
pub struct PagerConfig {
    /// Rows that a page holds at most.
    pub page_rows: usize,
    /// Degree of the scene: frames hold a full page of it.
    pub sh_degree: u8,
}

impl PagerConfig {
    /// Bytes of one frame: header space and the payload of a full page.
    pub fn frame_bytes(&self) -> usize {
        HEADER_BYTES + capacity_bytes(self.page_rows, self.sh_degree)
    }
}

/// The pages of a scene.
pub struct Pager {
    config: PagerConfig,
    index: Vec<PageMeta>,
    frames: Vec<Option<PageBuffer>>,
    pinned: usize,
    stats: PagerStats,
}

impl Pager {
    /// A pager that keeps every page in memory, in as many frames as needed.
    pub fn in_memory(config: PagerConfig) -> Pager {
        Pager { config, index: Vec::new(), frames: Vec::new(), pinned: 0, stats: PagerStats::default() }
    }

    /// Adds an initial page. `fill` writes its rows into the payload space (all of it is given; see
    /// [`crate::scene::page_layout::write_page`]), in the layout that `meta` names.
    ///
    /// # Errors
    /// The page does not fit, or a frame could not be had.
    pub fn insert(&mut self, meta: PageMeta, fill: impl FnOnce(&mut [u8])) -> Result<PageNo, PagingError> {
        let mut buffer = self.take_frame()?;
        fill(&mut buffer.as_mut_slice()[HEADER_BYTES..]);
        self.index.push(meta);
        self.frames.push(Some(buffer));
        Ok(PageNo(self.index.len() as u32 - 1))
    }

    /// The metas of all pages, by number.
    pub fn index(&self) -> &[PageMeta] {
        &self.index
    }

    /// Says which views come next: `cameras[i]` at step `first_step + i`. Replaces what was said before.
    pub fn look_ahead(&mut self, _first_step: u32, _cameras: &[&Camera]) {}

    /// Pins every page with rows that `camera` may see by the bounds as they are now, ascending by id. `step` is the
    /// 0-based step that uses them.
    ///
    /// # Errors
    /// The working set is larger than the frames, or the store failed.
    pub fn acquire(&mut self, _step: u32, camera: &Camera) -> Result<Vec<PinnedPage>, PagingError> {
        let pages = self.pages_of_view(camera);
        self.acquire_pages(&pages)
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
    /// for evaluation and export.
    ///
    /// # Errors
    /// As [`Pager::acquire`].
    pub fn acquire_pages(&mut self, pages: &[PageNo]) -> Result<Vec<PinnedPage>, PagingError> {
        let mut pinned = Vec::with_capacity(pages.len());
        for &page in pages {
            let meta = self.index[page.index()];
            if meta.rows > 0
                && let Some(buffer) = self.frames[page.index()].take()
            {
                pinned.push(PinnedPage { page, meta, dirty: false, buffer });
            }
        }
        self.stats.pages_needed += pinned.len() as u64;
        self.stats.hits += pinned.len() as u64;
        self.pinned += pinned.len();
        self.stats.pinned_max = self.stats.pinned_max.max(self.pinned);
        Ok(pinned)
    }

    /// A frame for the upper half of a page that splits; its bytes are whatever was there before. Goes back by
    /// [`Pager::add_split`] or [`Pager::return_frame`].
    ///
    /// # Errors
    /// Every frame is pinned, or the store failed while one was emptied.
    pub fn take_frame(&mut self) -> Result<PageBuffer, PagingError> {
        Ok(PageBuffer::zeroed(self.config.frame_bytes()))
    }

    /// Gives back a frame that was taken for nothing.
    pub fn return_frame(&mut self, buffer: PageBuffer) {
        drop(buffer);
    }

    /// Adds the upper half of a page that split: it gets a number, is pinned and dirty. The lower half keeps the number of
    /// the page; its new meta goes in by [`Pager::release`].
    pub fn add_split(&mut self, meta: PageMeta, buffer: PageBuffer) -> PinnedPage {
        self.index.push(meta);
        self.frames.push(None);
        self.pinned += 1;
        self.stats.pinned_max = self.stats.pinned_max.max(self.pinned);
        PinnedPage { page: PageNo(self.index.len() as u32 - 1), meta, dirty: true, buffer }
    }

    /// Takes pages back: all that a step has pinned, or some of them. Metas and dirty flags go into the index.
    pub fn release(&mut self, pages: Vec<PinnedPage>) {
        for PinnedPage { page, meta, buffer, .. } in pages {
            self.index[page.index()] = meta;
            self.frames[page.index()] = Some(buffer);
            self.pinned -= 1;
        }
    }

    /// Starts reads for the steps after `step` and writes of dirty pages that are not needed soon; never blocks. Call
    /// it when the pages of `step` are pinned.
    pub fn prefetch(&mut self, _step: u32) {}

    /// What was done so far.
    pub fn stats(&self) -> PagerStats {
        PagerStats { frames: self.frames.len(), frames_max: usize::MAX, ..self.stats }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::ids::PageId;
    use crate::scene::columns::Columns;
    use crate::scene::page_layout::{read_page, write_page};
    use crate::scene::page_meta::PageBounds;
    use crate::scene::state::SceneState;

    const CAMERA: Camera = Camera {
        viewmat: [[1.0, 0.0, 0.0, 0.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]],
        fx: 100.0,
        fy: 100.0,
        cx: 50.0,
        cy: 50.0,
        width: 100,
        height: 100,
        near_plane: 0.1,
        far_plane: 100.0,
    };

    fn meta(index: u32, rows: u32, x: f32) -> PageMeta {
        let bounds = PageBounds { lo: [x, -1.0, 5.0], hi: [x + 1.0, 1.0, 6.0], sigma_max: 0.01 };
        PageMeta { id: PageId::initial(index), rows, sh_degree: 1, events_applied: 0, bounds }
    }

    #[test]
    fn pages_of_a_view_come_in_order_of_ids_and_keep_their_rows() {
        let mut pager = Pager::in_memory(PagerConfig { page_rows: 16, sh_degree: 1 });
        let scene = |rows: usize, value: f32| {
            let mut state = SceneState::from_columns(Columns::zeros(rows, 1));
            state.columns.means.fill(value);
            state
        };
        // In view, out of view, in view, without rows; ids descend.
        for (i, (rows, x)) in [(16, 0.0), (5, 90.0), (7, 1.0), (0, 0.0)].into_iter().enumerate() {
            let state = scene(rows, i as f32);
            let page = pager.insert(meta(9 - i as u32, rows as u32, x), |payload| {
                write_page(&state, payload);
            });
            assert_eq!(page.unwrap(), PageNo(i as u32));
        }
        let mut pages = pager.acquire(0, &CAMERA).unwrap();
        assert_eq!(pages.iter().map(|p| p.page).collect::<Vec<_>>(), [PageNo(2), PageNo(0)]);
        assert_eq!(read_page(&pages[0].rows(0)), scene(7, 2.0));
        // The first page splits.
        let [low, high] = pages[1].meta.id.children().unwrap();
        let mut buffer = pager.take_frame().unwrap();
        write_page(&scene(9, 8.0), &mut buffer.as_mut_slice()[HEADER_BYTES..]);
        let upper = pager.add_split(PageMeta { id: high, ..meta(0, 9, 0.5) }, buffer);
        pages[1].meta = PageMeta { id: low, ..meta(0, 7, 0.0) };
        write_page(&scene(7, 6.0), pages[1].payload_mut());
        pages[1].dirty = true;
        pages.push(upper);
        pager.release(pages);
        let pages = pager.acquire(1, &CAMERA).unwrap();
        assert_eq!(pages.iter().map(|p| p.page).collect::<Vec<_>>(), [PageNo(2), PageNo(0), PageNo(4)]);
        assert_eq!(read_page(&pages[1].rows(0)), scene(7, 6.0));
        assert_eq!(read_page(&pages[2].rows(0)), scene(9, 8.0));
        pager.release(pages);
        assert_eq!((pager.stats().pages_needed, pager.stats().pinned_max), (5, 3));
    }
}
