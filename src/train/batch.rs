//! The two ends of a step, where it reads and writes the rows of a batch of pinned pages: gather and update.
//!
//! Between them the step works on the [`WorkingSet`] alone. A backend that keeps rows on a device replaces these two
//! functions together with the renderer.
//!
//! Invariants: from [`gather`] to `update` nobody changes the pinned rows or the values of the working set, since the
//! update starts from these values.

use super::catch_up;
use super::pages::{PageRules, PagedScene, numbered};
use super::update::{StepGradients, update_pages};
use super::working_set::WorkingSet;
use crate::optim::deferred::StepCounts;
use crate::paging::pinned::PinnedPage;
use crate::scene::camera::Camera;

/// Culls the rows of the pages, which are up to date with all events, and evaluates at 0-based `step` those that
/// `camera` may draw.
pub fn gather(rules: &PageRules, pages: &[PinnedPage], step: u32, camera: &Camera, working: &mut WorkingSet) {
    let tables = numbered(pages);
    let WorkingSet { row_from_working, columns, .. } = working;
    catch_up::visible_rows(&tables, &rules.adam, step, camera, row_from_working);
    catch_up::gather(&tables, rules.sh_degree(), &rules.adam, step, row_from_working, columns);
}

/// As [`gather`], of the rows that `working` lists: they were culled at the same step before.
pub(super) fn gather_listed(rules: &PageRules, pages: &[PinnedPage], step: u32, working: &mut WorkingSet) {
    let WorkingSet { row_from_working, columns, .. } = working;
    catch_up::gather(&numbered(pages), rules.sh_degree(), &rules.adam, step, row_from_working, columns);
}

/// Applies the gradients of the working set to the pages that its rows were gathered from at `step`: optimizer, bounds,
/// and the statistics of densification if `collects`.
pub(super) fn update(
    scene: &mut PagedScene,
    pages: &mut [PinnedPage],
    step: u32,
    camera: &Camera,
    working: &WorkingSet,
    collects: bool,
) -> StepCounts {
    let WorkingSet { row_from_working, columns, gradients } = working;
    let size = [camera.width, camera.height];
    update_pages(scene, pages, &StepGradients { step, rows: row_from_working, columns, gradients, size }, collects)
}
