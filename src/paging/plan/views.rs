//! The plan of the coming views: which pages each of them needs by the bounds of the pages.
//!
//! Pages move, split and lose rows while a run goes on, so lists are made anew on request, and pages that split off are
//! added to the steps that see them.
//!
//! Invariants: 1. a page's next use is the first planned step that needs it, and every change of a next use is reported, so
//! that the frame table can follow; 2. the plan takes at most about its bytes, and steps that do not fit are not planned;
//! 3. lists follow the bounds of the time when they were made: they are advice, and nobody may rely on them being complete.

use super::steps::{Plan, missing_from};
use crate::base::ids::PageNo;
use crate::paging::frames::evict::NEVER;
use crate::scene::camera::Camera;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;
use std::collections::VecDeque;

/// The coming steps with their cameras and pages.
#[derive(Debug)]
pub(in crate::paging) struct ViewPlan {
    plan: Plan,
    /// Of each planned step.
    cameras: VecDeque<Camera>,
    /// Number of pages in the index when it was last seen.
    pages_known: usize,
    /// Pages whose next use changed since [`ViewPlan::take_changed`].
    changed: Vec<PageNo>,
}

impl ViewPlan {
    /// An empty plan of at most about `bytes` bytes.
    pub fn new(bytes: usize) -> ViewPlan {
        ViewPlan { plan: Plan::new(0, bytes as u64), cameras: VecDeque::new(), pages_known: 0, changed: Vec::new() }
    }

    /// The pages that `step` is planned to need, ascending; `None` for a step that is not planned.
    pub fn pages(&self, step: u32) -> Option<&[PageNo]> {
        self.plan.steps().contains(&step).then(|| self.plan.pages(step))
    }

    /// The step after the last planned one.
    pub fn planned_to(&self) -> u32 {
        self.plan.steps().end
    }

    /// The first planned step that needs the page, or [`NEVER`].
    pub fn next_use(&self, page: PageNo) -> u32 {
        self.plan.next_use(page, 0).unwrap_or(NEVER)
    }

    /// The first planned step after `step` that needs the page.
    pub fn next_use_after(&self, page: PageNo, step: u32) -> Option<u32> {
        self.plan.next_use(page, step.saturating_add(1))
    }

    /// Pages whose next use changed since the last call.
    pub fn take_changed(&mut self) -> Vec<PageNo> {
        std::mem::take(&mut self.changed)
    }

    /// The steps before `step` are over.
    pub fn pass(&mut self, step: u32) {
        while self.plan.steps().start < step
            && let Some(past) = self.plan.pop()
        {
            self.cameras.pop_front();
            self.changed.extend(past);
        }
        if self.cameras.is_empty() && self.plan.steps().start < step {
            self.plan.restart(step);
        }
    }

    /// Plans these views for the steps from `first_step` on. What is planned for the same view of the same step stays.
    pub fn renew(&mut self, first_step: u32, cameras: &[&Camera], index: &[PageMeta]) {
        self.add_pages(index);
        self.pass(first_step);
        if self.plan.steps().start != first_step {
            self.truncate(0);
            self.plan.restart(first_step);
        }
        let same = self.cameras.iter().zip(cameras).take_while(|(planned, camera)| *planned == **camera).count();
        self.truncate(same);
        let mut pages = Vec::new();
        for camera in &cameras[same..] {
            if self.plan.is_full() {
                break;
            }
            visible_pages(index, camera, &mut pages);
            let step = self.plan.steps().end;
            if !self.plan.push(&pages) {
                break;
            }
            self.cameras.push_back(**camera);
            self.note_first_uses(&pages, step);
        }
    }

    /// Lists the pages of a planned step anew, by the bounds as they are now.
    pub fn refresh(&mut self, step: u32, index: &[PageMeta]) {
        self.add_pages(index);
        let Some(at) = step.checked_sub(self.plan.steps().start) else { return };
        let Some(camera) = self.cameras.get(at as usize) else { return };
        let mut pages = Vec::new();
        visible_pages(index, camera, &mut pages);
        let old = self.plan.replace(step, pages.clone());
        self.changed.extend(missing_from(&pages, &old));
        let added: Vec<PageNo> = missing_from(&old, &pages).collect();
        self.note_first_uses(&added, step);
    }

    /// Plans the pages at the end of the index that are new: halves of splits.
    pub fn add_pages(&mut self, index: &[PageMeta]) {
        let known = self.pages_known;
        if known == index.len() {
            return;
        }
        self.pages_known = index.len();
        let mut found = Vec::new();
        for (camera, step) in self.cameras.iter().zip(self.plan.steps()) {
            visible_pages(&index[known..], camera, &mut found);
            found.iter_mut().for_each(|page| page.0 += known as u32);
            self.plan.extend(step, &found);
        }
        self.changed.extend((known..index.len()).map(|i| PageNo(i as u32)));
    }

    /// Notes the pages of `step` that are not needed earlier.
    fn note_first_uses(&mut self, pages: &[PageNo], step: u32) {
        let plan = &self.plan;
        self.changed.extend(pages.iter().copied().filter(|&page| plan.next_use(page, 0) == Some(step)));
    }

    /// Limits the plan to about `bytes` bytes: the farthest steps are dropped.
    pub fn limit(&mut self, bytes: usize) {
        self.plan.limit(bytes as u64);
        while self.plan.is_over() && !self.cameras.is_empty() {
            self.truncate(self.cameras.len() - 1);
        }
    }

    fn truncate(&mut self, len: usize) {
        while self.cameras.len() > len
            && let Some(dropped) = self.plan.pop_last()
        {
            self.cameras.pop_back();
            let plan = &self.plan;
            self.changed.extend(dropped.into_iter().filter(|&page| plan.next_use(page, 0).is_none()));
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
        Camera::along_z(x, [100.0, 100.0, 50.0, 50.0], [100, 100])
    }

    fn page(number: u32, x: f32) -> PageMeta {
        let bounds = PageBounds { lo: [x, -1.0, 5.0], hi: [x + 0.5, 1.0, 6.0], sigma_max: 0.01 };
        PageMeta { id: PageId::initial(number), rows: 1, sh_degree: 0, events_applied: 0, bounds }
    }

    /// A plan that is limited drops its farthest steps, and reports the pages that are not needed any more.
    #[test]
    fn a_smaller_limit_drops_the_farthest_steps() {
        let index: Vec<PageMeta> = (0..40).map(|i| page(i, i as f32)).collect();
        let cameras: Vec<Camera> = (0..8).map(|i| camera(5.0 * i as f32)).collect();
        let mut plan = ViewPlan::new(1 << 20);
        plan.renew(0, &cameras.iter().collect::<Vec<_>>(), &index);
        let uses = plan.plan.uses();
        let last = plan.pages(7).unwrap()[plan.pages(7).unwrap().len() - 1];
        plan.take_changed();
        plan.limit(12 * uses / 2);
        assert!(plan.plan.uses() <= uses / 2 && plan.plan.uses() > 0, "{} of {uses}", plan.plan.uses());
        assert!(plan.pages(0).is_some() && plan.pages(7).is_none());
        assert!(plan.next_use(last) == NEVER && plan.take_changed().contains(&last));
    }

    /// Against lists made anew from the cameras, through renewals, moved pages, splits and bounded plans.
    #[test]
    fn uses_follow_the_views_and_the_index() {
        let mut draws = Stream::new(1, Purpose::Test, 2, 3);
        let mut index: Vec<PageMeta> = (0..40).map(|i| page(i, i as f32)).collect();
        let cameras: Vec<Camera> = (0..200).map(|_| camera(draws.range(0.0, 40.0) as f32)).collect();
        let mut plan = ViewPlan::new(1 << 20);
        let mut next_uses = vec![NEVER; 40];
        for step in 0..180 {
            let ahead = 1 + draws.below(20) as usize;
            // A camera that changes makes the rest of the plan anew.
            let coming: Vec<&Camera> = cameras[step..step + ahead].iter().collect();
            plan.renew(step as u32, &coming, &index);
            let moved = draws.below(index.len() as u64) as usize;
            index[moved] = page(moved as u32, draws.range(0.0, 40.0) as f32);
            if draws.below(4) == 0 {
                index.push(page(index.len() as u32, draws.range(0.0, 40.0) as f32));
            }
            (0..ahead).for_each(|i| plan.refresh((step + i) as u32, &index));
            let mut want = vec![VecDeque::new(); index.len()];
            for (camera, s) in coming.iter().zip(step as u32..) {
                let mut pages = Vec::new();
                visible_pages(&index, camera, &mut pages);
                assert_eq!(plan.pages(s), Some(pages.as_slice()));
                pages.iter().for_each(|p| want[p.index()].push_back(s));
            }
            assert_eq!(plan.plan.uses(), want.iter().map(VecDeque::len).sum::<usize>());
            for (page, uses) in want.iter().enumerate() {
                let page = PageNo(page as u32);
                assert_eq!(plan.next_use(page), uses.front().copied().unwrap_or(NEVER));
                for s in step as u32..(step + ahead) as u32 {
                    assert_eq!(plan.next_use_after(page, s), uses.iter().copied().find(|&u| u > s));
                }
            }
            assert_eq!(plan.pages(step as u32 + ahead as u32), None);
            next_uses.resize(index.len(), NEVER);
            plan.take_changed().iter().for_each(|&p| next_uses[p.index()] = plan.next_use(p));
            assert!((0..index.len()).all(|p| next_uses[p] == plan.next_use(PageNo(p as u32))), "all changes reported");
        }
    }
}
