//! Eviction in the order of the device's queue: a page is evicted after the queued work, and another payload takes the
//! slot, while the host waits for nothing.
//!
//! ```text
//! host    submits update s │ submits copy back, copy up │ records step s+1 ...              │ finishes s │ fills the frame
//! device  ......... update s writes slot 7 ........ │ slot 7 to staging │ staging to slot 7 │ step s+1 reads slot 7 ...
//! ```
//!
//! So pages of the view that is being computed may leave, and the order of eviction is Belady's also for payloads that go up before their
//! step. A page that has left is *leaving* until the copy back fills its frame, when the step is finished that was submitted last at that
//! time. A step that the gate refuses changes nothing, so the copy back is the payload from before the step, and the frame gets that.
//!
//! Not here: which payloads go up (`device_ahead`, `device_loads`), copies back that are waited for (`device_tier`).
//!
//! Invariants: 1. a page that is leaving is pinned in the pager and in no slot; it is neither held nor released before its frame is
//! filled; 2. no page leaves while work that needs its slot is still to be submitted; 3. copies end in the order in which they began.

use super::device_tier::{DeviceTier, device_of, payload_bytes};
use super::leaving::Leaving;
use super::pages::PagedScene;
use crate::base::error::InputError;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::paging::frames::evict::{Candidate, EvictPolicy};
use crate::paging::frames::frame::FrameState;
use crate::paging::pinned::PinnedPage;
use crate::render::Renderer;
use crate::train::error::TrainError;
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet};

/// A payload that is to go up.
#[derive(Debug, Clone, Copy)]
pub(super) struct Coming<'a> {
    pub page: PageNo,
    /// The step that needs the page.
    pub next_use: u32,
    pub payload: &'a [u8],
}

/// Which pages may leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leaves {
    /// Pages that no step uses. Pages of the present step keep their turn in the order, but stay.
    Unused,
    /// Also pages of the steps that are submitted as a whole.
    Used,
}

impl DeviceTier {
    /// Copies payloads up, in this order, as far as there are slots; pages leave for them, but none of `kept`, and none that is needed as soon
    /// as they are. `behind` is the step that was submitted last; `is_ahead` says that its work may still be under way. Returns how many went
    /// up. Does not wait.
    pub(super) fn load_evicting(
        &mut self,
        scene: &PagedScene,
        renderer: &mut dyn Renderer,
        (behind, leaves, is_ahead): (u32, Leaves, bool),
        coming: &[Coming<'_>],
        kept: &[PageNo],
    ) -> Result<usize, TrainError> {
        let wanted = coming.len().saturating_sub(self.slots.free_frames());
        if wanted > 0 {
            let latest = coming.iter().map(|page| page.next_use).max().unwrap_or(0);
            let victims = self.in_order_of_eviction(scene, kept, latest, wanted);
            self.evict_after_queued_work(renderer, behind, leaves, &victims)?;
        }
        let (mut copies, mut pages) = (Vec::new(), Vec::new());
        for page in coming {
            let Some(slot) = self.new_slot(page.page, page.next_use) else { break };
            pages.push(page.page);
            copies.push((slot, page.payload));
        }
        if copies.is_empty() {
            return Ok(0);
        }
        let (loads, bytes) = (pages.len(), copies.iter().map(|(_, payload)| payload.len() as u64).sum());
        let _span = is_ahead.then(|| trace::span("load ahead").with("pages", loads as u64).with("bytes", bytes));
        let written = device_of(renderer).and_then(|device| Ok(device.write_slots(&copies)?));
        if let Err(error) = written {
            pages.into_iter().for_each(|page| self.slots.evict(page));
            return Err(error);
        }
        self.traffic.loads += loads as u64;
        self.traffic.loads_ahead += if is_ahead { loads as u64 } else { 0 };
        self.traffic.bytes_loaded += bytes;
        Ok(loads)
    }

    /// The first `wanted` pages in slots by Belady's order, in use or not, without those of `kept` and those that are needed at `latest` or
    /// before.
    fn in_order_of_eviction(
        &mut self,
        scene: &PagedScene,
        kept: &[PageNo],
        latest: u32,
        wanted: usize,
    ) -> Vec<Candidate> {
        self.plan_uses(scene);
        let kept: BTreeSet<PageNo> = kept.iter().copied().collect();
        let may_leave =
            |state: FrameState, page: PageNo| state == FrameState::Resident || self.in_use.contains_key(&page);
        let candidates = self.slots.held().filter(|(state, held)| {
            may_leave(*state, held.page) && held.next_use > latest && !kept.contains(&held.page)
        });
        let mut pages: Vec<Candidate> = candidates.map(|(_, held)| held).collect();
        pages.sort_unstable_by_key(|held| Reverse(EvictPolicy::FarthestNextUse.key(*held)));
        pages.truncate(wanted);
        pages
    }

    /// Empties the slots of these pages, behind the work submitted so far. Pages for whose copies back there is no memory stay.
    fn evict_after_queued_work(
        &mut self,
        renderer: &mut dyn Renderer,
        behind: u32,
        leaves: Leaves,
        victims: &[Candidate],
    ) -> Result<(), TrainError> {
        let (mut pages, mut reads) = (Vec::new(), Vec::new());
        for page in victims.iter().map(|victim| victim.page) {
            match self.in_use.get(&page) {
                Some(_) if leaves == Leaves::Unused => {}
                // Whether a step in flight changes the page is not known yet.
                Some(in_use) => {
                    pages.push(page);
                    reads.push((in_use.slot, in_use.bytes));
                }
                None if self.slots.is_dirty(page) => {
                    let (slot, held) = (self.slots.memory(page), self.held.get(&page));
                    if let (Some(slot), Some(held)) = (slot, held) {
                        pages.push(page);
                        reads.push((*slot, payload_bytes(held)));
                    }
                }
                None => self.slots.evict(page),
            }
        }
        if pages.is_empty() {
            return Ok(());
        }
        let begun = device_of(renderer)?.begin_reads(&reads)?;
        for (page, (slot, _)) in pages.into_iter().zip(reads).take(begun) {
            if let Some(in_use) = self.in_use.remove(&page) {
                self.slots.unpin(page, in_use.slot, true);
            }
            let memory = self.slots.begin_write(page);
            self.slots.finish_write(page, memory, true);
            self.slots.evict(page);
            self.leaving.push_back(Leaving { page, slot, behind, pinned: self.held.remove(&page) });
        }
        Ok(())
    }

    /// Whether a page is leaving.
    pub(super) fn is_leaving(&self, page: PageNo) -> bool {
        self.leaving.iter().any(|leaving| leaving.page == page)
    }

    /// Pages that are leaving and that no step has.
    pub(super) fn pages_leaving(&self) -> usize {
        self.leaving.iter().filter(|leaving| leaving.pinned.is_some()).count()
    }

    /// Takes over pages that a step has done with and that are leaving; returns the others.
    pub(super) fn keep_leaving(&mut self, scene: &mut PagedScene, pages: Vec<PinnedPage>) -> Vec<PinnedPage> {
        let mut others = Vec::new();
        for page in pages {
            match self.leaving.iter_mut().find(|leaving| leaving.page == page.page) {
                Some(leaving) => {
                    scene.pager.note_meta(&page);
                    leaving.pinned = Some(page);
                }
                None => others.push(page),
            }
        }
        others
    }

    /// Waits for the copies back that began behind step `last` or before, fills the frames of their pages, and unpins those that neither a
    /// step in flight nor `batch` has.
    ///
    /// # Errors
    /// The device failed: the pages exist nowhere else ([`TrainError::Torn`]).
    pub(super) fn finish_leaving(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        last: u32,
        batch: &mut [PinnedPage],
    ) -> Result<(), TrainError> {
        let count = self.leaving.iter().take_while(|leaving| leaving.behind <= last).count();
        if count == 0 {
            return Ok(());
        }
        let mut ending: Vec<Leaving> = self.leaving.drain(..count).collect();
        let filled = self.fill_frames_of(renderer, &mut ending, batch);
        if let Err(error) = filled {
            ending.into_iter().rev().for_each(|leaving| self.leaving.push_front(leaving));
            return Err(TrainError::Torn { source: Box::new(error) });
        }
        scene.pager.release(ending.into_iter().filter_map(|leaving| leaving.pinned).collect());
        Ok(())
    }

    /// Fills the frames of pages, which are their own, or those of steps in flight or of `batch`.
    fn fill_frames_of(
        &mut self,
        renderer: &mut dyn Renderer,
        pages: &mut [Leaving],
        batch: &mut [PinnedPage],
    ) -> Result<(), TrainError> {
        let in_flight = self.flights.pages.values_mut().map(|(page, _)| page);
        let mut of_steps: BTreeMap<PageNo, &mut PinnedPage> =
            in_flight.chain(batch.iter_mut()).map(|page| (page.page, page)).collect();
        let mut copies = Vec::new();
        for leaving in pages {
            let pinned = leaving.pinned.as_mut().or_else(|| of_steps.remove(&leaving.page));
            let pinned = pinned.ok_or_else(|| {
                let problem = "a page that left its slot has no frame";
                InputError::new("the pages on the device", problem, "report this as a bug")
            })?;
            let bytes = payload_bytes(pinned);
            copies.push((leaving.slot, &mut pinned.payload_mut()[..bytes]));
        }
        let bytes: u64 = copies.iter().map(|(_, payload)| payload.len() as u64).sum();
        let _span = trace::span("drain").with("pages", copies.len() as u64).with("bytes", bytes);
        device_of(renderer)?.finish_reads(&mut copies)?;
        self.traffic.drains += copies.len() as u64;
        self.traffic.bytes_drained += bytes;
        Ok(())
    }
}
