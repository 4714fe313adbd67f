//! Puts the pages of a batch into slots of a device: finds those that have one, and copies up the payloads of the others.
//!
//! Two ways make room. A step that waits for its numbers copies back first, and waits ([`DeviceTier::load`]). A step that is recorded lets pages
//! leave behind the work under way ([`DeviceTier::load_after_queued_work`]). Both evict by Belady's order.
//!
//! Not here: payloads of the next step (`device_ahead`), the eviction itself where nothing waits (`device_leaving`).
//!
//! Invariants: 1. the slot of a page of a batch stays until the batch is released, or until the page leaves behind its update; 2. a slot
//! that was not filled is given up.

use super::device_events::are_edits_due;
use super::device_leaving::{Coming, Leaves};
use super::device_tier::{DeviceTier, SlotInUse, device_of, no_slot, payload_bytes};
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::paging::frames::evict::NEVER;
use crate::paging::pinned::PinnedPage;
use crate::render::Renderer;
use crate::render::pages::{DeviceSlot, SlotPage};
use crate::train::error::TrainError;

fn payload(page: &PinnedPage) -> &[u8] {
    &page.buffer.as_slice()[HEADER_BYTES..][..payload_bytes(page)]
}

impl DeviceTier {
    /// Puts the pages of a batch into slots; payloads that are missing are copied there.
    pub(crate) fn load(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        pinned: &[&PinnedPage],
    ) -> Result<Vec<SlotPage>, TrainError> {
        self.count_fewest(pinned);
        let missing = self.use_slots(pinned);
        self.load_missing(scene, renderer, &missing)?;
        Ok(self.loaded(pinned.iter().copied()))
    }

    /// Copies payloads into slots, after the copies back that make room.
    fn load_missing(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        missing: &[&PinnedPage],
    ) -> Result<(), TrainError> {
        self.make_room(scene, renderer, missing.len())?;
        let mut copies = Vec::new();
        for page in missing {
            if self.new_slot(page.page, scene.pager.next_use(page.page)).is_none() {
                return Err(no_slot(device_of(renderer)?));
            }
            if let Some(slot) = self.use_slot(page) {
                copies.push((slot, payload(page)));
            }
        }
        if copies.is_empty() {
            return Ok(());
        }
        let written = device_of(renderer).and_then(|device| Ok(device.write_slots(&copies)?));
        if let Err(error) = written {
            self.forget(&copies);
            return Err(error);
        }
        self.traffic.loads += copies.len() as u64;
        self.traffic.bytes_loaded += copies.iter().map(|(_, payload)| payload.len() as u64).sum::<u64>();
        Ok(())
    }

    /// As [`DeviceTier::load`], for a step that is recorded: room is made behind the steps in flight, and nothing waits. Without memory for
    /// that, a step that is alone waits; `None` for a step behind another one.
    pub(super) fn load_after_queued_work(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: u32,
        pinned: &[&PinnedPage],
    ) -> Result<Option<Vec<SlotPage>>, TrainError> {
        let missing = self.use_slots(pinned);
        let coming: Vec<Coming<'_>> =
            missing.iter().map(|page| Coming { page: page.page, next_use: step, payload: payload(page) }).collect();
        let how = (step.saturating_sub(1), Leaves::Used, self.in_flight() > 0);
        let kept: Vec<PageNo> = pinned.iter().map(|page| page.page).collect();
        let loaded = self.load_evicting(scene, renderer, how, &coming, &kept)?;
        for page in missing.iter().take(loaded) {
            self.use_slot(page);
        }
        if loaded < missing.len() {
            if self.in_flight() > 0 {
                return Ok(None);
            }
            self.load_missing(scene, renderer, &missing[loaded..])?;
        }
        self.count_fewest(pinned);
        Ok(Some(self.loaded(pinned.iter().copied())))
    }

    /// Adds the pages of a batch to the bound on loads.
    fn count_fewest(&mut self, pinned: &[&PinnedPage]) {
        let with_rows = pinned.iter().filter(|page| page.meta.rows > 0);
        self.fewest.step(self.slots.frames_max(), with_rows.map(|page| (page.page, payload_bytes(page) as u64)));
    }

    /// Takes the slots of the pages of a batch in use, and counts them as hits. Returns the pages that have none.
    fn use_slots<'a>(&mut self, pinned: &[&'a PinnedPage]) -> Vec<&'a PinnedPage> {
        let with_rows = || pinned.iter().copied().filter(|page| page.meta.rows > 0);
        // A step in flight may use the slot already.
        let missing: Vec<&PinnedPage> =
            with_rows().filter(|page| !self.in_use.contains_key(&page.page) && self.use_slot(page).is_none()).collect();
        self.traffic.hits += (with_rows().count() - missing.len()) as u64;
        missing
    }

    /// Takes the slot of a page in use, if the page has one.
    fn use_slot(&mut self, page: &PinnedPage) -> Option<DeviceSlot> {
        let (slot, is_newer) = self.slots.pin(page.page, true)?;
        self.in_use.insert(page.page, SlotInUse { slot, is_newer, bytes: payload_bytes(page) });
        Some(slot)
    }

    /// A free slot for the payload of a page, which is to be copied there; `None` where no slot is free.
    pub(super) fn new_slot(&mut self, page: PageNo, next_use: u32) -> Option<DeviceSlot> {
        let given = &mut self.given;
        let slot = self.slots.begin_load(page, next_use, || {
            *given += 1;
            DeviceSlot(*given - 1)
        })?;
        self.slots.finish_load(page, slot);
        Some(slot)
    }

    /// Gives up slots that were not filled.
    fn forget(&mut self, copies: &[(DeviceSlot, &[u8])]) {
        let unfilled = |slot: &DeviceSlot| copies.iter().any(|(other, _)| other == slot);
        let pages: Vec<PageNo> =
            self.in_use.iter().filter(|(_, in_use)| unfilled(&in_use.slot)).map(|(page, _)| *page).collect();
        for page in pages {
            if let Some(in_use) = self.in_use.remove(&page) {
                self.slots.unpin(page, in_use.slot, false);
                self.slots.evict(page);
            }
        }
    }

    /// The pages of a batch in the slots that [`DeviceTier::load`] gave them.
    pub(super) fn loaded<'a>(&self, pinned: impl Iterator<Item = &'a PinnedPage>) -> Vec<SlotPage> {
        let in_slot =
            |page: &PinnedPage| Some(SlotPage { slot: self.in_use.get(&page.page)?.slot, layout: page.layout() });
        pinned.filter(|page| page.meta.rows > 0).filter_map(in_slot).collect()
    }

    /// Empties slots until `wanted` are free: of the pages that are needed last, by the plan.
    fn make_room(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        wanted: usize,
    ) -> Result<(), TrainError> {
        if self.slots.free_frames() >= wanted {
            return Ok(());
        }
        self.plan_uses(scene);
        // All of them are read together, so the step waits once.
        let mut newer = Vec::new();
        while self.slots.free_frames() + newer.len() < wanted {
            let Some(victim) = self.slots.victim() else { break };
            match victim.dirty {
                true => newer.push((victim.page, self.slots.begin_write(victim.page))),
                false => self.slots.evict(victim.page),
            }
        }
        newer.iter().for_each(|(page, slot)| self.slots.finish_write(*page, *slot, false));
        let newer: Vec<PageNo> = newer.into_iter().map(|(page, _)| page).collect();
        self.drain_pages(scene, renderer, &newer)?;
        newer.into_iter().for_each(|page| self.slots.evict(page));
        match self.slots.free_frames() < wanted {
            true => Err(no_slot(device_of(renderer)?)),
            false => Ok(()),
        }
    }

    /// Takes over from the plan when the pages in slots are needed next. No step needs the slot of a page that
    /// events edit first.
    pub(super) fn plan_uses(&mut self, scene: &PagedScene) {
        let pages: Vec<PageNo> = self.slots.held().map(|(_, held)| held.page).collect();
        for page in pages {
            let next_use = scene.pager.next_use(page);
            let is_kept = self.is_payload_valid_at(next_use) && !are_edits_due(scene, page);
            self.slots.set_next_use(page, if is_kept { next_use } else { NEVER });
        }
    }
}
