//! Prefetch for the next step while the device computes this one: uploads payloads that the next view needs and the device
//! lacks, and reads back the pages that are evicted for them.
//!
//! ```text
//! host    rows in │ begin_ahead: read-backs begin │ loss, gradients begin │ load_ahead: frames filled, payloads up │ wait, update
//! device          │ picture ....................... loss .................. gradients .............................│ update
//! ```
//!
//! The list of the next view's pages is computed from the bounds before this step, so it may lack pages or have superfluous ones. The
//! pages that a step touches follow from the bounds at that step ([`DeviceTier::load`]): a missing page is copied then, and a superfluous
//! page changes no bit.
//!
//! Not here: copies for the present step (`device_tier`).
//!
//! Invariants: 1. no page of this view or of the next one is evicted; 2. a copy for which there is no memory or no slot is
//! left to the next step; 3. a page that is read back is in [`DeviceTier::leaving`] alone, neither held nor released, until
//! its frame is filled.

use super::device_tier::{DeviceTier, device_of};
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::render::Renderer;
use crate::render::pages::DeviceSlot;
use crate::scene::camera::Camera;
use crate::scene::page_layout::PageLayout;
use crate::train::error::TrainError;

/// Layout of a page's payload as its frame holds it; `None` for a page whose payload must not be copied ahead: it has no rows, no frame,
/// or events to apply first.
fn layout_ahead(scene: &PagedScene, page: PageNo) -> Option<PageLayout> {
    let meta = scene.pager.index().get(page.index())?;
    let is_ready = meta.rows > 0 && !scene.rules.is_behind(meta) && scene.pager.payload(page).is_some();
    is_ready.then_some(PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree })
}

impl DeviceTier {
    /// Chooses the pages that 0-based `step`, the next one, needs for `camera` and the device lacks, and begins to read
    /// back the pages that are evicted for them. Does not wait.
    pub(super) fn begin_ahead(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        (step, camera): (u32, &Camera),
    ) -> Result<(), TrainError> {
        let of_view = self.pages_behind(scene, camera, step.saturating_sub(1));
        let is_missing = |page: &PageNo| self.slots.state(*page).is_none() && layout_ahead(scene, *page).is_some();
        self.coming = of_view.iter().copied().filter(is_missing).collect();
        if self.slots.free_frames() >= self.coming.len() {
            return Ok(());
        }
        self.plan_uses(scene);
        of_view.iter().for_each(|page| self.slots.set_next_use(*page, step));
        let mut slots: Vec<(PageNo, DeviceSlot)> = Vec::new();
        while self.slots.free_frames() + slots.len() < self.coming.len() {
            let Some(victim) = self.slots.victim().filter(|victim| victim.next_use > step) else { break };
            match victim.dirty {
                true => slots.push((victim.page, self.slots.begin_write(victim.page))),
                false => self.slots.evict(victim.page),
            }
        }
        let bytes = |page: &PageNo| self.held.get(page).map_or(0, |page| page.layout().bytes());
        let reads: Vec<(DeviceSlot, usize)> = slots.iter().map(|(page, slot)| (*slot, bytes(page))).collect();
        let begun = device_of(renderer).and_then(|device| Ok(device.begin_reads(&reads)?));
        for (page, slot) in slots.drain(*begun.as_ref().unwrap_or(&0)..) {
            self.slots.finish_write(page, slot, false);
        }
        self.leaving.extend(slots.into_iter().filter_map(|(page, slot)| Some((self.held.remove(&page)?, slot))));
        begun.map(|_| ())
    }

    /// Fills the frames of the pages that make room, and copies payloads of the next step into their slots. The device may still be at
    /// work on the pages of this step.
    pub(super) fn load_ahead(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
        step: u32,
    ) -> Result<(), TrainError> {
        self.finish_leaving(scene, renderer)?;
        let mut copies = Vec::new();
        let mut pages = Vec::new();
        for page in std::mem::take(&mut self.coming) {
            let (Some(layout), Some(payload)) = (layout_ahead(scene, page), scene.pager.payload(page)) else {
                continue;
            };
            let Some(slot) = self.new_slot(page, step) else { break };
            pages.push(page);
            copies.push((slot, &payload[..layout.bytes()]));
        }
        if copies.is_empty() {
            return Ok(());
        }
        let bytes: u64 = copies.iter().map(|(_, payload)| payload.len() as u64).sum();
        let _span = trace::span("load ahead").with("pages", pages.len() as u64).with("bytes", bytes);
        let written = device_of(renderer).and_then(|device| Ok(device.write_slots(&copies)?));
        if let Err(error) = written {
            pages.into_iter().for_each(|page| self.slots.evict(page));
            return Err(error);
        }
        self.traffic.loads += pages.len() as u64;
        self.traffic.loads_ahead += pages.len() as u64;
        self.traffic.bytes_loaded += bytes;
        Ok(())
    }

    /// Waits for the copies back that [`DeviceTier::begin_ahead`] began, unpins their pages, and empties their slots.
    pub(super) fn finish_leaving(
        &mut self,
        scene: &mut PagedScene,
        renderer: &mut dyn Renderer,
    ) -> Result<(), TrainError> {
        if self.leaving.is_empty() {
            return Ok(());
        }
        let mut leaving = std::mem::take(&mut self.leaving);
        let copied = self.fill_frames(leaving.iter_mut().map(|(page, slot)| (page, *slot)), |copies| {
            Ok(device_of(renderer)?.finish_reads(copies)?)
        });
        match copied {
            Ok(()) => {
                leaving.iter().for_each(|(page, _)| self.slots.evict(page.page));
                scene.pager.release(leaving.into_iter().map(|(page, _)| page).collect());
                Ok(())
            }
            Err(error) => {
                self.held.extend(leaving.into_iter().map(|(page, _)| (page.page, page)));
                Err(error)
            }
        }
    }
}
