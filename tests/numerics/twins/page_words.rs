//! The rows of a page in the words of its payload on a device: the twin of `shaders/shared/page.wgsl`.
//!
//! Invariant: places are functions of (rows, degree) alone.

use gsscale::kernels::uniforms::DevicePage;
use gsscale::scene::columns::{Column, Columns};
use gsscale::scene::page_layout::{TABLE_ALIGNMENT, capacity_bytes, write_page};
use gsscale::scene::state::SceneState;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Table {
    Values,
    ExpAvg,
    ExpAvgSq,
}

/// Words of a table with so many words a row.
fn padded(page: &DevicePage, words_per_row: usize) -> usize {
    (page.rows as usize * words_per_row).next_multiple_of(TABLE_ALIGNMENT / 4)
}

/// Floats per row of a column.
fn width(page: &DevicePage, column: Column) -> usize {
    if column == Column::ShN { page.sh_n_width as usize } else { column.width(0) }
}

/// Word of the number of steps that a row contains.
pub fn stamp_at(page: &DevicePage, row: usize) -> usize {
    page.base as usize + padded(page, 2) + row
}

/// Word of a row's sum of growth scores.
pub fn grad2d_at(page: &DevicePage, row: usize) -> usize {
    stamp_at(page, row) + padded(page, 1)
}

/// Word of a row's number of views.
pub fn count_at(page: &DevicePage, row: usize) -> usize {
    grad2d_at(page, row) + padded(page, 1)
}

pub fn row_at(page: &DevicePage, column: Column, table: Table, row: usize) -> usize {
    let before = Column::ALL.iter().take_while(|c| **c != column).map(|c| 3 * padded(page, width(page, *c)));
    let first = count_at(page, 0) + padded(page, 1) + before.sum::<usize>();
    first + table as usize * padded(page, width(page, column)) + row * width(page, column)
}

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
            (state.stamp[row], state.grad2d[row], state.count[row]) = (row as u32, row as f32 + 0.5, 9 + row as u32);
        }
        let mut words = vec![0u64; capacity_bytes(rows, sh_degree).div_ceil(8)];
        let layout = write_page(&state, bytemuck::cast_slice_mut(&mut words));
        // The page lies behind 64 words of another.
        let mut slab = vec![u32::MAX; 64];
        slab.extend_from_slice(bytemuck::cast_slice(&words));
        let page = DevicePage::new(layout, 0, 64, 0);
        for row in [0, rows / 2, rows - 1] {
            assert_eq!(slab[stamp_at(&page, row)], row as u32);
            assert_eq!(f32::from_bits(slab[grad2d_at(&page, row)]), row as f32 + 0.5);
            assert_eq!(slab[count_at(&page, row)], 9 + row as u32);
            for column in Column::ALL {
                let tables = [&state.columns, &state.exp_avg, &state.exp_avg_sq];
                for (table, of) in [Table::Values, Table::ExpAvg, Table::ExpAvgSq].into_iter().zip(tables) {
                    let at = row_at(&page, column, table, row);
                    let got: Vec<f32> =
                        slab[at..at + width(&page, column)].iter().map(|w| f32::from_bits(*w)).collect();
                    assert_eq!(got, of.row(column, row), "{column:?} {table:?} row {row} of {rows}");
                }
            }
        }
    }
}
