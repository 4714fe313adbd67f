//! Events on pages that lie on a device. The host applies an event: the page is drained, edited and loaded again. Only a round that edits
//! no row of a page, and so does no more than to clear its statistics, is left to the device: the page stays where it is.
//!
//! ```text
//! pages behind in events │ survey: largest score, lowest opacity, least weight: 16 bytes a page │ ── no row is edited ──> cleared on the device
//!                                                                                 └─ a row may be ──────> drained, edited, loaded
//! ```
//!
//! A cap that is reached makes most rounds such rounds. A survey is conservative; a page for which it is not sure goes to the host, which
//! decides row by row. Both ways leave the same bytes, so the result does not depend on which pages have slots. That includes
//! the bounds of the page: clearing statistics keeps them, on the host as well (`PageRules`).
//!
//! Not here: which rounds edit what (`densify::replay`), the stages of the device (`render`).
//!
//! Invariants: 1. a page is cleared by the device only if the host would have changed nothing else; 2. where the device has no memory for
//! a survey, the host applies the events.

use super::device_slots::{SlotCache, best_facts, device_of, facts};
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::base::trace;
use crate::densify::replay::PageFacts;
use crate::paging::pinned::PinnedPage;
use crate::render::pages::SlotPage;
use crate::render::{Renderer, none_if_out_of_memory};
use crate::train::error::TrainError;

/// Prepares pinned pages for the events that they are behind in: the device clears the statistics of those of which nothing else
/// changes, and they are behind no more; the others are copied back, and their slots given up.
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
