//! The cache of pages on a device: which page lies in which slot, which slots are newer than their frames, and traffic counters.
//!
//! A device is one more level of the cache of [`crate::paging`], with the same table of frames and the same order of
//! eviction. A page that lies on the device has its frame as well while a step works on it, and until its slot was copied
//! back: a page whose slot is newer than its frame stays pinned in the pager (it is *held*), so that the pager neither writes
//! nor evicts it.
//!
//! Not here: pages that events change (`device_events`); steps in flight (`device_flights`); how a batch gets its slots (`device_loads`);
//! copies for the next step while the device computes this one (`device_ahead`); pages evicted after the queued work
//! (`device_leaving`).
//!
//! Invariants: 1. a held page differs from its frame, and every other page equals it; 2. slots, frames and the order of
//! copies change no bit of a page; 3. commits, evaluations and exports see pages only after [`DeviceTier::drain`].

use super::flights::Flights;
use super::leaving::Leaving;
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::kernels::uniforms_pages::SplitNumbers;
use crate::optim::bounds::SplitLimits;
use crate::optim::one_step::OneStep;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::paging::error::PagingError;
use crate::paging::frames::evict::{EvictPolicy, NEVER};
use crate::paging::frames::table::FrameTable;
use crate::paging::pinned::PinnedPage;
use crate::paging::plan::bound::FewestReads;
use crate::render::pages::{DeviceSlot, PageRenderer, PageRules};
use crate::render::{RenderError, Renderer};
use crate::train::error::TrainError;
use serde::{Deserialize, Serialize};
use std::collections::{BTreeMap, VecDeque};

/// The share of the device memory of a run that slots may take; views keep the rest.
pub const SLOTS_SHARE: u64 = 2;
/// A growing scene adds its number of slots over this number at once.
const MORE_SLOTS_SHARE: usize = 4;

/// Traffic between frames and slots.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SlotTraffic {
    /// Payloads copied to the device.
    pub loads: u64,
    /// Those copied while the device computed the step before.
    pub loads_ahead: u64,
    pub bytes_loaded: u64,
    /// Payloads copied back.
    pub drains: u64,
    pub bytes_drained: u64,
    /// Pages of batches that were on the device already.
    pub hits: u64,
    /// Pages whose statistics the device cleared after a round, in place of a drain, an edit and a load.
    pub cleared: u64,
    pub slots: u64,
    /// The fewest bytes that any order of eviction could have copied to that many slots so far ([`FewestReads`]); to compare
    /// with `bytes_loaded`. Pages that events changed on the host are copied again in any order.
    pub bytes_loaded_fewest: u64,
}

/// The slot of a page that a step uses.
#[derive(Debug, Clone, Copy)]
pub(super) struct SlotInUse {
    pub slot: DeviceSlot,
    /// Whether the slot is newer than the frame.
    pub is_newer: bool,
    /// Bytes of the payload.
    pub bytes: usize,
}

/// The pages of a run on a device.
#[derive(Debug)]
pub struct DeviceTier {
    pub(crate) slots: FrameTable<DeviceSlot>,
    /// Slots that have been given out, so that each is given out once.
    pub(super) given: u32,
    /// Most slots that there may be.
    slots_most: usize,
    /// Pages whose slot is newer than their frame, pinned in the pager, outside of the batch of a step.
    pub(crate) held: BTreeMap<PageNo, PinnedPage>,
    /// Pages whose slots were given to others and whose frames are still to be filled, in the order of their copies back.
    pub(super) leaving: VecDeque<Leaving>,
    /// Slots of the batch of a step, or of the steps in flight.
    pub(super) in_use: BTreeMap<PageNo, SlotInUse>,
    pub(crate) traffic: SlotTraffic,
    /// Steps in flight.
    pub(super) flights: Flights,
    /// Loads that no order of eviction avoids.
    pub(super) fewest: FewestReads,
    /// The next 0-based step whose events edit every page, [`NEVER`] if there is none; `None` until it is known.
    edits_after: Option<u32>,
}

/// The device of a renderer.
pub(super) fn device_of(renderer: &mut dyn Renderer) -> Result<&mut dyn PageRenderer, TrainError> {
    let name = renderer.name();
    renderer.pages().ok_or(TrainError::Render(RenderError::NoPages { backend: name }))
}

/// How many slots of `slot_bytes` bytes lie in the share of `room` bytes: buffers may take a quarter more than is asked.
pub(crate) fn slots_in(room: u64, slot_bytes: u64) -> u64 {
    room / SLOTS_SHARE / 5 * 4 / slot_bytes.max(1)
}

/// Number of slots, for payloads of at most `payload` bytes, in a device memory of `device_mem` bytes beside the memory
/// of a view.
pub fn slots_of_budget(device_mem: u64, payload: u64) -> usize {
    usize::try_from(slots_in(device_mem, payload)).unwrap_or(usize::MAX)
}

/// There is no slot for a page of a batch.
pub(super) fn no_slot(device: &dyn PageRenderer) -> TrainError {
    RenderError::NoSlots { bytes: device.slot_bytes() }.into()
}

/// Bytes of a page's payload.
pub(super) fn payload_bytes(page: &PinnedPage) -> usize {
    page.layout().bytes()
}

impl DeviceTier {
    /// Prepares a device for the pages of a run of `steps` steps.
    ///
    /// # Errors
    /// The device failed or has no room, or the run's optimizer is not one that devices have.
    pub fn new(scene: &PagedScene, renderer: &mut dyn Renderer, steps: u32) -> Result<DeviceTier, TrainError> {
        let name = renderer.name();
        let numbers = scene.rules.adam.numbers(steps);
        let numbers = numbers.ok_or(TrainError::Render(RenderError::NoPages { backend: name }))?;
        let SplitLimits { grow_grad2d, split_scale, reach } = *scene.rules.splits();
        let splits = SplitNumbers { grow_grad2d, split_scale, reach };
        let flights = Flights::new(OneStep::new(&numbers, scene.rules.splits()));
        let payload_bytes = scene.pager.frame_bytes() - HEADER_BYTES;
        let device = device_of(renderer)?;
        device.prepare_page_storage(&PageRules {
            payload_bytes,
            numbers,
            splits,
            weighs: scene.rules.strategy.needs_weights(),
        })?;
        let slots_most = slots_in(device.room(), device.slot_bytes()).clamp(1, u64::from(u32::MAX / 2));
        let mut tier = DeviceTier {
            slots: FrameTable::new(0, EvictPolicy::FarthestNextUse),
            given: 0,
            slots_most: slots_most as usize,
            held: BTreeMap::new(),
            leaving: VecDeque::new(),
            in_use: BTreeMap::new(),
            traffic: SlotTraffic::default(),
            flights,
            fewest: FewestReads::default(),
            edits_after: None,
        };
        tier.fit(scene, renderer)?;
        Ok(tier)
    }

    /// The tier of a run, made if the run has none yet.
    ///
    /// # Errors
    /// As [`DeviceTier::new`].
    pub fn of_run<'a>(
        tier: &'a mut Option<DeviceTier>,
        scene: &PagedScene,
        renderer: &mut dyn Renderer,
        steps: u32,
    ) -> Result<&'a mut DeviceTier, TrainError> {
        match tier {
            Some(tier) => Ok(tier),
            none => Ok(none.insert(DeviceTier::new(scene, renderer, steps)?)),
        }
    }

    pub fn slots(&self) -> usize {
        self.slots.frames_max()
    }

    /// Pages that are newer than their frames and outside of a batch.
    pub fn pages_held(&self) -> usize {
        self.held.len() + self.leaving.len()
    }

    /// What was copied so far.
    pub fn traffic(&self) -> SlotTraffic {
        SlotTraffic { slots: self.slots() as u64, bytes_loaded_fewest: self.fewest.bytes(), ..self.traffic }
    }

    /// Looks for the next step from `now` on that satisfies `edits_all`: its events edit every page, so that no payload in a slot serves
    /// the steps behind it.
    pub(crate) fn expect_edits(&mut self, now: u32, steps: u32, edits_all: impl Fn(u32) -> bool) {
        if self.edits_after.is_none_or(|after| after < now) {
            self.edits_after = Some((now..steps).find(|step| edits_all(*step)).unwrap_or(NEVER));
        }
    }

    /// Whether the payloads on the device are still valid at 0-based `step`. An event that edits one page is not considered.
    pub(super) fn is_payload_valid_at(&self, step: u32) -> bool {
        self.edits_after.is_none_or(|after| step <= after)
    }

    /// Makes slots for all pages of the scene, as far as the share of the device memory goes.
    fn fit(&mut self, scene: &PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
        let (have, pages) = (self.slots(), scene.pager.index().len().max(1));
        if have >= pages.min(self.slots_most) {
            return Ok(());
        }
        let wanted = pages.max(have + have / MORE_SLOTS_SHARE).min(self.slots_most) - have;
        let added = device_of(renderer)?.add_slots(wanted)?;
        if added < wanted {
            self.slots_most = have + added;
        }
        self.slots.allow_frames(have + added);
        match self.slots() {
            0 => Err(no_slot(device_of(renderer)?)),
            _ => Ok(()),
        }
    }

    pub(super) fn begin_step(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: u32,
    ) -> Result<(), TrainError> {
        // Copies back that began behind a step in flight are not waited for.
        if self.in_flight() == 0 {
            self.finish_leaving(scene, renderer, u32::MAX, &mut [])?;
        }
        scene.pager.refresh_plan(step);
        self.slots.begin_step(step);
        self.fit(scene, renderer)
    }

    /// Pins the pages of a batch in the pager; those that are held are pinned already. Held pages give up frames that the batch
    /// needs.
    pub(crate) fn pin(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        pages: &[PageNo],
        pin: impl FnOnce(&mut PagedScene, &[PageNo]) -> Result<Vec<PinnedPage>, PagingError>,
    ) -> Result<Vec<PinnedPage>, TrainError> {
        let (own, others): (Vec<PageNo>, Vec<PageNo>) = pages.iter().partition(|page| self.held.contains_key(page));
        // As many frames again as the batch has pages: for pages that split, and for reads ahead.
        let in_flight = self.flights.pages() + self.pages_leaving();
        let most = scene.pager.frames_max().saturating_sub(in_flight + others.len() + pages.len()).max(own.len());
        self.write_back_down_to(scene, renderer, most, pages)?;
        scene.pager.set_held(in_flight + self.held.len() - own.len());
        let mut pinned = pin(scene, &others)?;
        pinned.extend(own.iter().filter_map(|page| self.held.remove(page)));
        pinned.sort_unstable_by_key(|page| page.meta.id);
        Ok(pinned)
    }

    /// Copies held pages back until at most `most` are held, the pages with the farthest next use first, but none of `kept`.
    fn write_back_down_to(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        most: usize,
        kept: &[PageNo],
    ) -> Result<(), TrainError> {
        if self.held.len() <= most {
            return Ok(());
        }
        let mut pages: Vec<PageNo> = self.held.keys().copied().filter(|page| !kept.contains(page)).collect();
        pages.sort_by_key(|page| (std::cmp::Reverse(scene.pager.next_use(*page)), page.0));
        pages.truncate(self.held.len() - most);
        self.drain_pages(scene, renderer, &pages)
    }

    /// Copies these held pages back to their frames and unpins them. Their slots stay, and equal the frames.
    pub(super) fn drain_pages(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        pages: &[PageNo],
    ) -> Result<(), TrainError> {
        let mut drained: Vec<PinnedPage> = pages.iter().filter_map(|page| self.held.remove(page)).collect();
        let copied = self.copy_back(renderer, drained.iter_mut());
        if let Err(error) = copied {
            self.held.extend(drained.into_iter().map(|page| (page.page, page)));
            return Err(error);
        }
        scene.pager.release(drained);
        Ok(())
    }

    /// Copies the slots of pages, which are newer, to their frames.
    pub(super) fn copy_back<'a>(
        &mut self,
        renderer: &mut dyn Renderer,
        pages: impl Iterator<Item = &'a mut PinnedPage>,
    ) -> Result<(), TrainError> {
        let (mut moved, mut copies) = (Vec::new(), Vec::new());
        for page in pages {
            let (slot, bytes) = (self.slots.begin_write(page.page), payload_bytes(page));
            moved.push((page.page, slot));
            copies.push((slot, &mut page.payload_mut()[..bytes]));
        }
        if copies.is_empty() {
            return Ok(());
        }
        let bytes: usize = copies.iter().map(|(_, payload)| payload.len()).sum();
        let _span = trace::span("drain").with("pages", moved.len() as u64).with("bytes", bytes as u64);
        let copied = device_of(renderer).and_then(|device| Ok(device.read_slots(&mut copies)?));
        for (page, slot) in &moved {
            self.slots.finish_write(*page, *slot, copied.is_ok());
        }
        self.traffic.drains += moved.len() as u64;
        self.traffic.bytes_drained += bytes as u64;
        copied
    }

    /// Copies all held pages back and adds the counts of the device to the histogram. The scene is then as if the host
    /// had taken all steps.
    ///
    /// # Errors
    /// The device failed; the pages that are still held exist there alone.
    pub fn drain(&mut self, scene: &mut PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
        if self.in_flight() > 0 {
            return Err(RenderError::OutOfOrder { call: "drain", needs: "finish of every step in flight" }.into());
        }
        self.finish_leaving(scene, renderer, u32::MAX, &mut [])?;
        self.write_back_down_to(scene, renderer, 0, &[])?;
        self.take_bins(scene, renderer)
    }

    /// Adds the counts of the device to the histogram.
    ///
    /// # Errors
    /// The device failed.
    pub(crate) fn take_bins(&self, scene: &mut PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
        scene.histogram.add_changes(&device_of(renderer)?.take_bins()?);
        Ok(())
    }

    /// Notes that an update has changed a page of the batch in its slot. A page that has left the slot since is no page of it any more.
    pub(crate) fn changed(&mut self, page: PageNo) {
        if let Some(in_use) = self.in_use.get_mut(&page) {
            in_use.is_newer = true;
        }
    }

    /// Takes the pages of a batch back: those that are newer on the device, or leaving, stay pinned in the pager.
    pub(super) fn release(&mut self, scene: &mut PagedScene, pinned: Vec<PinnedPage>) {
        for page in &pinned {
            if let Some(in_use) = self.in_use.remove(&page.page) {
                self.slots.unpin(page.page, in_use.slot, in_use.is_newer);
            }
        }
        let (held, others): (Vec<_>, Vec<_>) = pinned.into_iter().partition(|page| self.slots.is_dirty(page.page));
        for page in held {
            scene.pager.note_meta(&page);
            self.held.insert(page.page, page);
        }
        let others = self.keep_leaving(scene, others);
        scene.pager.release(others);
    }
}
