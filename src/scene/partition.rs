//! Divides the first rows into pages, from positions and sizes alone.
//!
//! The rows are halved along the longest axis of their box, repeatedly, until every part is a page; with an odd number
//! of pages the halves differ by one page. The largest rows are divided the same way among themselves: one giant in a
//! page of small rows would make every view need that page.
//!
//! Not here: pages that outgrow their capacity ([`super::page_split`]), and clouds larger than memory.
//!
//! Invariants: 1. every row is in exactly one page; 2. pages differ by one row at most (pages of giants among
//! themselves); 3. the result is a function of positions and sizes, not of threads: equal coordinates are ordered by
//! row; 4. the rows of a page ascend.

use super::point_box::PointBox;
use super::select::{RankSearch, float_key};
use rayon::prelude::*;
use std::ops::Range;

/// One row in this many is a giant.
const ROWS_PER_GIANT: usize = 200;
/// Parts with fewer rows are divided by one thread.
const SERIAL_BELOW: usize = 8192;
/// With densification, pages start filled to this percentage: most pages grow, and a split leaves half-empty pages.
const FILL_PERCENT: usize = 70;

/// An entry to divide: it has a position and a unique row number.
pub trait Placed: Copy + Send + Sync {
    fn point(&self) -> [f32; 3];
    fn row(&self) -> u32;
}

impl Placed for PointRow {
    fn point(&self) -> [f32; 3] {
        self.point
    }
    fn row(&self) -> u32 {
        self.row
    }
}

#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PointRow {
    pub point: [f32; 3],
    pub row: u32,
}

/// Most rows of a first page: its capacity, or less if pages will grow.
pub fn first_fill(page_rows: usize, is_growing: bool) -> usize {
    if is_growing { (page_rows * FILL_PERCENT / 100).max(1) } else { page_rows.max(1) }
}

pub fn giants(rows: usize) -> usize {
    rows / ROWS_PER_GIANT
}

/// Divides rows into pages of at most `fill` rows (at least 1): the rows of every page, ascending, numbered as
/// [`crate::base::ids::PageId::initial`] numbers pages. `means` and `scales` (log) are `[rows][3]`. Takes 16 bytes per row besides
/// the result. Panics with 2^32 rows or more.
pub fn partition(means: &[f32], scales: &[f32], fill: usize) -> Vec<Vec<u32>> {
    let count = means.len() / 3;
    assert!(u32::try_from(count).is_ok(), "more than 2^32 rows");
    assert_eq!(means.len(), scales.len(), "one size per position");
    let size = |row: usize| largest(&scales[row * 3..row * 3 + 3]);
    let mut search = GiantCut::search(count);
    while !search.is_done() {
        (0..count).for_each(|row| search.count(GiantCut::key(size(row), row as u32)));
        search.next_pass();
    }
    let cut = GiantCut::found(&search);
    let entry = |row: usize| PointRow { point: std::array::from_fn(|i| means[row * 3 + i]), row: row as u32 };
    let is_giant = |row: usize| cut.is_giant(size(row), row as u32);
    let mut entries = Vec::with_capacity(count);
    entries.extend((0..count).filter(|&row| !is_giant(row)).map(entry));
    let small = entries.len();
    entries.extend((0..count).filter(|&row| is_giant(row)).map(entry));
    let mut pages = Vec::new();
    for part in [0..small, small..count] {
        let (division, entries) = (Pages::of(part.len(), fill), &mut entries[part]);
        division.divide(entries);
        let rows = |page| entries[division.start(page)..division.start(page + 1)].iter().map(|e| e.row).collect();
        pages.extend((0..division.pages).map(rows));
    }
    pages
}

fn largest(scales: &[f32]) -> f32 {
    scales[0].max(scales[1]).max(scales[2])
}

/// Selects the giants: the largest half percent of rows, by a size that is any number that increases with theirs; equal sizes are
/// ordered by row.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct GiantCut {
    smallest: u64,
}

impl GiantCut {
    /// A search for the cut among `rows` rows whose sizes are streamed: count [`GiantCut::key`] of every row in every
    /// pass.
    pub fn search(rows: usize) -> RankSearch {
        // Without giants any rank is valid: the search is done at once, and has no key.
        RankSearch::new((rows - giants(rows)) as u64, rows as u64)
    }

    pub fn found(search: &RankSearch) -> GiantCut {
        GiantCut { smallest: search.key().unwrap_or(u64::MAX) }
    }

    /// Key that orders rows by size, equal sizes by row; the first row counts as the larger.
    pub fn key(size: f32, row: u32) -> u64 {
        u64::from(float_key(size)) << 32 | u64::from(!row)
    }

    pub fn is_giant(self, size: f32, row: u32) -> bool {
        GiantCut::key(size, row) >= self.smallest
    }
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Pages {
    pub rows: usize,
    pub pages: usize,
}

impl Pages {
    /// The fewest pages that hold `rows` rows with at most `fill` each.
    pub fn of(rows: usize, fill: usize) -> Pages {
        Pages { rows, pages: rows.div_ceil(fill.max(1)) }
    }

    /// Number of rows in the pages before this one.
    pub fn start(&self, page: usize) -> usize {
        (self.rows as u128 * page as u128 / self.pages.max(1) as u128) as usize
    }

    /// The page at which the range of pages is halved.
    pub fn middle(range: &Range<usize>) -> usize {
        range.start + range.len() / 2
    }

    /// Sorts the rows into pages: afterwards page p holds entries `start(p)` to `start(p + 1)`, ascending.
    pub fn divide<E: Placed>(&self, entries: &mut [E]) {
        assert_eq!(entries.len(), self.rows);
        if self.pages > 0 {
            self.divide_range(entries, 0..self.pages);
        }
    }

    /// The same for the rows of the pages `range` (at least one); `entries` must have their number of rows.
    pub fn divide_range<E: Placed>(&self, entries: &mut [E], range: Range<usize>) {
        if range.len() == 1 {
            return entries.sort_unstable_by_key(E::row);
        }
        let middle = Pages::middle(&range);
        let at = self.start(middle) - self.start(range.start);
        let axis = box_of(entries).longest_axis();
        entries.select_nth_unstable_by_key(at, |e| axis_key(e, axis));
        let serial = entries.len() < SERIAL_BELOW;
        let (low, high) = entries.split_at_mut(at);
        let (low_pages, high_pages) = (range.start..middle, middle..range.end);
        if serial {
            self.divide_range(low, low_pages);
            self.divide_range(high, high_pages);
        } else {
            rayon::join(|| self.divide_range(low, low_pages), || self.divide_range(high, high_pages));
        }
    }
}

pub fn box_of<E: Placed>(entries: &[E]) -> PointBox {
    if entries.len() >= 8 * SERIAL_BELOW {
        return entries.par_chunks(SERIAL_BELOW).map(box_of).reduce(|| PointBox::EMPTY, PointBox::union);
    }
    PointBox::of(entries.iter().map(E::point))
}

/// Key that orders rows along an axis, equal coordinates by row.
pub fn axis_key<E: Placed>(entry: &E, axis: usize) -> u64 {
    u64::from(float_key(entry.point()[axis])) << 32 | u64::from(entry.row())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    fn cloud(rows: usize) -> (Vec<f32>, Vec<f32>) {
        let mut draws = Stream::new(1, Purpose::Test, rows as u64, 7);
        // A third of the coordinates is on a coarse lattice, for many ties.
        let mean = |d: &mut Stream| if d.below(3) == 0 { d.below(5) as f32 } else { (d.normal() * 3.0) as f32 };
        let means = (0..rows * 3).map(|i| mean(&mut draws) * [1.0, 4.0, 0.5][i % 3]).collect();
        let scales = (0..rows * 3).map(|_| (draws.below(64) as f32 - 300.0) * 0.02).collect();
        (means, scales)
    }

    /// The definition: sort along the axis, cut, repeat.
    fn plainly(
        means: &[f32],
        mut rows: Vec<usize>,
        pages: usize,
        share: &dyn Fn(usize) -> usize,
        first: usize,
    ) -> Vec<Vec<u32>> {
        if pages == 1 {
            rows.sort_unstable();
            return vec![rows.iter().map(|&row| row as u32).collect()];
        }
        let extent = |i: usize| {
            let of = |pick: fn(f32, f32) -> f32, start: f32| rows.iter().fold(start, |a, &r| pick(a, means[r * 3 + i]));
            of(f32::max, f32::NEG_INFINITY) - of(f32::min, f32::INFINITY)
        };
        let axis = (1..3).fold(0, |widest, i| if extent(i) > extent(widest) { i } else { widest });
        rows.sort_by(|&a, &b| means[a * 3 + axis].total_cmp(&means[b * 3 + axis]).then(a.cmp(&b)));
        let high = rows.split_off(share(first + pages / 2) - share(first));
        let mut all = plainly(means, rows, pages / 2, share, first);
        all.extend(plainly(means, high, pages - pages / 2, share, first + pages / 2));
        all
    }

    #[test]
    fn pages_equal_sorting_and_cutting_and_giants_are_separate() {
        for (rows, fill) in [(1, 4), (7, 4), (1000, 7), (1000, 1000), (23_456, 100), (70_000, 716)] {
            let (means, scales) = cloud(rows);
            let size = |row: usize| scales[row * 3..row * 3 + 3].iter().copied().fold(f32::NEG_INFINITY, f32::max);
            let mut by_size: Vec<usize> = (0..rows).collect();
            by_size.sort_by(|&a, &b| size(b).total_cmp(&size(a)).then(a.cmp(&b)));
            let mut want = Vec::new();
            for part in [&by_size[rows / 200..], &by_size[..rows / 200]] {
                let (n, pages) = (part.len(), part.len().div_ceil(fill));
                if pages > 0 {
                    want.extend(plainly(&means, part.to_vec(), pages, &|p| n * p / pages, 0));
                }
            }
            for threads in [1, 3] {
                let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build();
                let got = pool.map(|pool| pool.install(|| partition(&means, &scales, fill)));
                assert!(got.is_ok_and(|got| got == want), "{rows} rows, {fill} a page, {threads} threads");
            }
            assert!(want.iter().all(|page| page.len() <= fill && !page.is_empty()));
        }
        assert!(partition(&[], &[], 5).is_empty());
    }

    #[test]
    fn first_pages_leave_room_if_pages_will_grow() {
        assert_eq!((first_fill(1024, false), first_fill(1024, true), first_fill(1, true)), (1024, 716, 1));
    }
}
