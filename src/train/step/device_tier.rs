//! The pages of a run on a device ([`DeviceTier`]): the cache of their slots, and the steps in flight on them.
//!
//! Invariant: commits, evaluations and exports see pages only after [`DeviceTier::drain`].

use super::device_flights::Flights;
use super::device_slots::{SlotCache, SlotTraffic, device_of, slots_in};
use super::pages::PagedScene;
use crate::optim::one_step::OneStep;
use crate::page::format::slot_header::HEADER_BYTES;
use crate::render::pages::PageRules;
use crate::render::{RenderError, Renderer};
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
        let splits = *scene.rules.splits();
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
        let mut tier = DeviceTier { cache: SlotCache::new(slots_most as usize), flights };
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
