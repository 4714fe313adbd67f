//! Pages on a device as its shaders name them: structs of `shaders/shared/page.wgsl`.
//!
//! The layout of a payload is that of [`crate::scene::page_layout`], so a payload is copied between host and device as it
//! is. A payload lies in one slab, a buffer of at most one binding.

use crate::scene::columns::sh_n_width;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::PageBounds;

crate::wgsl_struct! {
    /// One page of a batch: `DevicePage` in `shaders/shared/page.wgsl`.
    pub struct DevicePage {
        pub rows: u32,
        /// The slab that holds the page.
        pub slab: u32,
        /// First word of the payload in the slab.
        pub base: u32,
        /// Floats per row of the higher SH bands.
        pub sh_n_width: u32,
        /// Number, in the batch, of the page's first row.
        pub first_row: u32,
        /// Number, in the batch, of the page's first listed row.
        pub first_listed: u32,
        /// Unused.
        pub pad: [u32; 2],
    }

    /// What an update did to a page, and its bounds: `PageResult` in `shaders/shared/page.wgsl`.
    pub struct PageResult {
        /// Rows that the optimizer rewrote.
        pub updated: u32,
        /// Rows left as they were because a gradient was not finite or too large.
        pub skipped: u32,
        /// Rows that were drawn.
        pub drawn: u32,
        /// Rows whose statistics changed.
        pub collected: u32,
        /// Lower corner of the box of the means, bits.
        pub low: [u32; 3],
        /// Upper corner, bits.
        pub high: [u32; 3],
        /// Largest standard deviation, bits.
        pub sigma_max: u32,
        /// Unused.
        pub pad: u32,
    }
}

crate::wgsl_struct! {
    /// What decides whether a round edits rows of a page: `PageSurvey` in `shaders/shared/page.wgsl`.
    pub struct PageSurvey {
        /// Largest mean growth score of a row, bits.
        pub largest_mean: u32,
        /// Lower bound of the opacities, before activation, for all later steps without an update; bits.
        pub lowest_opacity: u32,
        /// Least mean blending weight of the rows that are judged by it, bits; a number above 1e30 without such rows.
        pub least_weight: u32,
        /// Unused.
        pub pad: u32,
    }
}

impl DevicePage {
    /// A page whose payload begins at word `base` of a slab.
    pub fn new(layout: PageLayout, slab: u32, base: u32, first_row: u32) -> DevicePage {
        let (rows, sh_n_width) = (layout.rows as u32, sh_n_width(layout.sh_degree) as u32);
        DevicePage { rows, slab, base, sh_n_width, first_row, first_listed: 0, pad: [0; 2] }
    }
}

impl PageResult {
    /// The bounds of the page, if the update changed it.
    pub fn bounds(&self) -> Option<PageBounds> {
        let is_changed = self.updated > 0 || self.collected > 0;
        let [lo, hi] = [self.low, self.high].map(|corner| corner.map(f32::from_bits));
        is_changed.then(|| PageBounds { lo, hi, sigma_max: f32::from_bits(self.sigma_max) })
    }
}
