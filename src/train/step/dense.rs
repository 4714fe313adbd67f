//! The dense optimizer: updates and stores every row after every step. For comparison with deferred Adam, since each
//! step costs the whole scene in memory and on the drive.
//!
//! Invariants: 1. a page applies an event at the next step, on values of the event's own step, so rows and decisions
//! equal those of the deferred run up to roundings; 2. at most [`PAGES_PER_BATCH`] pages and half of the frames are
//! pinned at once.

use super::pages::{PAGES_PER_BATCH, PagedScene};
use crate::base::ids::PageNo;
use crate::scene::rows::RowsNow;
use crate::train::error::TrainError;
use rayon::prelude::*;

/// Stores every row as evaluated after `now` steps, and renews the bounds of every page.
///
/// # Errors
/// Pages could not be pinned, or no frame was free for a split.
pub(crate) fn settle_all(scene: &mut PagedScene, now: u32) -> Result<(), TrainError> {
    let index = scene.pager.index();
    let mut pages: Vec<PageNo> = (0..index.len() as u32).map(PageNo).collect();
    pages.retain(|p| index[p.index()].rows > 0);
    pages.sort_unstable_by_key(|p| index[p.index()].id);
    // The other half of the frames is for pages that split.
    let batch = PAGES_PER_BATCH.min(scene.pager.frames_max() / 2).max(1);
    for batch in pages.chunks(batch) {
        let mut pinned = scene.pager.acquire_in_step(batch)?;
        let applied = scene.apply_pending(&mut pinned);
        if applied.is_ok() {
            let (rules, at) = (&scene.rules, scene.rules.adam.at(now));
            pinned.par_iter_mut().for_each(|page| {
                let mut rows = page.rows_mut(0);
                (0..rows.rows()).for_each(|row| at.settle_row(&mut rows, row));
                page.dirty = true;
                page.meta.bounds = rules.bounds(&page.rows(0));
            });
        }
        scene.pager.release(pinned);
        applied?;
    }
    Ok(())
}
