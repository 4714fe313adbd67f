//! The cache of pages on a device: which page lies in which slot, which slots are newer than their frames, how pages come and go,
//! and traffic counters.
//!
//! A device is one more level of the cache of [`crate::paging`], with the same frame table and Belady's order of eviction. A page on
//! the device also has a frame in host memory while a step works on the page, and until its slot has been copied back. A page whose
//! slot is newer than its frame is *held*: it stays pinned in the pager, so that the pager neither writes nor evicts the page.
//!
//! # Room for pages that come
//! A step that waits for its numbers first copies pages back, and waits for the copies (`SlotCache::load`). Where nothing may wait, the copy
//! back is queued behind the work on the device, and the copy of the next payload into the slot behind that (`SlotCache::load_evicting`).
//!
//! ```text
//! host    submits update s │ submits copy back, copy up │ records step s+1 ...              │ finishes s │ fills the frame
//! device  ......... update s writes slot 7 ........ │ slot 7 to staging │ staging to slot 7 │ step s+1 reads slot 7 ...
//! ```
//!
//! So pages of the view that is being computed may leave, too. Such a page is *leaving* until the copy back has filled
//! its frame. The frame is filled when the last step that was submitted before the copy is finished. A step that the
//! gate refuses changes nothing, so the frame then gets the payload from before that step.
//!
//! # Payloads of the next step
//! These payloads are copied while the device computes the present step (`SlotCache::load_ahead`). A step that is recorded without
//! waiting does this once, behind its update. So does a step of several batches, since its view needs all slots until the last update.
//!
//! ```text
//! host    picture, loss, gradients submitted │ load_ahead: unused pages leave │ wait │ update submitted │ load_ahead: any page leaves │ wait
//! device  ...................................│ copies ........................│      │ update ..........│ copies ....................│
//! ```
//!
//! The list of the next view's pages is computed from the bounds before this step, so it may lack pages or have superfluous ones. The
//! pages that a step touches follow from the bounds at that step: a missing page is copied then, and a superfluous page changes no bit.
//!
//! Not here: pages that events change (`device_tier`); steps in flight (`device_flights`).
//!
//! Invariants: 1. a held page differs from its frame, a page that is leaving exists in its copy back alone, and every other page equals
//! its frame; 2. slots, frames and the order of copies change no bit of a page; 3. the slot of a page of a batch stays until the
//! batch is released, or until the page leaves behind its update; 4. a slot that was not filled is given up; 5. a page that is
//! leaving is pinned in the pager and in no slot, and neither held nor released before its frame is filled; 6. copies end in the
//! order in which they began; 7. no page of the next view is evicted for a payload of that view.

use super::pages::PagedScene;
use crate::base::error::InputError;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::densify::replay::PageFacts;
use crate::densify::strategy::Extremes;
use crate::kernels::uniforms::PageSurvey;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::paging::frames::evict::{Candidate, EvictPolicy, NEVER};
use crate::paging::frames::table::{FrameState, FrameTable};
use crate::paging::pinned::PinnedPage;
use crate::paging::plan::bound::FewestReads;
use crate::render::pages::{DeviceSlot, PageRenderer, SlotPage};
use crate::render::{RenderError, Renderer};
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageMeta;
use crate::scene::sightings::WEIGHT_MOST;
use crate::train::error::TrainError;
use serde::{Deserialize, Serialize};
use std::cmp::Reverse;
use std::collections::{BTreeMap, BTreeSet, VecDeque};

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
struct SlotInUse {
    pub slot: DeviceSlot,
    /// Whether the slot is newer than the frame.
    pub is_newer: bool,
    pub layout: PageLayout,
}

#[derive(Debug)]
struct Leaving {
    pub page: PageNo,
    /// The slot that is copied back.
    pub slot: DeviceSlot,
    /// The step that was submitted last when the copy back began.
    pub behind: u32,
    /// `None` while a step in flight, or the batch of a step, has the page.
    pub pinned: Option<PinnedPage>,
}

/// A payload that is to go up.
#[derive(Debug, Clone, Copy)]
pub(super) struct ComingUse<'a> {
    pub page: PageNo,
    /// The step that needs the page.
    pub next_use: u32,
    pub layout: PageLayout,
    pub payload: &'a [u8],
}

/// Which pages may leave.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Leaves {
    /// Only pages that no step uses. Where the order of eviction comes to a page of the present step, no other page leaves in its place.
    Unused,
    /// Also pages of the steps that are submitted as a whole.
    Used,
}

/// The pages in the slots of a device.
#[derive(Debug)]
pub(crate) struct SlotCache {
    pub(super) slots: FrameTable<DeviceSlot>,
    /// Slots that have been given out, so that each is given out once.
    given: u32,
    /// Most slots that there may be.
    slots_most: usize,
    /// Whether the device holds moments of 16 bits, two to a word.
    is_packed: bool,
    /// Pages whose slot is newer than their frame, pinned in the pager, outside of the batch of a step.
    held: BTreeMap<PageNo, PinnedPage>,
    /// Pages whose slots were given to others and whose frames are still to be filled, in the order of their copies back.
    leaving: VecDeque<Leaving>,
    /// Slots of the batch of a step, or of the steps in flight.
    in_use: BTreeMap<PageNo, SlotInUse>,
    pub(super) traffic: SlotTraffic,
    /// The fewest loads of any order of eviction.
    pub(super) fewest: FewestReads,
    /// The next 0-based step whose events edit every page, [`NEVER`] if there is none; `None` until it is known.
    edits_after: Option<u32>,
}

pub(super) fn device_of(renderer: &mut dyn Renderer) -> Result<&mut dyn PageRenderer, TrainError> {
    let name = renderer.name();
    renderer.pages().ok_or(TrainError::Render(RenderError::NoPages { backend: name }))
}

/// How many slots of `slot_bytes` bytes lie in the share of `room` bytes: buffers may take a quarter more than is asked.
pub fn slots_in(room: u64, slot_bytes: u64) -> u64 {
    room / SLOTS_SHARE / 5 * 4 / slot_bytes.max(1)
}

/// There is no slot for a page of a batch.
pub(super) fn no_slot(device: &dyn PageRenderer) -> TrainError {
    RenderError::NoSlots { bytes: device.slot_bytes() }.into()
}

/// Layout of a page's payload as its frame holds it; `None` for a page whose payload must not be copied ahead: it has no rows, no frame,
/// or events to apply first.
fn layout_ahead(scene: &PagedScene, page: PageNo) -> Option<PageLayout> {
    let meta = scene.pager.index().get(page.index())?;
    let is_ready = meta.rows > 0 && !scene.rules.is_behind(meta) && scene.pager.payload(page).is_some();
    is_ready.then_some(PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree })
}

fn payload(page: &PinnedPage) -> &[u8] {
    &page.buffer.as_slice()[HEADER_BYTES..][..page.layout().bytes()]
}

/// What a device found out about a page, with what the index of pages says.
pub(super) fn facts(page: &PageMeta, survey: &PageSurvey) -> PageFacts {
    let [lowest_opacity, least_weight] = [survey.lowest_opacity, survey.least_weight].map(f32::from_bits);
    PageFacts {
        largest_mean: f32::from_bits(survey.largest_mean),
        least_weight: if least_weight > WEIGHT_MOST { f32::INFINITY } else { least_weight },
        extremes: Extremes { lowest_opacity, sigma_max: page.bounds.sigma_max },
        sh_degree: page.sh_degree,
    }
}

/// The facts of a page that no round would edit.
pub(super) fn best_facts(page: &PageMeta) -> PageFacts {
    let [lowest_opacity, least_weight] = [f32::INFINITY.to_bits(); 2];
    facts(page, &PageSurvey { largest_mean: 0, lowest_opacity, least_weight, pad: 0 })
}

/// Whether the events that a page is behind in certainly edit its rows, so that its payload in a slot serves no step any more.
fn are_edits_due(scene: &PagedScene, page: PageNo) -> bool {
    let page = &scene.pager.index()[page.index()];
    scene.rules.is_behind(page) && !scene.rules.pending().only_clears(page.events_applied as usize, &best_facts(page))
}

impl SlotCache {
    /// A cache of at most `slots_most` slots, of which there is none yet.
    pub fn new(slots_most: usize, is_packed: bool) -> SlotCache {
        SlotCache {
            slots: FrameTable::new(0, EvictPolicy::FarthestNextUse),
            given: 0,
            slots_most,
            is_packed,
            held: BTreeMap::new(),
            leaving: VecDeque::new(),
            in_use: BTreeMap::new(),
            traffic: SlotTraffic::default(),
            fewest: FewestReads::default(),
            edits_after: None,
        }
    }

    pub fn slots(&self) -> usize {
        self.slots.frames_max()
    }

    /// Pages that are newer than their frames and outside of a batch.
    pub fn pages_held(&self) -> usize {
        self.held.len() + self.leaving.len()
    }

    /// Looks for the next step from `now` on that satisfies `edits_all`: its events edit every page, so that no payload in a slot serves
    /// the steps behind it.
    pub fn expect_edits(&mut self, now: u32, steps: u32, edits_all: impl Fn(u32) -> bool) {
        if self.edits_after.is_none_or(|after| after < now) {
            self.edits_after = Some((now..steps).find(|step| edits_all(*step)).unwrap_or(NEVER));
        }
    }

    /// Whether the payloads on the device are still valid at 0-based `step`. An event that edits one page is not considered.
    pub(super) fn is_payload_valid_at(&self, step: u32) -> bool {
        self.edits_after.is_none_or(|after| step <= after)
    }

    /// Makes slots for all pages of the scene, as far as the share of the device memory goes.
    pub(super) fn fit(&mut self, scene: &PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
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
        scene.pager.refresh_plan(step);
        self.slots.begin_step(step);
        self.fit(scene, renderer)
    }

    /// Pins the pages of a batch, as [`crate::paging::pager::Pager::pin_batch`]. Held pages are pinned already. If the
    /// batch needs frames, other held pages are copied back. Steps in flight have pinned `pages_in_flight` pages.
    pub fn pin(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        (pages, pages_in_flight): (&[PageNo], usize),
        (step, is_again): (u32, bool),
    ) -> Result<Vec<PinnedPage>, TrainError> {
        let (own, others): (Vec<PageNo>, Vec<PageNo>) = pages.iter().partition(|page| self.held.contains_key(page));
        // As many frames again as the batch has pages: for pages that split, and for reads ahead.
        let in_flight = pages_in_flight + self.pages_leaving();
        let most = scene.pager.frames_max().saturating_sub(in_flight + others.len() + pages.len()).max(own.len());
        self.write_back_down_to(scene, renderer, most, pages)?;
        scene.pager.set_held(in_flight + self.held.len() - own.len());
        let mut pinned = scene.pager.pin_batch(step, &others, is_again)?;
        pinned.extend(own.iter().filter_map(|page| self.held.remove(page)));
        pinned.sort_unstable_by_key(|page| page.meta.id);
        Ok(pinned)
    }

    /// Copies held pages back until at most `most` are held, the pages with the farthest next use first, but none of `kept`.
    pub(super) fn write_back_down_to(
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
        pages.sort_by_key(|page| (Reverse(scene.pager.next_use(*page)), page.0));
        pages.truncate(self.held.len() - most);
        self.drain_pages(scene, renderer, &pages)
    }

    /// Copies these held pages back to their frames and unpins them. Their slots stay, and equal the frames.
    fn drain_pages(
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
            let (slot, layout) = (self.slots.begin_write(page.page), page.layout());
            moved.push((page.page, slot));
            copies.push((SlotPage { slot, layout }, &mut page.payload_mut()[..layout.bytes()]));
        }
        if copies.is_empty() {
            return Ok(());
        }
        let bytes: u64 = copies.iter().map(|(page, _)| self.bytes_of(page.layout)).sum();
        let _span = trace::span("drain").with("pages", moved.len() as u64).with("bytes", bytes);
        let copied = device_of(renderer).and_then(|device| Ok(device.read_slots(&mut copies)?));
        for (page, slot) in &moved {
            self.slots.finish_write(*page, *slot, copied.is_ok());
        }
        self.traffic.drains += moved.len() as u64;
        self.traffic.bytes_drained += bytes;
        copied
    }

    /// Puts the pages of a batch into slots; payloads that are missing are copied there.
    pub fn load(
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
                copies.push((SlotPage { slot, layout: page.layout() }, payload(page)));
            }
        }
        if copies.is_empty() {
            return Ok(());
        }
        let written = device_of(renderer).and_then(|device| Ok(device.write_slots(&copies)?));
        if let Err(error) = written {
            for page in missing {
                if let Some(in_use) = self.in_use.remove(&page.page) {
                    self.slots.unpin(page.page, in_use.slot, false);
                    self.slots.evict(page.page);
                }
            }
            return Err(error);
        }
        self.traffic.loads += copies.len() as u64;
        self.traffic.bytes_loaded += copies.iter().map(|(page, _)| self.bytes_of(page.layout)).sum::<u64>();
        Ok(())
    }

    /// As `SlotCache::load`, for a step that is recorded: room is made behind the steps in flight, and nothing waits. If memory
    /// for the copies back is short, a step without another in flight waits; for a step behind another, returns `None`.
    pub(super) fn load_after_queued_work(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        (step, is_alone): (u32, bool),
        pinned: &[&PinnedPage],
    ) -> Result<Option<Vec<SlotPage>>, TrainError> {
        let missing = self.use_slots(pinned);
        let coming: Vec<ComingUse<'_>> = missing
            .iter()
            .map(|page| ComingUse { page: page.page, next_use: step, layout: page.layout(), payload: payload(page) })
            .collect();
        let how = (step.saturating_sub(1), Leaves::Used, !is_alone);
        let kept: Vec<PageNo> = pinned.iter().map(|page| page.page).collect();
        let loaded = self.load_evicting(scene, renderer, how, &coming, &kept)?;
        for page in missing.iter().take(loaded) {
            self.use_slot(page);
        }
        if loaded < missing.len() {
            if !is_alone {
                return Ok(None);
            }
            self.load_missing(scene, renderer, &missing[loaded..])?;
        }
        self.count_fewest(pinned);
        Ok(Some(self.loaded(pinned.iter().copied())))
    }

    /// Copies payloads of 0-based `step`, the next one, which needs the pages `of_view`, into slots. The device may still be at work on this
    /// step. Nothing goes up if events between the two steps edit every page.
    pub(super) fn load_ahead(
        &mut self,
        scene: &PagedScene,
        renderer: &mut dyn Renderer,
        (step, of_view): (u32, &[PageNo]),
        leaves: Leaves,
    ) -> Result<(), TrainError> {
        if !self.is_payload_valid_at(step) {
            return Ok(());
        }
        let missing = of_view.iter().copied().filter(|page| self.slots.state(*page).is_none());
        let coming: Vec<ComingUse<'_>> = missing
            .filter_map(|page| {
                let layout = layout_ahead(scene, page)?;
                let payload = scene.pager.payload(page)?.get(..layout.bytes())?;
                Some(ComingUse { page, next_use: step, layout, payload })
            })
            .collect();
        self.load_evicting(scene, renderer, (step.saturating_sub(1), leaves, true), &coming, of_view).map(|_| ())
    }

    /// Copies payloads to the device, in this order, as far as there are slots. Evicts pages for them, but none of
    /// `kept`, and none that is needed as early as the payloads. `behind` is the last submitted step; `is_ahead`: the
    /// device may still compute that step. Returns the number of payloads copied. Does not wait.
    fn load_evicting(
        &mut self,
        scene: &PagedScene,
        renderer: &mut dyn Renderer,
        (behind, leaves, is_ahead): (u32, Leaves, bool),
        coming: &[ComingUse<'_>],
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
            copies.push((SlotPage { slot, layout: page.layout }, page.payload));
        }
        if copies.is_empty() {
            return Ok(0);
        }
        let (loads, bytes) = (pages.len(), copies.iter().map(|(page, _)| self.bytes_of(page.layout)).sum());
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
                // A step in flight may change the page, so copy it back in any case.
                Some(in_use) => {
                    pages.push(page);
                    reads.push(SlotPage { slot: in_use.slot, layout: in_use.layout });
                }
                None if self.slots.is_dirty(page) => {
                    let (slot, held) = (self.slots.memory(page), self.held.get(&page));
                    if let (Some(slot), Some(held)) = (slot, held) {
                        pages.push(page);
                        reads.push(SlotPage { slot: *slot, layout: held.layout() });
                    }
                }
                None => self.slots.evict(page),
            }
        }
        if pages.is_empty() {
            return Ok(());
        }
        let begun = device_of(renderer)?.begin_reads(&reads)?;
        for (page, SlotPage { slot, .. }) in pages.into_iter().zip(reads).take(begun) {
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

    /// Adds the pages of a batch to the bound on loads.
    fn count_fewest(&mut self, pinned: &[&PinnedPage]) {
        let with_rows = pinned.iter().filter(|page| page.meta.rows > 0);
        let is_packed = self.is_packed;
        let bytes = with_rows.map(|page| (page.page, page.layout().bytes_on_device(is_packed)));
        self.fewest.step(self.slots.frames_max(), bytes);
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
        self.in_use.insert(page.page, SlotInUse { slot, is_newer, layout: page.layout() });
        Some(slot)
    }

    /// Bytes of a payload in a slot.
    fn bytes_of(&self, layout: PageLayout) -> u64 {
        layout.bytes_on_device(self.is_packed)
    }

    /// A free slot for the payload of a page, which is to be copied there; `None` where no slot is free.
    fn new_slot(&mut self, page: PageNo, next_use: u32) -> Option<DeviceSlot> {
        let given = &mut self.given;
        let slot = self.slots.begin_load(page, next_use, || {
            *given += 1;
            DeviceSlot(*given - 1)
        })?;
        self.slots.finish_load(page, slot);
        Some(slot)
    }

    /// The pages of a batch in the slots that `SlotCache::load` gave them.
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

    /// Sets the next uses of the pages in slots by the plan. A page that events edit before its next use counts as
    /// never needed: its payload in the slot serves no step.
    fn plan_uses(&mut self, scene: &PagedScene) {
        let pages: Vec<PageNo> = self.slots.held().map(|(_, held)| held.page).collect();
        for page in pages {
            let next_use = scene.pager.next_use(page);
            let is_kept = self.is_payload_valid_at(next_use) && !are_edits_due(scene, page);
            self.slots.set_next_use(page, if is_kept { next_use } else { NEVER });
        }
    }

    /// Notes that an update has changed a page of the batch in its slot. A page that has left the slot since is no page of it any more.
    pub fn changed(&mut self, page: PageNo) {
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

    pub(super) fn is_leaving(&self, page: PageNo) -> bool {
        self.leaving.iter().any(|leaving| leaving.page == page)
    }

    /// Pages that are leaving and that no step has.
    pub(super) fn pages_leaving(&self) -> usize {
        self.leaving.iter().filter(|leaving| leaving.pinned.is_some()).count()
    }

    /// Takes over pages that a step has done with and that are leaving; returns the others.
    fn keep_leaving(&mut self, scene: &mut PagedScene, pages: Vec<PinnedPage>) -> Vec<PinnedPage> {
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

    /// Waits for the copies back that began behind step `last` or before, fills the frames of their pages, and unpins those that no step
    /// has: `of_steps` are the pages of the steps.
    /// Errors: the device failed: the pages exist nowhere else ([`TrainError::Torn`]).
    pub(super) fn finish_leaving(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        last: u32,
        of_steps: &mut dyn Iterator<Item = &mut PinnedPage>,
    ) -> Result<(), TrainError> {
        let count = self.leaving.iter().take_while(|leaving| leaving.behind <= last).count();
        if count == 0 {
            return Ok(());
        }
        let mut ending: Vec<Leaving> = self.leaving.drain(..count).collect();
        let filled = self.fill_frames_of(renderer, &mut ending, of_steps);
        if let Err(error) = filled {
            ending.into_iter().rev().for_each(|leaving| self.leaving.push_front(leaving));
            return Err(TrainError::torn(error));
        }
        scene.pager.release(ending.into_iter().filter_map(|leaving| leaving.pinned).collect());
        Ok(())
    }

    /// Fills the frames of leaving pages; the frame of a page that a step has is in `of_steps`.
    fn fill_frames_of(
        &mut self,
        renderer: &mut dyn Renderer,
        pages: &mut [Leaving],
        of_steps: &mut dyn Iterator<Item = &mut PinnedPage>,
    ) -> Result<(), TrainError> {
        let mut of_steps: BTreeMap<PageNo, &mut PinnedPage> = of_steps.map(|page| (page.page, page)).collect();
        let mut copies = Vec::new();
        for leaving in pages {
            let pinned = leaving.pinned.as_mut().or_else(|| of_steps.remove(&leaving.page));
            let pinned = pinned.ok_or_else(|| {
                let problem = "a page that left its slot has no frame";
                InputError::new("the pages on the device", problem, "report this as a bug")
            })?;
            let layout = pinned.layout();
            copies.push((SlotPage { slot: leaving.slot, layout }, &mut pinned.payload_mut()[..layout.bytes()]));
        }
        let bytes: u64 = copies.iter().map(|(page, _)| self.bytes_of(page.layout)).sum();
        let _span = trace::span("drain").with("pages", copies.len() as u64).with("bytes", bytes);
        device_of(renderer)?.finish_reads(&mut copies)?;
        self.traffic.drains += copies.len() as u64;
        self.traffic.bytes_drained += bytes;
        Ok(())
    }
}
