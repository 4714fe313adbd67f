//! Gather and update on a device that holds the pages ([`DeviceTier`]). A step uploads the payloads of the pages that the
//! device lacks and one table of the optimizer, and downloads some 50 bytes a page.
//!
//! Not here: which page lies in which slot (`device_tier`), steps that are recorded without waiting (`device_flights`), the stages
//! (`render`).
//!
//! Invariant: an update that failed is [`TrainError::Torn`]: pages that exist on the device alone may be changed.

use super::batch::{AtStep, RowBackend, UpdateCounts};
use super::device_events::before_events;
use super::device_slots::{Leaves, device_of};
use super::device_tier::DeviceTier;
use super::pages::PagedScene;
use super::working_set::WorkingSet;
use crate::base::ids::PageNo;
use crate::kernels::uniforms::PageResult;
use crate::paging::pinned::PinnedPage;
use crate::render::Renderer;
use crate::scene::camera::Camera;
use crate::train::error::TrainError;

/// The part of the slots that a batch of a view of several batches leaves to the next step.
const SLOTS_AHEAD_SHARE: usize = 4;

/// Rows on the device of a renderer.
pub struct DeviceRows<'a> {
    tier: &'a mut DeviceTier,
    renderer: &'a mut dyn Renderer,
    step: u32,
    /// The camera of the next step.
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

    /// A view that needs several batches anyway leaves slots free for pages of the next step: smaller batches copy no byte more.
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
        self.tier.cache.pin(scene, self.renderer, (pages, in_flight), |scene, others| match is_again {
            true => scene.pager.pin_batch_again(step, others),
            false => scene.pager.pin_batch(step, others),
        })
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
        let results = results.map_err(|error| TrainError::Torn { source: Box::new(error) })?;
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
