//! Pages of the training views: the view with the most pages, and the views that are cut into batches.
//!
//! Invariant: needs follow from the bounds of the pages alone; no page is read.

use crate::dataset::loader::Dataset;
use crate::paging::plan::batches;
use crate::scene::camera::Camera;
use crate::scene::page_meta::PageMeta;
use crate::schedule::visibility::visible_pages;

/// The training view that needs most pages, by page bounds. Held-out views do not count: evaluation visits their pages
/// in batches.
#[derive(Debug, Clone, PartialEq, Default)]
pub(crate) struct LargestView {
    /// Its index in `dataset.views`; `None` if no view sees a page.
    pub view: Option<usize>,
    pub name: String,
    /// Pages that it needs.
    pub pages: u64,
    /// Mean number of pages over the training views.
    pub mean: f64,
}

/// The [`LargestView`] of a scene with these pages.
pub(crate) fn largest_view(dataset: &Dataset, index: &[PageMeta]) -> LargestView {
    let (mut largest, mut sum, mut list) = (LargestView::default(), 0, Vec::new());
    let views = dataset.train_views();
    for &view in &views {
        visible_pages(index, &dataset.views[view].camera, &mut list);
        let pages = list.len() as u64;
        sum += pages;
        if pages > largest.pages {
            largest = LargestView { view: Some(view), name: dataset.views[view].name.clone(), pages, mean: 0.0 };
        }
    }
    LargestView { mean: sum as f64 / views.len().max(1) as f64, ..largest }
}

/// The training views that need more than one batch, and the most batches of one of them.
pub(crate) fn cut_views(dataset: &Dataset, index: &[PageMeta], frames: u64, pages_most: usize) -> (usize, usize) {
    let mut list = Vec::new();
    let pages = dataset.train_views().into_iter().map(|view| {
        visible_pages(index, &dataset.views[view].camera, &mut list);
        list.len()
    });
    batches::cut_views(pages, frames as usize, pages_most)
}

pub(crate) fn train_cameras(dataset: &Dataset) -> Vec<Camera> {
    dataset.train_views().iter().map(|&v| dataset.views[v].camera).collect()
}
