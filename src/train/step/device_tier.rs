//! The pages of a run on a device ([`DeviceTier`]): the cache of their slots, the steps in flight on them, gather and update, and events.
//!
//! A step uploads the payloads of the pages that the device lacks and one table of the optimizer, and downloads some 50 bytes a page.
//! The host applies events: a page is drained, edited and loaded again. The device only handles rounds that edit no row
//! of a page, and so only clear its statistics. Once the cap on Gaussians is reached, most rounds are of this kind.
//!
//! ```text
//! pages behind in events │ survey: largest score, lowest opacity, least weight: 16 bytes a page │ ── no row is edited ──> cleared on the device
//!                                                                                 └─ a row may be ──────> drained, edited, loaded
//! ```
//!
//! A survey is conservative; a page for which it is not sure goes to the host, which decides row by row. Both ways leave the same bytes,
//! so the result does not depend on which pages have slots. That includes the bounds of the page: clearing statistics keeps them, on the
//! host as well (`SceneRules`).
//!
//! Not here: which page lies in which slot (`device_slots`), steps that are recorded without waiting (`device_flights`), which rounds edit
//! what (`densify::replay`), the stages of the device (`render`).
//!
//! Invariants: 1. commits, evaluations and exports see pages only after [`DeviceTier::drain`]; 2. an update that failed is
//! [`TrainError::Torn`]: pages that exist on the device alone may be changed; 3. a page is cleared by the device only if the host would have
//! changed nothing else; 4. where the device has no memory for a survey, the host applies the events.

use super::batch::{AtStep, RowBackend, UpdateCounts};
use super::device_flights::Flights;
use super::device_slots::{Leaves, SlotCache, SlotTraffic, best_facts, device_of, facts, slots_in};
use super::pages::{PagedScene, WorkingSet};
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::densify::replay::PageFacts;
use crate::kernels::uniforms::PageResult;
use crate::optim::one_step::OneStep;
use crate::paging::pinned::PinnedPage;
use crate::render::pages::{PageRules, SlotPage};
use crate::render::{RenderError, Renderer, none_if_out_of_memory};
use crate::scene::camera::Camera;
use crate::train::error::TrainError;

/// The pages of a run on a device.
#[derive(Debug)]
pub struct DeviceTier {
    pub(crate) cache: SlotCache,
    pub(crate) flights: Flights,
}

impl DeviceTier {
    /// Prepares a device for the pages of a run of `steps` steps.
    /// Errors: the device failed or has no room, or the run's optimizer is not one that devices have.
    pub fn new(scene: &PagedScene, renderer: &mut dyn Renderer, steps: u32) -> Result<DeviceTier, TrainError> {
        let name = renderer.name();
        let numbers = scene.rules.adam.numbers(steps);
        let numbers = numbers.ok_or(TrainError::Render(RenderError::NoPages { backend: name }))?;
        let (splits, has_halves) = (scene.rules.splits, numbers.has_halves);
        let flights = Flights::new(OneStep::new(&numbers, &scene.rules.splits));
        let device = device_of(renderer)?;
        device.prepare_page_storage(&PageRules {
            largest: scene.pager.largest_page(),
            numbers,
            splits,
            weighs: scene.rules.strategy.needs_weights(),
        })?;
        let slots_most = slots_in(device.room(), device.slot_bytes()).clamp(1, u64::from(u32::MAX / 2));
        let mut tier = DeviceTier { cache: SlotCache::new(slots_most as usize, has_halves), flights };
        tier.cache.fit(scene, renderer)?;
        Ok(tier)
    }

    /// The tier of a run, made if the run has none yet.
    /// Errors: as [`DeviceTier::new`].
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

    /// What was copied so far.
    pub fn traffic(&self) -> SlotTraffic {
        SlotTraffic {
            slots: self.cache.slots() as u64,
            bytes_loaded_fewest: self.cache.fewest.bytes(),
            ..self.cache.traffic
        }
    }

    /// Copies all held pages back and adds the counts of the device to the histogram. The scene is then as if the host
    /// had taken all steps.
    /// Errors: the device failed; the pages that are still held exist there alone.
    pub fn drain(&mut self, scene: &mut PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
        if self.flights.in_flight() > 0 {
            return Err(RenderError::OutOfOrder { call: "drain", needs: "finish of every step in flight" }.into());
        }
        self.cache.finish_leaving(scene, renderer, u32::MAX, &mut std::iter::empty())?;
        self.cache.write_back_down_to(scene, renderer, 0, &[])?;
        self.take_bins(scene, renderer)
    }

    /// Adds the counts of the device to the histogram.
    /// Errors: the device failed.
    pub(crate) fn take_bins(&self, scene: &mut PagedScene, renderer: &mut dyn Renderer) -> Result<(), TrainError> {
        scene.histogram.add_changes(&device_of(renderer)?.take_bins()?);
        Ok(())
    }
}

/// The part of the slots that a batch of a view of several batches leaves to the next step.
const SLOTS_AHEAD_SHARE: usize = 4;

/// Rows on the device of a renderer.
pub struct DeviceRows<'a> {
    tier: &'a mut DeviceTier,
    renderer: &'a mut dyn Renderer,
    step: u32,
    next: Option<&'a Camera>,
    /// The pages that the next step needs, by the bounds before this step; known in the last batch of the pass out.
    of_next: Option<Vec<PageNo>>,
}

impl<'a> DeviceRows<'a> {
    /// Begins 0-based `step` on the pages that `renderer` holds. The next step, if there is one, draws `next`.
    /// Errors: the device failed.
    pub fn new(
        tier: &'a mut DeviceTier,
        scene: &mut PagedScene,
        renderer: &'a mut dyn Renderer,
        (step, next): (u32, Option<&'a Camera>),
    ) -> Result<DeviceRows<'a>, TrainError> {
        tier.flights.begin_step(&mut tier.cache, scene, renderer, step)?;
        Ok(DeviceRows { tier, renderer, step, next, of_next: None })
    }

    /// Copies payloads of the next step up.
    fn load_ahead(&mut self, scene: &PagedScene, leaves: Leaves) -> Result<(), TrainError> {
        let Some(of_next) = &self.of_next else { return Ok(()) };
        self.tier.cache.load_ahead(scene, self.renderer, (self.step + 1, of_next), leaves)
    }

    /// Updates the pages of a batch in their slots; payloads of the next step go up behind that.
    fn update_slots(
        &mut self,
        scene: &mut PagedScene,
        batch: usize,
        pinned: &mut [PinnedPage],
        collects: bool,
    ) -> Result<Vec<PageResult>, TrainError> {
        let pages = self.tier.cache.loaded(pinned.iter());
        device_of(self.renderer)?.begin_update(batch, &pages, collects)?;
        self.load_ahead(scene, Leaves::Used)?;
        let results = device_of(self.renderer)?.finish_update()?;
        let DeviceTier { cache, flights } = &mut *self.tier;
        cache.finish_leaving(scene, self.renderer, self.step, &mut flights.pinned_pages().chain(pinned))?;
        Ok(results)
    }
}

impl RowBackend for DeviceRows<'_> {
    fn renderer(&mut self) -> &mut dyn Renderer {
        self.renderer
    }

    fn pages_most(&self) -> usize {
        self.tier.cache.slots()
    }

    /// In a view of several batches, each batch leaves slots for pages of the next step. Smaller batches copy no more bytes.
    fn pages_per_batch(&self, pages: usize) -> usize {
        let slots = self.tier.cache.slots();
        if pages <= slots { slots } else { slots - slots / SLOTS_AHEAD_SHARE }
    }

    fn pages_held(&self) -> usize {
        self.tier.cache.pages_held()
    }

    fn pin(
        &mut self,
        scene: &mut PagedScene,
        step: u32,
        pages: &[PageNo],
        is_again: bool,
    ) -> Result<Vec<PinnedPage>, TrainError> {
        let in_flight = self.tier.flights.pinned_pages().len();
        self.tier.cache.pin(scene, self.renderer, (pages, in_flight), (step, is_again))
    }

    fn before_events(&mut self, scene: &PagedScene, pinned: &mut [PinnedPage]) -> Result<(), TrainError> {
        before_events(&mut self.tier.cache, scene, self.renderer, pinned)
    }

    fn rows_in(
        &mut self,
        scene: &mut PagedScene,
        pinned: &[PinnedPage],
        at: AtStep<'_>,
        _: &mut WorkingSet,
    ) -> Result<usize, TrainError> {
        let pages = self.tier.cache.load(scene, self.renderer, &pinned.iter().collect::<Vec<_>>())?;
        let step = scene.rules.adam.at(at.step).numbers();
        Ok(device_of(self.renderer)?.pages_in(&pages, &step)?)
    }

    fn rows_out(
        &mut self,
        scene: &mut PagedScene,
        (batch, is_again): (usize, bool),
        pinned: &[PinnedPage],
        _: AtStep<'_>,
        _: &mut WorkingSet,
    ) -> Result<(), TrainError> {
        if is_again {
            self.tier.cache.load(scene, self.renderer, &pinned.iter().collect::<Vec<_>>())?;
        }
        device_of(self.renderer)?.pages_out(batch)?;
        // The last batch of the pass out: the step needs no other page any more.
        if batch == 0 {
            let behind = self.step;
            self.of_next = self.next.map(|camera| self.tier.flights.pages_behind(scene, camera, behind));
        }
        // The device is at work on the gradients, which only `loss_value` and what follows wait for.
        if is_again { Ok(()) } else { self.load_ahead(scene, Leaves::Unused) }
    }

    fn update(
        &mut self,
        scene: &mut PagedScene,
        batch: usize,
        pinned: &mut [PinnedPage],
        _: AtStep<'_>,
        _: &WorkingSet,
        collects: bool,
    ) -> Result<UpdateCounts, TrainError> {
        let results = self.update_slots(scene, batch, pinned, collects);
        let results = results.map_err(TrainError::torn)?;
        let mut counts = UpdateCounts::default();
        for (page, result) in pinned.iter_mut().filter(|page| page.meta.rows > 0).zip(results) {
            counts.updated += u64::from(result.updated);
            counts.skipped += u64::from(result.skipped);
            counts.drawn += u64::from(result.drawn);
            if let Some(bounds) = result.bounds() {
                (page.meta.bounds, page.dirty) = (bounds, true);
                self.tier.cache.changed(page.page);
            }
        }
        counts.drawn = if counts.updated == 0 { counts.drawn } else { 0 };
        Ok(counts)
    }

    fn release(&mut self, scene: &mut PagedScene, pinned: Vec<PinnedPage>) {
        self.tier.cache.release(scene, pinned);
    }
}

/// Prepares pinned pages for their pending events. If the events only clear the statistics of a page, the device does
/// that, and nothing is pending any more. All other pages are copied back, and give up their slots.
pub(super) fn before_events(
    cache: &mut SlotCache,
    scene: &PagedScene,
    renderer: &mut dyn Renderer,
    pinned: &mut [PinnedPage],
) -> Result<(), TrainError> {
    clear_statistics(cache, scene, renderer, pinned)?;
    let slots = &cache.slots;
    let behind = pinned.iter_mut().filter(|page| scene.rules.is_behind(&page.meta));
    let (newer, equal): (Vec<_>, Vec<_>) = behind.partition(|page| slots.is_dirty(page.page));
    let pages: Vec<PageNo> = newer.iter().chain(&equal).map(|page| page.page).collect();
    cache.copy_back(renderer, newer.into_iter())?;
    for page in pages {
        cache.fewest.lose(page);
        if cache.slots.state(page).is_some() {
            cache.slots.evict(page);
        }
    }
    Ok(())
}

/// Clears the statistics of pages in slots, where the events that they are behind in do nothing else.
fn clear_statistics(
    cache: &mut SlotCache,
    scene: &PagedScene,
    renderer: &mut dyn Renderer,
    pinned: &mut [PinnedPage],
) -> Result<(), TrainError> {
    let (pending, slots) = (scene.rules.pending(), &cache.slots);
    let only_clears =
        |page: &PinnedPage, facts: &PageFacts| pending.only_clears(page.meta.events_applied as usize, facts);
    let in_slot = |page: &PinnedPage| Some(SlotPage { slot: *slots.memory(page.page)?, layout: page.layout() });
    let (mut pages, mut in_slots) = (Vec::new(), Vec::new());
    for page in pinned.iter_mut().filter(|page| page.meta.rows > 0 && scene.rules.is_behind(&page.meta)) {
        if let Some(slot) = in_slot(page).filter(|_| only_clears(page, &best_facts(&page.meta))) {
            pages.push(page);
            in_slots.push(slot);
        }
    }
    if pages.is_empty() {
        return Ok(());
    }
    let _span = trace::span("clear statistics").with("pages", pages.len() as u64);
    let device = device_of(renderer)?;
    let Some(surveys) = none_if_out_of_memory(device.survey(&in_slots))? else { return Ok(()) };
    let of_pages = pages.into_iter().zip(in_slots).zip(&surveys);
    let (cleared, in_slots): (Vec<&mut PinnedPage>, Vec<SlotPage>) = of_pages
        .filter(|((page, _), survey)| only_clears(page, &facts(&page.meta, survey)))
        .map(|(page_in_slot, _)| page_in_slot)
        .unzip();
    if cleared.is_empty() || none_if_out_of_memory(device.clear_statistics(&in_slots))?.is_none() {
        return Ok(());
    }
    cache.traffic.cleared += cleared.len() as u64;
    for page in cleared {
        page.meta.events_applied = scene.events().len() as u32;
        page.dirty = true;
        if let Some((slot, _)) = cache.slots.pin(page.page, false) {
            cache.slots.unpin(page.page, slot, true);
        }
    }
    Ok(())
}
