//! The pages of a scene before any training, for planning: their bounds and how many bytes each takes on disk.
//!
//! Not here: the pages that training itself makes; they have the same rows (`scene::partition`), and bounds that also
//! count on what has not happened yet.

use crate::base::ids::PageId;
use crate::base::math::exp32;
use crate::scene::columns::Columns;
use crate::scene::page_layout::PageLayout;
use crate::scene::page_meta::{PageBounds, PageMeta};
use crate::scene::partition::{first_fill, partition};
use rayon::prelude::*;

/// Pages and their bytes, by page number.
#[derive(Debug, Clone, Default)]
pub struct FirstPages {
    /// Resident index.
    pub index: Vec<PageMeta>,
    /// Bytes on disk at the degree of the scene, without header and padding.
    pub bytes: Vec<u32>,
}

/// The pages of first Gaussians that have never moved. `is_growing` says that rounds of densification will add rows.
pub fn first_pages(columns: &Columns, page_rows: usize, is_growing: bool) -> FirstPages {
    let partition = partition(&columns.means, &columns.scales, first_fill(page_rows, is_growing));
    let lists: Vec<&[u32]> = partition.iter().collect();
    let index: Vec<PageMeta> = lists
        .par_iter()
        .enumerate()
        .map(|(page, rows)| PageMeta {
            id: PageId::initial(page as u32),
            rows: rows.len() as u32,
            sh_degree: columns.sh_degree,
            events_applied: 0,
            bounds: bounds_of(columns, rows),
        })
        .collect();
    let bytes = |meta: &PageMeta| PageLayout { rows: meta.rows as usize, sh_degree: meta.sh_degree }.bytes() as u32;
    FirstPages { bytes: index.iter().map(bytes).collect(), index }
}

fn bounds_of(columns: &Columns, rows: &[u32]) -> PageBounds {
    let mut bounds = PageBounds::EMPTY;
    for &row in rows {
        let at = row as usize * 3;
        for i in 0..3 {
            bounds.lo[i] = bounds.lo[i].min(columns.means[at + i]);
            bounds.hi[i] = bounds.hi[i].max(columns.means[at + i]);
            bounds.sigma_max = bounds.sigma_max.max(exp32(columns.scales[at + i]));
        }
    }
    bounds
}
