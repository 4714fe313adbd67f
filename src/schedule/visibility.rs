//! Visibility: which pages a camera needs, by the bounds of the pages.
//!
//! Not here: the half-spaces and why they are conservative (`scene::frustum`).
//!
//! Invariants: 1. a page is listed unless its whole box lies outside of one half-space, so no row that the row test
//! draws is in a page that is not listed; 2. pages without rows are never listed; 3. lists ascend and are the same on
//! every instruction path; 4. the list is the only allocation that grows with the scene.

use crate::base::ids::PageNo;
use crate::base::simd::{Kernel, LANES, SimdPath, dispatch};
use crate::scene::camera::Camera;
use crate::scene::frustum::{Frustum, PagePlane, PagePlanes, larger};
use crate::scene::page_meta::{PageBounds, PageMeta};
use rayon::prelude::*;

/// Views that are listed at a time.
const VIEWS_PER_PART: usize = 64;

/// Lists the pages of `index` that `camera` needs, ascending. The list is cleared first.
pub fn visible_pages(index: &[PageMeta], camera: &Camera, out: &mut Vec<PageNo>) {
    let planes = Frustum::new(camera).planes();
    out.clear();
    out.resize(index.len(), PageNo(0));
    let found = dispatch(SimdPath::best(), ListPages { planes: &planes, index, out });
    out.truncate(found);
}

/// The pages of many views: lists one after the other.
#[derive(Debug, Clone, Default)]
pub struct ViewPages {
    pages: Vec<PageNo>,
    /// Where the list of each view ends.
    ends: Vec<usize>,
}

impl ViewPages {
    /// The pages that each of `cameras` needs.
    pub fn new(index: &[PageMeta], cameras: &[Camera]) -> ViewPages {
        // In parts, so that no more than a part is held twice.
        let mut all = ViewPages::default();
        for first in (0..cameras.len()).step_by(VIEWS_PER_PART) {
            let part = first..cameras.len().min(first + VIEWS_PER_PART);
            let lists: Vec<Vec<PageNo>> = cameras[part]
                .par_iter()
                .map(|camera| {
                    let mut list = Vec::new();
                    visible_pages(index, camera, &mut list);
                    list
                })
                .collect();
            lists.iter().for_each(|list| all.push(list));
        }
        all
    }

    /// Adds the list of one more view.
    pub fn push(&mut self, pages: &[PageNo]) {
        self.pages.extend_from_slice(pages);
        self.ends.push(self.pages.len());
    }

    pub fn views(&self) -> usize {
        self.ends.len()
    }

    /// The pages of a view, ascending.
    pub fn of(&self, view: usize) -> &[PageNo] {
        let start = if view == 0 { 0 } else { self.ends[view - 1] };
        &self.pages[start..self.ends[view]]
    }

    /// Most pages of a view.
    pub fn most(&self) -> usize {
        (0..self.views()).map(|view| self.of(view).len()).max().unwrap_or(0)
    }

    /// Pages of all views together, each as often as it is needed.
    pub fn total(&self) -> usize {
        self.pages.len()
    }
}

struct ListPages<'a> {
    planes: &'a PagePlanes,
    index: &'a [PageMeta],
    out: &'a mut [PageNo],
}

impl Kernel for ListPages<'_> {
    type Out = usize;
    #[inline(always)]
    fn run<const FMA: bool>(self) -> usize {
        let ListPages { planes, index, out } = self;
        let mut found = 0;
        let whole = index.len() / LANES * LANES;
        for first in (0..whole).step_by(LANES) {
            let needed = needed_lanes(planes, &index[first..first + LANES]);
            for (lane, &needed) in needed.iter().enumerate() {
                // Written always, kept when counted: no branch to mispredict.
                out[found] = PageNo((first + lane) as u32);
                found += usize::from(needed);
            }
        }
        for (page, meta) in index.iter().enumerate().skip(whole) {
            out[found] = PageNo(page as u32);
            found += usize::from(planes.may_intersect(&meta.bounds));
        }
        found
    }
}

/// [`PagePlanes::may_intersect`] of [`LANES`] pages at once.
#[inline(always)]
fn needed_lanes(planes: &PagePlanes, pages: &[PageMeta]) -> [bool; LANES] {
    let (mut lo, mut hi) = ([[0.0f32; LANES]; 3], [[0.0f32; LANES]; 3]);
    let (mut sigma, mut size) = ([0.0f32; LANES], [planes.translation; LANES]);
    let mut needed = [false; LANES];
    for l in 0..LANES {
        let PageBounds { lo: low, hi: high, sigma_max } = &pages[l].bounds;
        sigma[l] = *sigma_max;
        needed[l] = !pages[l].bounds.is_empty();
        for i in 0..3 {
            (lo[i][l], hi[i][l]) = (low[i], high[i]);
        }
    }
    for i in 0..3 {
        for l in 0..LANES {
            size[l] += larger(lo[i][l].abs(), hi[i][l].abs());
        }
    }
    for plane in &planes.planes {
        let PagePlane { normal, offset, reach, slack } = *plane;
        let x = if normal[0] > 0.0 { &lo[0] } else { &hi[0] };
        let y = if normal[1] > 0.0 { &lo[1] } else { &hi[1] };
        let z = if normal[2] > 0.0 { &lo[2] } else { &hi[2] };
        for l in 0..LANES {
            let nearest = offset + normal[0] * x[l] + normal[1] * y[l] + normal[2] * z[l];
            let outside = nearest > reach * sigma[l] + slack * size[l];
            needed[l] &= !outside;
        }
    }
    needed
}
