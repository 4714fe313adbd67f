//! pages.json: the pages of a scene along its shortest axis, for the map in the report.

use crate::base::error::{InputError, InputResult};
use crate::base::ids::PageNo;
use crate::base::whole_file::write_whole;
use crate::dataset::loader::Dataset;
use crate::report::page_map::PageTile;
use crate::scene::page_meta::PageBounds;
use crate::train::state::trainer::Trainer;
use std::path::Path;

/// Writes the page map of a run as it is now.
/// Errors: the folder cannot be written.
pub fn write_page_map(path: &Path, dataset: &Dataset, trainer: &Trainer) -> InputResult<()> {
    let text = serde_json::to_vec(&page_tiles(dataset, trainer))
        .map_err(|e| InputError::new(path, format!("writing failed: {e}"), "report this as a bug"))?;
    write_whole(path, &text)
}

/// One tile per page that has rows, with the number of training views that see it by its bounds.
fn page_tiles(dataset: &Dataset, trainer: &Trainer) -> Vec<PageTile> {
    let pager = &trainer.scene.pager;
    let index = pager.index();
    let mut views = vec![0u32; index.len()];
    for view in dataset.train_views() {
        for page in pager.pages_of_view(&dataset.views[view].camera) {
            views[page.index()] += 1;
        }
    }
    let seen: Vec<usize> = (0..index.len()).filter(|&i| is_finite(&index[i].bounds)).collect();
    // The view from above is along the axis in which page centres differ least.
    let centre = |i: usize, axis: usize| f64::from(index[i].bounds.lo[axis]) + f64::from(index[i].bounds.hi[axis]);
    let spread = |axis: usize| {
        let mean = seen.iter().map(|&i| centre(i, axis)).sum::<f64>() / seen.len() as f64;
        seen.iter().map(|&i| (centre(i, axis) - mean).abs()).sum::<f64>()
    };
    let down = (0..3).min_by(|&a, &b| spread(a).total_cmp(&spread(b))).unwrap_or(2);
    let [x, y] = [(down + 1) % 3, (down + 2) % 3];
    let tile = |&i: &usize| PageTile {
        lo: [index[i].bounds.lo[x], index[i].bounds.lo[y]],
        hi: [index[i].bounds.hi[x], index[i].bounds.hi[y]],
        rows: index[i].rows,
        views: views[i],
        resident: pager.is_in_memory(PageNo(i as u32)),
    };
    seen.iter().map(tile).collect()
}

fn is_finite(bounds: &PageBounds) -> bool {
    bounds.lo.iter().chain(&bounds.hi).all(|x| x.is_finite())
}
