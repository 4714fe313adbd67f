//! The rows of a page in the words of its payload on a device: the twin of `shaders/shared/page.wgsl`.
//!
//! The layout is that of [`crate::scene::page_layout`], so a payload is copied between host and device as it is. A
//! payload lies in one slab, a buffer of at most one binding.
//!
//! Invariant: places are functions of (rows, degree) alone.

use crate::scene::columns::{Column, sh_n_width};
use crate::scene::page_layout::{PageLayout, TABLE_ALIGNMENT};
use crate::scene::page_meta::PageBounds;

crate::wgsl_struct! {
    /// One page of a batch: `DevicePage` in `shaders/shared/page.wgsl`.
    pub struct DevicePage {
        /// Rows.
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
        /// Unused.
        pub pad: [u32; 2],
    }
}

/// The three tables of a column.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Table {
    /// Values.
    Values,
    /// First moments.
    ExpAvg,
    /// Second moments.
    ExpAvgSq,
}

impl DevicePage {
    /// A page whose payload begins at word `base` of a slab.
    pub fn new(layout: PageLayout, slab: u32, base: u32, first_row: u32) -> DevicePage {
        let (rows, sh_n_width) = (layout.rows as u32, sh_n_width(layout.sh_degree) as u32);
        DevicePage { rows, slab, base, sh_n_width, first_row, first_listed: 0, pad: [0; 2] }
    }

    /// Floats per row of a column.
    pub fn width(&self, column: Column) -> usize {
        if column == Column::ShN { self.sh_n_width as usize } else { column.width(0) }
    }

    fn padded(&self, words_per_row: usize) -> usize {
        (self.rows as usize * words_per_row).next_multiple_of(TABLE_ALIGNMENT / 4)
    }

    /// Word of the number of steps that a row contains.
    pub fn stamp_at(&self, row: usize) -> usize {
        self.base as usize + self.padded(2) + row
    }

    /// Word of a row's sum of growth scores.
    pub fn grad2d_at(&self, row: usize) -> usize {
        self.stamp_at(row) + self.padded(1)
    }

    /// Word of a row's number of views.
    pub fn count_at(&self, row: usize) -> usize {
        self.grad2d_at(row) + self.padded(1)
    }

    /// First word of a row in a table of a column.
    pub fn row_at(&self, column: Column, table: Table, row: usize) -> usize {
        let before = Column::ALL.iter().take_while(|c| **c != column).map(|c| 3 * self.padded(self.width(*c)));
        let first = self.count_at(0) + self.padded(1) + before.sum::<usize>();
        first + table as usize * self.padded(self.width(column)) + row * self.width(column)
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::columns::Columns;
    use crate::scene::page_layout::{capacity_bytes, write_page};
    use crate::scene::state::SceneState;

    #[test]
    fn words_lie_where_the_layout_puts_them() {
        for (rows, sh_degree) in [(1, 0), (7, 1), (33, 2), (1000, 3)] {
            let mut state = SceneState::from_columns(Columns::zeros(rows, sh_degree));
            let mut next = 0.0f32;
            for table in [&mut state.columns, &mut state.exp_avg, &mut state.exp_avg_sq] {
                for column in Column::ALL {
                    table.column_mut(column).iter_mut().for_each(|x| (*x, next) = (next, next + 1.0));
                }
            }
            for row in 0..rows {
                (state.stamp[row], state.grad2d[row], state.count[row]) =
                    (row as u32, row as f32 + 0.5, 9 + row as u32);
            }
            let mut words = vec![0u64; capacity_bytes(rows, sh_degree).div_ceil(8)];
            let layout = write_page(&state, bytemuck::cast_slice_mut(&mut words));
            // The page lies behind 64 words of another.
            let mut slab = vec![u32::MAX; 64];
            slab.extend_from_slice(bytemuck::cast_slice(&words));
            let page = DevicePage::new(layout, 0, 64, 0);
            for row in [0, rows / 2, rows - 1] {
                assert_eq!(slab[page.stamp_at(row)], row as u32);
                assert_eq!(f32::from_bits(slab[page.grad2d_at(row)]), row as f32 + 0.5);
                assert_eq!(slab[page.count_at(row)], 9 + row as u32);
                for column in Column::ALL {
                    let tables = [&state.columns, &state.exp_avg, &state.exp_avg_sq];
                    for (table, of) in [Table::Values, Table::ExpAvg, Table::ExpAvgSq].into_iter().zip(tables) {
                        let at = page.row_at(column, table, row);
                        let got: Vec<f32> =
                            slab[at..at + page.width(column)].iter().map(|w| f32::from_bits(*w)).collect();
                        assert_eq!(got, of.row(column, row), "{column:?} {table:?} row {row} of {rows}");
                    }
                }
            }
        }
    }
}
