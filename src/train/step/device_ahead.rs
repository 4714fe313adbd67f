//! Prefetch for the next step while the device computes this one: payloads that the next view needs and the device lacks go up, into
//! slots of pages that leave behind this step's work (`device_leaving`).
//!
//! ```text
//! host    picture, loss, gradients submitted │ load_ahead: unused pages leave │ wait │ update submitted │ load_ahead: any page leaves │ wait
//! device  ...................................│ copies ........................│      │ update ..........│ copies ....................│
//! ```
//!
//! A step that is recorded without waiting has one such place, behind its update, and waits nowhere. So has a step of several batches, whose
//! view needs all slots until its last update.
//!
//! The list of the next view's pages is computed from the bounds before this step, so it may lack pages or have superfluous ones. The
//! pages that a step touches follow from the bounds at that step ([`DeviceTier::load`]): a missing page is copied then, and a superfluous
//! page changes no bit.
//!
//! Not here: copies for the present step (`device_loads`).
//!
//! Invariants: 1. no page of the next view is evicted; 2. a copy for which there is no memory or no slot is left to the next step.

use super::device_leaving::{Coming, Leaves};
use super::device_tier::DeviceTier;
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::render::Renderer;
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
        let coming: Vec<Coming<'_>> = missing
            .filter_map(|page| {
                let payload = scene.pager.payload(page)?.get(..layout_ahead(scene, page)?.bytes())?;
                Some(Coming { page, next_use: step, payload })
            })
            .collect();
        self.load_evicting(scene, renderer, (step.saturating_sub(1), leaves, true), &coming, of_view).map(|_| ())
    }
}
