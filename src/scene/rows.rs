//! Views of rows: borrowed by operations on rows, whether the rows are in one table in memory or in a page.
//!
//! Invariants: 1. every slice of a view covers the same rows; 2. row numbers in a view's methods count from the view's
//! first row; 3. splitting a view gives disjoint views, so rows can be processed in parallel without locks; 4. a
//! [`RowBlock`] holds one whole row in a fixed order of lanes, whatever the degree; unused lanes are zero.

use super::columns::{Column, ColumnSet, Columns};
use super::log_scales::LogScaleRange;
use super::sightings::views;

/// Floats of a [`RowBlock`]: 16 for the narrow columns, those of fixed width (14 used), 48 for `sh_n` (45 used at
/// degree 3).
pub const BLOCK_LANES: usize = 64;
pub const SH_N_LANE: usize = 16;

/// One row of any table with the shape of the columns: means 0..3, opacity 3, quats 4..8, scales 8..11, sh0 12..15,
/// `sh_n` from [`SH_N_LANE`]. No narrow column crosses a multiple of four lanes, so that a compiler can assemble the
/// narrow columns from quarters of a vector, without going through memory.
pub type RowBlock = [f32; BLOCK_LANES];

/// First lane of a column in a [`RowBlock`].
pub const fn first_lane(column: Column) -> usize {
    match column {
        Column::Means => 0,
        Column::Opacities => 3,
        Column::Quats => 4,
        Column::Scales => 8,
        Column::Sh0 => 12,
        Column::ShN => SH_N_LANE,
    }
}

pub fn scales_of(block: &mut RowBlock) -> &mut [f32] {
    let first = first_lane(Column::Scales);
    &mut block[first..first + 3]
}

/// Shared view of the columns of some rows; each slice is `[rows][width]`.
pub type ColumnsRef<'a> = ColumnSet<&'a [f32]>;

/// Exclusive view of the columns of some rows; each slice is `[rows][width]`.
pub type ColumnsMut<'a> = ColumnSet<&'a mut [f32]>;

impl Columns {
    pub fn view(&self) -> ColumnsRef<'_> {
        let Columns { sh_degree, means, quats, scales, opacities, sh0, sh_n } = self;
        ColumnSet { sh_degree: *sh_degree, means, quats, scales, opacities, sh0, sh_n }
    }

    pub fn view_mut(&mut self) -> ColumnsMut<'_> {
        self.each_mut().map_columns(|_, values| values.as_mut_slice())
    }
}

impl<'a> ColumnsRef<'a> {
    pub fn rows(&self) -> usize {
        self.opacities.len()
    }

    /// The rows before `row`, and the rest.
    pub fn split_at(self, row: usize) -> (ColumnsRef<'a>, ColumnsRef<'a>) {
        let at = |column: Column| row * column.width(self.sh_degree);
        (
            self.map_columns(|column, values| &values[..at(column)]),
            self.map_columns(|column, values| &values[at(column)..]),
        )
    }

    /// Copies one row into the lanes of a block. `W` is the width of `sh_n`: constant, so that the copy takes a few
    /// vector moves. Lanes of `sh_n` beyond it stay unchanged.
    #[inline(always)]
    pub fn load_row<const W: usize>(&self, row: usize, block: &mut RowBlock) {
        block[..SH_N_LANE].copy_from_slice(&self.narrow(row));
        block[SH_N_LANE..SH_N_LANE + W].copy_from_slice(&self.sh_n[row * W..row * W + W]);
    }

    /// The lanes of one row before `sh_n`, in the order of a [`RowBlock`]. Panics beyond the last row.
    #[inline(always)]
    fn narrow(&self, row: usize) -> [f32; SH_N_LANE] {
        let (m, q) = (&self.means.as_chunks::<3>().0[row], &self.quats.as_chunks::<4>().0[row]);
        let (s, c) = (&self.scales.as_chunks::<3>().0[row], &self.sh0.as_chunks::<3>().0[row]);
        let o = self.opacities[row];
        [m[0], m[1], m[2], o, q[0], q[1], q[2], q[3], s[0], s[1], s[2], 0.0, c[0], c[1], c[2], 0.0]
    }

    /// [`ColumnsRef::load_row`] for a degree known only at run time.
    pub fn load_row_any(&self, row: usize, block: &mut RowBlock) {
        match self.sh_degree {
            0 => self.load_row::<0>(row, block),
            1 => self.load_row::<9>(row, block),
            2 => self.load_row::<24>(row, block),
            _ => self.load_row::<45>(row, block),
        }
    }
}

impl<'a> ColumnsMut<'a> {
    pub fn rows(&self) -> usize {
        self.opacities.len()
    }

    #[inline(always)]
    pub fn as_ref(&self) -> ColumnsRef<'_> {
        let ColumnSet { sh_degree, means, quats, scales, opacities, sh0, sh_n } = self;
        ColumnSet { sh_degree: *sh_degree, means, quats, scales, opacities, sh0, sh_n }
    }

    /// The rows before `row`, and the rest.
    pub fn split_at(self, row: usize) -> (ColumnsMut<'a>, ColumnsMut<'a>) {
        let sh_degree = self.sh_degree;
        let mut rest = ColumnsMut { sh_degree, ..ColumnsMut::default() };
        let front = self.map_columns(|column, values| {
            let (front, back) = values.split_at_mut(row * column.width(sh_degree));
            *rest.column_mut(column) = back;
            front
        });
        (front, rest)
    }

    /// Copies the lanes of a block into one row; `W` is the width of `sh_n`.
    #[inline(always)]
    pub fn store_row<const W: usize>(&mut self, row: usize, block: &RowBlock) {
        self.store_narrow(row, block);
        self.sh_n[row * W..row * W + W].copy_from_slice(&block[SH_N_LANE..SH_N_LANE + W]);
    }

    /// Copies the lanes of all columns except `sh_n` into one row.
    #[inline(always)]
    fn store_narrow(&mut self, row: usize, block: &RowBlock) {
        self.means.as_chunks_mut::<3>().0[row].copy_from_slice(&block[0..3]);
        self.opacities[row] = block[3];
        self.quats.as_chunks_mut::<4>().0[row].copy_from_slice(&block[4..8]);
        self.scales.as_chunks_mut::<3>().0[row].copy_from_slice(&block[8..11]);
        self.sh0.as_chunks_mut::<3>().0[row].copy_from_slice(&block[12..15]);
    }

    /// [`ColumnsMut::store_row`] for a degree known only at run time.
    pub fn store_row_any(&mut self, row: usize, block: &RowBlock) {
        match self.sh_degree {
            0 => self.store_row::<0>(row, block),
            1 => self.store_row::<9>(row, block),
            2 => self.store_row::<24>(row, block),
            _ => self.store_row::<45>(row, block),
        }
    }
}

/// Rows with their whole training state, as slices.
#[derive(Debug, Clone, Copy, Default)]
pub struct RowTables<C, W, U, F> {
    /// Number of the first row in the table that the view was cut from.
    pub first_row: usize,
    /// Values after the last update of each row.
    pub columns: C,
    /// First moments after the last update.
    pub exp_avg: C,
    /// Second moments after the last update.
    pub exp_avg_sq: C,
    /// Optimizer steps contained in the row.
    pub stamp: W,
    pub uid: U,
    /// Sums of growth scores since the last round; for the strategy `default`, of gradient norms.
    pub grad2d: F,
    /// Views that drew the row since the last round, and its blending weight in them ([`super::sightings`]).
    pub count: W,
}

/// Shared view of rows with their whole training state.
pub type Rows<'a> = RowTables<ColumnsRef<'a>, &'a [u32], &'a [u64], &'a [f32]>;

/// Exclusive view of rows with their whole training state.
pub type RowsMut<'a> = RowTables<ColumnsMut<'a>, &'a mut [u32], &'a mut [u64], &'a mut [f32]>;

/// Shared and exclusive views are split alike: only the method that splits their slices differs.
macro_rules! impl_rows {
    ($View:ident, $split:ident) => {
        impl<'a> $View<'a> {
            pub fn rows(&self) -> usize {
                self.stamp.len()
            }

            /// The rows before `row`, and the rest.
            pub fn split_at(self, row: usize) -> ($View<'a>, $View<'a>) {
                let (columns, columns_b) = self.columns.split_at(row);
                let (exp_avg, exp_avg_b) = self.exp_avg.split_at(row);
                let (exp_avg_sq, exp_avg_sq_b) = self.exp_avg_sq.split_at(row);
                let (stamp, stamp_b) = self.stamp.$split(row);
                let (uid, uid_b) = self.uid.$split(row);
                let (grad2d, grad2d_b) = self.grad2d.$split(row);
                let (count, count_b) = self.count.$split(row);
                let front =
                    RowTables { first_row: self.first_row, columns, exp_avg, exp_avg_sq, stamp, uid, grad2d, count };
                let back = RowTables {
                    first_row: self.first_row + row,
                    columns: columns_b,
                    exp_avg: exp_avg_b,
                    exp_avg_sq: exp_avg_sq_b,
                    stamp: stamp_b,
                    uid: uid_b,
                    grad2d: grad2d_b,
                    count: count_b,
                };
                (front, back)
            }
        }
    };
}

impl_rows!(Rows, split_at);
impl_rows!(RowsMut, split_at_mut);

impl RowsMut<'_> {
    pub fn as_ref(&self) -> Rows<'_> {
        RowTables {
            first_row: self.first_row,
            columns: self.columns.as_ref(),
            exp_avg: self.exp_avg.as_ref(),
            exp_avg_sq: self.exp_avg_sq.as_ref(),
            stamp: self.stamp,
            uid: self.uid,
            grad2d: self.grad2d,
            count: self.count,
        }
    }

    pub fn clear_statistics(&mut self) {
        self.grad2d.fill(0.0);
        self.count.fill(0);
    }
}

/// Mean growth score (gradient norm) per view that drew the row; 0 without views.
#[inline(always)]
pub fn mean_grad2d(grad2d: f32, count: u32) -> f32 {
    grad2d / views(count).max(1) as f32
}

/// Current values of rows at one step of training. The optimizer implements it; events act on rows through it, because
/// an untouched row still moves by its momentum.
pub trait RowsNow: Sync {
    /// The step: number of optimizer steps contained in every value returned.
    fn now(&self) -> u32;
    /// Evaluates the whole row as of now. Lanes that the degree does not use are zero.
    fn evaluate_row(&self, rows: &Rows<'_>, row: usize, out: &mut RowBlock);
    /// Evaluates one value of one column of a row as of now; `element` counts within the row.
    fn evaluate_element(&self, rows: &Rows<'_>, column: Column, row: usize, element: usize) -> f32;
    /// The range of stored log-scales. Evaluated ones may lie beyond it.
    fn log_scales(&self) -> LogScaleRange;
    /// Evaluates for all rows, as of now, what densification rounds decide by: the largest log-scale and the opacity
    /// (logit), one entry per row each.
    fn sizes_and_opacities(&self, rows: &Rows<'_>, log_scales: &mut [f32], opacities: &mut [f32]);
    /// Rewrites the row with its state as of now: values, with log-scales within their range, decayed moments, stamp.
    fn settle_row(&self, rows: &mut RowsMut<'_>, row: usize);
}
