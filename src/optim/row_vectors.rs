//! One row of a table in whole vectors: how the loops over rows ([`super::row_kernels`]) load and store it with the
//! fewest instructions.
//!
//! The narrow columns form one vector, `sh_n` the others. If the last of these would not be full, it starts earlier;
//! the lanes that it shares with the previous vector get the same result in both. So no load of `sh_n` waits for parts
//! of a vector. This is correct in place because a row, or at least its last vector, is loaded before any of it is
//! stored. Columns of three values are loaded four at a time, where the fourth belongs to the next row; so the last row
//! of a table is left to [`RowVectors::of_block`].
//!
//! Invariants: 1. all columns of a [`Table`] have the same number of rows, so that one bounds check of a row number
//! suffices; 2. lanes of the next row may hold anything: they may send a row to slower code with the same bits, but no
//! stored or counted result depends on them.

use crate::base::simd::{LANES, prefetch};
use crate::scene::columns::Column;
use crate::scene::rows::{BLOCK_LANES, ColumnsMut, ColumnsRef, RowBlock, SH_N_LANE, first_lane};

/// One row of columns whose `sh_n` is `W` wide: the lanes of a [`RowBlock`] before `sh_n`, then the vectors of `sh_n`.
#[derive(Clone, Copy)]
pub(super) struct RowVectors<const W: usize>(pub [f32; BLOCK_LANES]);

/// Whether a lane of a loaded row belongs to the next row.
#[inline(always)]
pub(super) const fn is_of_row_behind(lane: usize) -> bool {
    lane == first_lane(Column::Scales) + 3 || lane == first_lane(Column::Sh0) + 3
}

/// The vectors of `sh_n` of width `W`: the first lane of each, its position in `sh_n`, and the number of its lanes in
/// use.
#[inline(always)]
fn parts<const W: usize>() -> impl Iterator<Item = (usize, usize, usize)> {
    (0..W.div_ceil(LANES)).map(|i| {
        let start = if W < LANES { 0 } else { (i * LANES).min(W - LANES) };
        (SH_N_LANE + i * LANES, start, W.min(LANES))
    })
}

impl<const W: usize> RowVectors<W> {
    /// Number of lanes processed.
    pub const USED: usize = SH_N_LANE + W.next_multiple_of(LANES);

    /// The same row with its columns one after the other.
    pub fn to_block(self) -> RowBlock {
        let mut block = [0.0; BLOCK_LANES];
        block[..SH_N_LANE].copy_from_slice(&self.0[..SH_N_LANE]);
        for (lane, start, len) in parts::<W>() {
            block[SH_N_LANE + start..][..len].copy_from_slice(&self.0[lane..lane + len]);
        }
        block
    }

    /// Builds the vectors from a row with its columns one after the other.
    pub fn of_block(block: &RowBlock) -> Self {
        let mut lanes = [0.0; BLOCK_LANES];
        lanes[..SH_N_LANE].copy_from_slice(&block[..SH_N_LANE]);
        for (lane, start, len) in parts::<W>() {
            lanes[lane..lane + len].copy_from_slice(&block[SH_N_LANE + start..][..len]);
        }
        RowVectors(lanes)
    }
}

/// Rows of columns, `[rows][width]` each as in [`ColumnsRef`]; `sh_n` is `[rows * W]`.
#[derive(Clone, Copy)]
pub(super) struct Table<'a, const W: usize> {
    means: &'a [[f32; 3]],
    quats: &'a [[f32; 4]],
    scales: &'a [[f32; 3]],
    opacities: &'a [f32],
    sh0: &'a [[f32; 3]],
    sh_n: &'a [f32],
}

impl<'a, const W: usize> Table<'a, W> {
    /// The first `rows` rows. Panics if there are fewer.
    #[inline(always)]
    pub fn new(columns: &ColumnsRef<'a>, rows: usize) -> Self {
        Table {
            means: &columns.means.as_chunks().0[..rows],
            quats: &columns.quats.as_chunks().0[..rows],
            scales: &columns.scales.as_chunks().0[..rows],
            opacities: &columns.opacities[..rows],
            sh0: &columns.sh0.as_chunks().0[..rows],
            sh_n: &columns.sh_n[..rows * W],
        }
    }

    /// Loads a row, with lanes of the next one. Panics at the last row and beyond.
    #[inline(always)]
    pub fn load(&self, row: usize) -> RowVectors<W> {
        let (m, q, o) = (&self.means[row], &self.quats[row], self.opacities[row]);
        let (s, c) = (&self.scales[row], &self.sh0[row]);
        let (behind_s, behind_c) = (self.scales[row + 1][0], self.sh0[row + 1][0]);
        let narrow =
            [m[0], m[1], m[2], o, q[0], q[1], q[2], q[3], s[0], s[1], s[2], behind_s, c[0], c[1], c[2], behind_c];
        let mut block = [0.0; BLOCK_LANES];
        block[..SH_N_LANE].copy_from_slice(&narrow);
        let sh_n = &self.sh_n[row * W..][..W];
        for (lane, start, len) in parts::<W>() {
            block[lane..lane + len].copy_from_slice(&sh_n[start..start + len]);
        }
        RowVectors(block)
    }

    /// Prefetches `sh_n` of a row, except a last cache line of only a few values.
    #[inline(always)]
    pub fn prefetch(&self, row: usize) {
        for line in 0..W.div_ceil(LANES) {
            prefetch(self.sh_n, row * W + line * LANES);
        }
    }

    /// Prefetches the narrow columns. The hardware prefetcher loads them, many rows to a line, as long as it can follow
    /// all tables: forwarding gains nothing from this call, the step with its five tables a tenth to a fifth (AMD Milan).
    #[inline(always)]
    pub fn prefetch_narrow(&self, row: usize) {
        prefetch(self.means, row);
        prefetch(self.quats, row);
        prefetch(self.scales, row);
        prefetch(self.opacities, row);
        prefetch(self.sh0, row);
    }
}

pub(super) struct TableMut<'a, const W: usize> {
    means: &'a mut [[f32; 3]],
    quats: &'a mut [[f32; 4]],
    scales: &'a mut [[f32; 3]],
    opacities: &'a mut [f32],
    sh0: &'a mut [[f32; 3]],
    sh_n: &'a mut [f32],
    /// Start of the last vector of `sh_n`.
    last_start: usize,
}

impl<'a, const W: usize> TableMut<'a, W> {
    /// The first `rows` rows. Panics if there are fewer.
    #[inline(always)]
    pub fn new(columns: &'a mut ColumnsMut<'_>, rows: usize) -> Self {
        TableMut {
            means: &mut columns.means.as_chunks_mut().0[..rows],
            quats: &mut columns.quats.as_chunks_mut().0[..rows],
            scales: &mut columns.scales.as_chunks_mut().0[..rows],
            opacities: &mut columns.opacities[..rows],
            sh0: &mut columns.sh0.as_chunks_mut().0[..rows],
            sh_n: &mut columns.sh_n[..rows * W],
            // Hidden from the compiler: it would shorten the store before the last to the part that the last does not
            // overwrite, and three stores are slower than one.
            last_start: std::hint::black_box(W.saturating_sub(LANES)),
        }
    }

    /// The same rows, shared.
    #[inline(always)]
    pub fn as_ref(&self) -> Table<'_, W> {
        Table {
            means: self.means,
            quats: self.quats,
            scales: self.scales,
            opacities: self.opacities,
            sh0: self.sh0,
            sh_n: self.sh_n,
        }
    }

    /// [`TableMut::store`] for a row that comes from memory. Cold: once per thousand rows.
    #[cold]
    #[inline(never)]
    pub fn store_alone(&mut self, row: usize, vectors: &RowVectors<W>) {
        self.store(row, vectors);
    }

    /// Stores a row without touching the next one. Panics beyond the last row.
    #[inline(always)]
    pub fn store(&mut self, row: usize, vectors: &RowVectors<W>) {
        let block = &vectors.0;
        self.means[row].copy_from_slice(&block[0..3]);
        self.opacities[row] = block[3];
        self.quats[row].copy_from_slice(&block[4..8]);
        self.scales[row].copy_from_slice(&block[8..11]);
        self.sh0[row].copy_from_slice(&block[12..15]);
        let sh_n = &mut self.sh_n[row * W..][..W];
        for (lane, start, len) in parts::<W>() {
            let is_last = W > LANES && start == W - LANES;
            let start = if is_last { self.last_start } else { start };
            sh_n[start..start + len].copy_from_slice(&block[lane..lane + len]);
        }
    }
}
