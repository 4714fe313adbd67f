//! The pages that the coming steps will need, as far as they are known.
//!
//! Invariants: 1. the lists of steps and the uses of pages say the same; both ascend; 2. a page's next use is the first
//! planned step that needs it, and every change of it is reported, so that the cache can follow; 3. the window takes at
//! most about its share of memory, steps that do not fit are not planned; 4. lists are by the bounds of the time when
//! they were made: they are advice, nobody may rely on them being complete.

use crate::base::ids::PageNo;
use crate::cache::evict::NEVER;
use crate::scene::camera::Camera;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::collections::VecDeque;

/// Bytes that one use of one page takes: in the list of its step and in that of its page.
const USE_BYTES: usize = 2 * size_of::<u32>();

/// Steps from `first` on and the pages that each needs.
#[derive(Debug)]
pub(super) struct Window {
    uses_max: usize,
    uses_held: usize,
    first: u32,
    steps: VecDeque<PlannedStep>,
    /// By page: the planned steps that need it.
    uses: Vec<VecDeque<u32>>,
    /// Pages whose next use changed since [`Window::take_changed`].
    changed: Vec<PageNo>,
}

#[derive(Debug)]
struct PlannedStep {
    camera: Camera,
    pages: Vec<PageNo>,
}

impl Window {
    /// A window of at most about `bytes` bytes.
    pub fn new(bytes: usize) -> Window {
        Window {
            uses_max: bytes / USE_BYTES,
            uses_held: 0,
            first: 0,
            steps: VecDeque::new(),
            uses: Vec::new(),
            changed: Vec::new(),
        }
    }

    /// The pages that `step` is planned to need, ascending; `None` for a step that is not planned.
    pub fn pages(&self, step: u32) -> Option<&[PageNo]> {
        self.steps.get(step.checked_sub(self.first)? as usize).map(|s| s.pages.as_slice())
    }

    /// The first planned step that needs the page.
    pub fn next_use(&self, page: PageNo) -> u32 {
        self.uses.get(page.index()).and_then(|u| u.front().copied()).unwrap_or(NEVER)
    }

    /// The first planned step after `step` that needs the page.
    pub fn next_use_after(&self, page: PageNo, step: u32) -> u32 {
        let uses = self.uses.get(page.index());
        uses.and_then(|u| u.iter().copied().find(|&s| s > step)).unwrap_or(NEVER)
    }

    /// Pages whose next use changed since the last call.
    pub fn take_changed(&mut self) -> Vec<PageNo> {
        std::mem::take(&mut self.changed)
    }

    /// The steps before `step` are over.
    pub fn pass(&mut self, step: u32) {
        while self.first < step
            && let Some(past) = self.steps.pop_front()
        {
            self.uses_held -= past.pages.len();
            for page in past.pages {
                self.uses[page.index()].pop_front();
                self.changed.push(page);
            }
            self.first += 1;
        }
        if self.steps.is_empty() {
            self.first = self.first.max(step);
        }
    }

    /// The views of the steps from `first_step` on are these; what is planned for the same view of the same step stays.
    pub fn renew(&mut self, first_step: u32, cameras: &[&Camera], index: &[PageMeta]) {
        self.add_pages(index);
        self.pass(first_step);
        if self.first != first_step {
            self.truncate(0);
            self.first = first_step;
        }
        let same = self.steps.iter().zip(cameras).take_while(|(planned, camera)| planned.camera == ***camera).count();
        self.truncate(same);
        for (camera, step) in cameras[same..].iter().zip(first_step + same as u32..) {
            if self.uses_held >= self.uses_max {
                break;
            }
            let mut pages = Vec::new();
            visible_pages(index, camera, &mut pages);
            for &page in &pages {
                self.add_use(page, step);
            }
            self.uses_held += pages.len();
            self.steps.push_back(PlannedStep { camera: **camera, pages });
        }
    }

    /// Lists the pages of a planned step again, by the bounds as they are now.
    pub fn refresh(&mut self, step: u32, index: &[PageMeta]) {
        self.add_pages(index);
        let Some(planned) = step.checked_sub(self.first).and_then(|i| self.steps.get_mut(i as usize)) else { return };
        let mut pages = Vec::new();
        visible_pages(index, &planned.camera, &mut pages);
        let old = std::mem::replace(&mut planned.pages, pages.clone());
        for &page in old.iter().filter(|p| pages.binary_search(p).is_err()) {
            self.uses[page.index()].retain(|&s| s != step);
            self.changed.push(page);
        }
        for &page in pages.iter().filter(|p| old.binary_search(p).is_err()) {
            self.add_use(page, step);
        }
        self.uses_held = self.uses_held + pages.len() - old.len();
    }

    /// Plans the pages at the end of the index that are new: halves of splits.
    pub fn add_pages(&mut self, index: &[PageMeta]) {
        let known = self.uses.len();
        if known == index.len() {
            return;
        }
        self.uses.resize_with(index.len(), VecDeque::new);
        let mut found = Vec::new();
        for (planned, step) in self.steps.iter_mut().zip(self.first..) {
            visible_pages(&index[known..], &planned.camera, &mut found);
            for page in found.iter().map(|p| PageNo(p.0 + known as u32)) {
                planned.pages.push(page);
                self.uses[page.index()].push_back(step);
            }
            self.uses_held += found.len();
        }
        self.changed.extend((known..index.len()).map(|i| PageNo(i as u32)));
    }

    fn add_use(&mut self, page: PageNo, step: u32) {
        let uses = &mut self.uses[page.index()];
        let at = uses.partition_point(|&s| s < step);
        uses.insert(at, step);
        if at == 0 {
            self.changed.push(page);
        }
    }

    fn truncate(&mut self, len: usize) {
        while self.steps.len() > len
            && let Some(dropped) = self.steps.pop_back()
        {
            self.uses_held -= dropped.pages.len();
            for page in dropped.pages {
                let uses = &mut self.uses[page.index()];
                uses.pop_back();
                if uses.is_empty() {
                    self.changed.push(page);
                }
            }
        }
    }
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;
    use crate::base::ids::PageId;
    use crate::base::rng::{Purpose, Stream};
    use crate::scene::page_meta::PageBounds;

    fn camera(x: f32) -> Camera {
        let viewmat = [[1.0, 0.0, 0.0, -x], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0]];
        let (near_plane, far_plane) = (0.1, 100.0);
        Camera { viewmat, fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0, width: 100, height: 100, near_plane, far_plane }
    }

    fn page(number: u32, x: f32) -> PageMeta {
        let bounds = PageBounds { lo: [x, -1.0, 5.0], hi: [x + 0.5, 1.0, 6.0], sigma_max: 0.01 };
        PageMeta { id: PageId::initial(number), rows: 1, sh_degree: 0, events_applied: 0, bounds }
    }

    /// Against lists made anew from the cameras, through renewals, moved pages, splits and bounded windows.
    #[test]
    fn uses_follow_the_views_and_the_index() {
        let mut draws = Stream::new(1, Purpose::Test, 2, 3);
        let mut index: Vec<PageMeta> = (0..40).map(|i| page(i, i as f32)).collect();
        let cameras: Vec<Camera> = (0..200).map(|_| camera(draws.range(0.0, 40.0) as f32)).collect();
        let mut window = Window::new(1 << 20);
        let mut next_uses = vec![NEVER; 40];
        for step in 0..180 {
            let ahead = 1 + draws.below(20) as usize;
            // A camera that changes makes the rest of the window anew.
            let coming: Vec<&Camera> = cameras[step..step + ahead].iter().collect();
            window.renew(step as u32, &coming, &index);
            let moved = draws.below(index.len() as u64) as usize;
            index[moved] = page(moved as u32, draws.range(0.0, 40.0) as f32);
            if draws.below(4) == 0 {
                index.push(page(index.len() as u32, draws.range(0.0, 40.0) as f32));
            }
            (0..ahead).for_each(|i| window.refresh((step + i) as u32, &index));
            let mut want = vec![VecDeque::new(); index.len()];
            for (camera, s) in coming.iter().zip(step as u32..) {
                let mut pages = Vec::new();
                visible_pages(&index, camera, &mut pages);
                assert_eq!(window.pages(s), Some(pages.as_slice()));
                pages.iter().for_each(|p| want[p.index()].push_back(s));
            }
            assert_eq!(window.uses, want);
            assert_eq!(window.uses_held, want.iter().map(VecDeque::len).sum::<usize>());
            assert_eq!(window.pages(step as u32 + ahead as u32), None);
            next_uses.resize(index.len(), NEVER);
            window.take_changed().iter().for_each(|&p| next_uses[p.index()] = window.next_use(p));
            assert!(
                (0..index.len()).all(|p| next_uses[p] == window.next_use(PageNo(p as u32))),
                "all changes reported"
            );
        }
    }

    #[test]
    fn windows_end_where_their_memory_does_and_can_jump() {
        let index: Vec<PageMeta> = (0..40).map(|i| page(i, i as f32)).collect();
        let cameras: Vec<Camera> = (0..30).map(|i| camera(i as f32)).collect();
        let cameras: Vec<&Camera> = cameras.iter().collect();
        let mut window = Window::new(100 * USE_BYTES);
        window.renew(0, &cameras, &index);
        let planned = (0..30).filter(|&s| window.pages(s).is_some()).count();
        assert!((5..20).contains(&planned), "{planned}");
        window.renew(100, &cameras[..3], &index);
        assert!(window.pages(29).is_none() && window.pages(100).is_some() && window.pages(103).is_none());
        window.renew(50, &cameras[..3], &index);
        assert!(window.pages(50).is_some() && window.pages(100).is_none());
        window.pass(60);
        assert!((0..40).all(|p| window.next_use(PageNo(p)) == NEVER) && window.uses_held == 0);
        assert_eq!(window.next_use_after(PageNo(3), 60), NEVER);
    }
}
