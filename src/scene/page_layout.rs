//! Layout of a page's rows in its bytes: the same in memory and, uncompressed, on disk.
//!
//! Tables follow each other, each padded to [`TABLE_ALIGNMENT`]: identities and statistics, then the column groups
//! geometry (means, quats, scales), appearance (opacities, sh0) and the higher bands, each column as values, first
//! moments, second moments. Unused bands take no bytes: the page's degree is part of the layout.
//!
//! Invariants: 1. a layout is a function of (rows, degree) alone; 2. tables do not overlap and their padding is zero;
//! 3. more rows or a higher degree never shorten the payload. Only for little-endian machines, which is checked at
//! compile time.

use super::columns::Column;
use super::rows::{ColumnsMut, ColumnsRef, RowTables, Rows, RowsMut};
use super::state::SceneState;
use bytemuck::{AnyBitPattern, NoUninit};

const _: () = assert!(cfg!(target_endian = "little"), "pages on disk are little-endian");

/// Alignment of every table within the payload, bytes: one vector register, one cache line.
pub const TABLE_ALIGNMENT: usize = 64;

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct PageLayout {
    pub rows: usize,
    /// SH degree of the stored page, 0 to 3.
    pub sh_degree: u8,
}

impl PageLayout {
    /// Bytes of the payload: at least [`super::state::row_bytes`] per row, plus padding.
    pub fn bytes(&self) -> usize {
        4 * (self.head_words() + 3 * self.column_words().sum::<usize>())
    }

    /// Bytes of the payload with moments of 16 bits, as a device holds it: the first and the second moment of a value share a word.
    pub fn packed_bytes(&self) -> usize {
        self.bytes() - 4 * self.column_words().sum::<usize>()
    }

    /// Bytes of the payload on a device, with packed moments if `is_packed`.
    pub fn bytes_on_device(&self, is_packed: bool) -> u64 {
        (if is_packed { self.packed_bytes() } else { self.bytes() }) as u64
    }

    /// Packs a payload, without the lower halves of its moments. Panics if the payload is shorter than [`PageLayout::bytes`] or not
    /// aligned to 4 bytes.
    pub fn pack(&self, payload: &[u8], packed: &mut Vec<u32>) {
        let payload: &[u32] = bytemuck::cast_slice(&payload[..self.bytes()]);
        packed.resize(self.packed_bytes() / 4, 0);
        let (head, mut columns) = payload.split_at(self.head_words());
        let (packed_head, mut rest) = packed.split_at_mut(head.len());
        packed_head.copy_from_slice(head);
        for words in self.column_words() {
            let (tables, others) = columns.split_at(3 * words);
            let (own, others_packed) = rest.split_at_mut(2 * words);
            let (values, moments) = own.split_at_mut(words);
            values.copy_from_slice(&tables[..words]);
            for ((both, m), v) in moments.iter_mut().zip(&tables[words..2 * words]).zip(&tables[2 * words..]) {
                *both = m & 0xffff_0000 | v >> 16;
            }
            (columns, rest) = (others, others_packed);
        }
    }

    /// Restores the payload that [`PageLayout::pack`] packed. Panics if one of both is too short, or the payload not aligned to 4 bytes.
    pub fn unpack(&self, packed: &[u32], payload: &mut [u8]) {
        let payload: &mut [u32] = bytemuck::cast_slice_mut(&mut payload[..self.bytes()]);
        let (head, mut columns) = payload.split_at_mut(self.head_words());
        let (packed_head, mut rest) = packed[..self.packed_bytes() / 4].split_at(head.len());
        head.copy_from_slice(packed_head);
        for words in self.column_words() {
            let (tables, others) = columns.split_at_mut(3 * words);
            let (own, others_packed) = rest.split_at(2 * words);
            let (values, moments) = tables.split_at_mut(words);
            values.copy_from_slice(&own[..words]);
            let (first, second) = moments.split_at_mut(words);
            for ((both, m), v) in own[words..].iter().zip(first).zip(second) {
                (*m, *v) = (both & 0xffff_0000, both << 16);
            }
            (columns, rest) = (others, others_packed);
        }
    }

    /// Words before the columns.
    fn head_words(&self) -> usize {
        (padded(self.rows * 8) + 3 * padded(self.rows * 4)) / 4
    }

    /// Words of a table of each column.
    fn column_words(&self) -> impl Iterator<Item = usize> {
        let PageLayout { rows, sh_degree } = *self;
        Column::ALL.into_iter().map(move |column| padded(rows * column.width(sh_degree) * 4) / 4)
    }

    /// The rows in `payload`, numbered from `first_row` in the table of a working set. Panics if `payload` is shorter
    /// than [`PageLayout::bytes`] or not aligned to 8 bytes.
    pub fn rows<'a>(&self, payload: &'a [u8], first_row: usize) -> Rows<'a> {
        let mut rest = payload;
        let uid = take(&mut rest, self.rows);
        let stamp = take(&mut rest, self.rows);
        let grad2d = take(&mut rest, self.rows);
        let count = take(&mut rest, self.rows);
        let [mut columns, mut exp_avg, mut exp_avg_sq] =
            [ColumnsRef { sh_degree: self.sh_degree, ..ColumnsRef::default() }; 3];
        for column in Column::ALL {
            for table in [&mut columns, &mut exp_avg, &mut exp_avg_sq] {
                *table.column_mut(column) = take(&mut rest, self.rows * column.width(self.sh_degree));
            }
        }
        RowTables { first_row, columns, exp_avg, exp_avg_sq, stamp, uid, grad2d, count }
    }

    /// As [`PageLayout::rows`], mutable.
    pub fn rows_mut<'a>(&self, payload: &'a mut [u8], first_row: usize) -> RowsMut<'a> {
        let mut rest = payload;
        let uid = take_mut(&mut rest, self.rows);
        let stamp = take_mut(&mut rest, self.rows);
        let grad2d = take_mut(&mut rest, self.rows);
        let count = take_mut(&mut rest, self.rows);
        let mut tables = [0; 3].map(|_| ColumnsMut { sh_degree: self.sh_degree, ..ColumnsMut::default() });
        for column in Column::ALL {
            for table in &mut tables {
                *table.column_mut(column) = take_mut(&mut rest, self.rows * column.width(self.sh_degree));
            }
        }
        let [columns, exp_avg, exp_avg_sq] = tables;
        RowTables { first_row, columns, exp_avg, exp_avg_sq, stamp, uid, grad2d, count }
    }
}

/// Payload bytes of a full page of `page_rows` rows at the scene's degree.
pub fn capacity_bytes(page_rows: usize, sh_degree: u8) -> usize {
    PageLayout { rows: page_rows, sh_degree }.bytes()
}

/// Writes all rows of `state` as a page; returns its layout. Zeroes the padding and leaves the rest of `payload`
/// unchanged. Panics if `payload` is too short.
pub fn write_page(state: &SceneState, payload: &mut [u8]) -> PageLayout {
    let layout = PageLayout { rows: state.rows(), sh_degree: state.sh_degree() };
    payload[..layout.bytes()].fill(0);
    let rows = layout.rows_mut(payload, 0);
    rows.stamp.copy_from_slice(&state.stamp);
    rows.uid.copy_from_slice(&state.uid);
    rows.grad2d.copy_from_slice(&state.grad2d);
    rows.count.copy_from_slice(&state.count);
    for (to, from) in
        [(rows.columns, &state.columns), (rows.exp_avg, &state.exp_avg), (rows.exp_avg_sq, &state.exp_avg_sq)]
    {
        to.map_columns(|column, values| values.copy_from_slice(from.column(column)));
    }
    layout
}

/// Copies the rows of a page into a table of their own.
pub fn read_page(rows: &Rows<'_>) -> SceneState {
    let table = |from: ColumnsRef<'_>| from.map_columns(|_, values| values.to_vec());
    SceneState {
        columns: table(rows.columns),
        exp_avg: table(rows.exp_avg),
        exp_avg_sq: table(rows.exp_avg_sq),
        stamp: rows.stamp.to_vec(),
        uid: rows.uid.to_vec(),
        grad2d: rows.grad2d.to_vec(),
        count: rows.count.to_vec(),
    }
}

fn padded(bytes: usize) -> usize {
    bytes.next_multiple_of(TABLE_ALIGNMENT)
}

fn take<'a, T: AnyBitPattern>(rest: &mut &'a [u8], count: usize) -> &'a [T] {
    let bytes = count * size_of::<T>();
    let (table, tail) = rest.split_at(padded(bytes));
    *rest = tail;
    bytemuck::cast_slice(&table[..bytes])
}

fn take_mut<'a, T: AnyBitPattern + NoUninit>(rest: &mut &'a mut [u8], count: usize) -> &'a mut [T] {
    let bytes = count * size_of::<T>();
    let (table, tail) = std::mem::take(rest).split_at_mut(padded(bytes));
    *rest = tail;
    bytemuck::cast_slice_mut(&mut table[..bytes])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn packed_payloads_come_back_and_take_a_word_less_for_each_value() {
        for (rows, sh_degree) in [(1, 0), (33, 1), (700, 3)] {
            let layout = PageLayout { rows, sh_degree };
            let mut words: Vec<u32> = (0..layout.bytes() as u32 / 4).map(|i| i.wrapping_mul(0x9e37_79b9)).collect();
            let mut at = layout.head_words();
            for of_column in layout.column_words() {
                words[at + of_column..at + 3 * of_column].iter_mut().for_each(|moment| *moment &= 0xffff_0000);
                at += 3 * of_column;
            }
            let mut packed = Vec::new();
            layout.pack(bytemuck::cast_slice(&words), &mut packed);
            assert_eq!(
                (4 * packed.len(), layout.bytes() - layout.packed_bytes()),
                (layout.packed_bytes(), (at - layout.head_words()) / 3 * 4)
            );
            let mut back = vec![7u64; words.len().div_ceil(2)];
            layout.unpack(&packed, bytemuck::cast_slice_mut(&mut back));
            assert!(bytemuck::cast_slice::<u64, u32>(&back)[..words.len()] == words[..]);
        }
    }
    use crate::scene::columns::Columns;
    use crate::scene::state::row_bytes;

    #[test]
    fn rows_round_trip_through_a_page() {
        for (rows, sh_degree) in [(0, 3), (1, 0), (7, 1), (128, 2), (1000, 3)] {
            let mut columns = Columns::zeros(rows, sh_degree);
            let mut next = 0.0f32;
            for column in Column::ALL {
                columns.column_mut(column).iter_mut().for_each(|x| (*x, next) = (next, next + 1.0));
            }
            let mut state = SceneState::from_columns(columns);
            state.exp_avg = state.columns.clone();
            state.exp_avg.means.iter_mut().for_each(|x| *x += 0.5);
            state.exp_avg_sq.sh_n.fill(3.0);
            state.stamp.fill(9);
            state.grad2d.fill(0.25);
            state.count.fill(4);
            let bytes = capacity_bytes(rows, sh_degree);
            assert!(
                bytes >= rows * row_bytes(sh_degree) && bytes <= rows * row_bytes(sh_degree) + 22 * TABLE_ALIGNMENT
            );
            let mut words = vec![u64::MAX; bytes.div_ceil(8) + 8];
            let payload = bytemuck::cast_slice_mut(&mut words);
            let layout = write_page(&state, payload);
            assert_eq!(layout.bytes(), bytes);
            assert_eq!(read_page(&layout.rows(payload, 5)), state);
            assert!(payload[bytes..].iter().all(|&b| b == 0xff), "bytes after the page stay unchanged");
            assert_eq!(layout.rows_mut(payload, 5).first_row, 5);
        }
    }
}
