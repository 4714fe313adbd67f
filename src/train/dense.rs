//! The dense optimizer: after every step every row is brought to now and stored, seen or not.
//!
//! The slow way round that deferred Adam spares: each step costs the whole scene, in memory and on the drive. It is here
//! to be compared with.
//!
//! Invariants: 1. events reach pages at the next step, and each row at the values of the event's own step, so rows and
//! decisions are those of the deferred run up to roundings; 2. no more than [`PAGES_PER_BATCH`] pages, and half of the
//! frames, are pinned at once.

use super::error::TrainError;
use super::pages::PagedScene;
use crate::base::ids::PageNo;
use crate::scene::rows::RowsNow;
use rayon::prelude::*;

/// Pages that are settled together.
const PAGES_PER_BATCH: usize = 32;

/// Stores every row as it is after `now` steps, and renews the bounds of its page.
///
/// # Errors
/// Pages could not be had, or no frame for the half of one that splits.
pub(super) fn settle_all(scene: &mut PagedScene, now: u32) -> Result<(), TrainError> {
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
