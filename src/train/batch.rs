//! Gather and update: the two functions through which a step reads and writes the rows of a batch of pinned pages.
//!
//! Between gather and update, a step uses the [`WorkingSet`] alone. A backend that keeps rows on a device replaces
//! these two functions and the renderer.
//!
//! Invariants: between [`gather`] and `update`, the pinned rows and the values of the working set stay unchanged,
//! because the update starts from the gathered values.

use super::catch_up;
use super::pages::{PageRules, PagedScene, row_tables};
use super::update::{StepGradients, update_pages};
use super::working_set::WorkingSet;
use crate::optim::deferred::StepCounts;
use crate::paging::pinned::PinnedPage;
use crate::scene::camera::Camera;

/// Culls the rows of the pages for `camera` and evaluates the visible rows at 0-based `step`. The pages must have
/// applied all events.
pub fn gather(rules: &PageRules, pages: &[PinnedPage], step: u32, camera: &Camera, working: &mut WorkingSet) {
    let tables = row_tables(pages);
    let WorkingSet { row_from_working, columns, .. } = working;
    catch_up::visible_rows(&tables, &rules.adam, step, camera, row_from_working);
    catch_up::gather(&tables, rules.sh_degree(), &rules.adam, step, row_from_working, columns);
}

/// As [`gather`], of the rows that `working` lists: they were culled at the same step before.
pub(super) fn gather_listed(rules: &PageRules, pages: &[PinnedPage], step: u32, working: &mut WorkingSet) {
    let WorkingSet { row_from_working, columns, .. } = working;
    catch_up::gather(&row_tables(pages), rules.sh_degree(), &rules.adam, step, row_from_working, columns);
}

/// Applies the gradients of the working set to the pages that [`gather`] read at `step`: optimizer, bounds and, if
/// `collects`, densification statistics.
pub(super) fn update(
    scene: &mut PagedScene,
    pages: &mut [PinnedPage],
    step: u32,
    camera: &Camera,
    working: &WorkingSet,
    collects: bool,
) -> StepCounts {
    let WorkingSet { row_from_working, columns, gradients, .. } = working;
    let size = [camera.width, camera.height];
    update_pages(scene, pages, &StepGradients { step, rows: row_from_working, columns, gradients, size }, collects)
}
