//! Ranges of tiles: the parts in which a picture is blended whose lists of intersections are too long to be made at once.
//!
//! Invariants: 1. a range is a number of whole tile columns, or a part of one column, so the intersections of a Gaussian with
//! the tiles of a range follow each other in emit order (tiles column by column); 2. the ranges of a picture are disjoint,
//! cover it, and come in that order, so sums over the intersections of a Gaussian can be carried from range to range; 3. a range
//! of several tiles has no more intersections than asked for; a range of one tile may have more.

use super::splats::Grid;

/// Tiles that are blended together.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TileRange {
    /// First tile column, and one past the last.
    pub columns: [u16; 2],
    /// First tile row, and one past the last; all rows unless the range is a part of one column.
    pub rows: [u16; 2],
}

impl TileRange {
    pub fn all(grid: Grid) -> TileRange {
        TileRange { columns: [0, grid.tiles_x as u16], rows: [0, grid.tiles_y as u16] }
    }

    /// Whether these are all tiles.
    pub fn is_all(&self, grid: Grid) -> bool {
        *self == TileRange::all(grid)
    }

    pub fn tiles(&self) -> u32 {
        let [columns, rows] = [self.columns, self.rows].map(|[first, end]| u32::from(end - first));
        columns * rows
    }

    /// The range in bands of whole rows of tiles, with at most `tiles` tiles each where a row has no more.
    pub fn bands(self, tiles: u32) -> impl Iterator<Item = TileRange> {
        let ([first, end], width) = (self.rows, u32::from(self.columns[1] - self.columns[0]));
        let height = (tiles / width.max(1)).clamp(1, u32::from(u16::MAX)) as u16;
        let band = move |row: u16| TileRange { rows: [row, row.saturating_add(height).min(end)], ..self };
        (first..end).step_by(height.into()).map(band)
    }

    /// Whether a tile, by its number in the picture, belongs to the range.
    #[inline(always)]
    pub fn contains(&self, grid: Grid, tile: usize) -> bool {
        let (x, y) = grid.position(tile);
        let within = |at: u32, [first, end]: [u16; 2]| (u32::from(first)..u32::from(end)).contains(&at);
        within(x, self.columns) && within(y, self.rows)
    }

    /// Cuts a picture into ranges for which `fits(range, intersections)` is true, or of one tile. `isects_of_tile(column, row)`
    /// counts the intersections of a tile. A part of a range that fits must fit.
    pub fn cut(
        grid: Grid,
        isects_of_tile: impl Fn(u32, u32) -> u64,
        fits: impl Fn(&TileRange, u64) -> bool,
    ) -> Vec<TileRange> {
        let all_rows = [0, grid.tiles_y as u16];
        let columns = |first: u32, end: u32| TileRange { columns: [first as u16, end as u16], rows: all_rows };
        let (mut ranges, mut begun, mut held) = (Vec::new(), 0u32, 0u64);
        for x in 0..grid.tiles_x {
            let of_column: u64 = (0..grid.tiles_y).map(|y| isects_of_tile(x, y)).sum();
            if fits(&columns(begun, x + 1), held + of_column) {
                held += of_column;
                continue;
            }
            if begun < x {
                ranges.push(columns(begun, x));
            }
            (begun, held) = (x, of_column);
            if fits(&columns(x, x + 1), of_column) {
                continue;
            }
            cut_column(x, grid, &isects_of_tile, &fits, &mut ranges);
            (begun, held) = (x + 1, 0);
        }
        if begun < grid.tiles_x {
            ranges.push(columns(begun, grid.tiles_x));
        }
        ranges
    }
}

/// Cuts one tile column.
fn cut_column(
    x: u32,
    grid: Grid,
    isects_of_tile: &impl Fn(u32, u32) -> u64,
    fits: &impl Fn(&TileRange, u64) -> bool,
    ranges: &mut Vec<TileRange>,
) {
    let rows = |first: u32, end: u32| TileRange { columns: [x as u16, x as u16 + 1], rows: [first as u16, end as u16] };
    let (mut first, mut held) = (0u32, 0u64);
    for y in 0..grid.tiles_y {
        let isects = isects_of_tile(x, y);
        if y > first && !fits(&rows(first, y + 1), held + isects) {
            ranges.push(rows(first, y));
            (first, held) = (y, 0);
        }
        held += isects;
    }
    ranges.push(rows(first, grid.tiles_y));
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::{Purpose, Stream};

    #[test]
    fn bands_have_every_row_once() {
        let range = TileRange { columns: [2, 12], rows: [3, 10] };
        for (tiles, rows) in [(0, 7), (10, 7), (29, 4), (30, 3), (70, 1), (u32::MAX, 1)] {
            let bands: Vec<TileRange> = range.bands(tiles).collect();
            assert_eq!(bands.len(), rows, "{tiles}");
            assert!(bands.iter().all(|band| band.columns == range.columns && band.tiles() <= tiles.max(10)));
            assert!(bands.windows(2).all(|pair| pair[0].rows[1] == pair[1].rows[0]));
            assert_eq!([bands[0].rows[0], bands[rows - 1].rows[1]], range.rows);
        }
    }

    #[test]
    fn ranges_cover_every_tile_once_in_column_order_and_keep_their_limit() {
        let mut draws = Stream::new(23, Purpose::Test, 0, 0);
        for (width, height) in [(1, 1), (16, 200), (200, 16), (147, 93), (0, 0)] {
            let grid = Grid::new(width, height);
            let mut tile_offsets = vec![0];
            for _ in 0..grid.tiles() {
                tile_offsets.push(tile_offsets[tile_offsets.len() - 1] + draws.below(100));
            }
            let isects = |tile: usize| tile_offsets[tile + 1] - tile_offsets[tile];
            let cut = |most: u64| {
                let of_tile = |x: u32, y: u32| isects(y as usize * grid.tiles_x as usize + x as usize);
                TileRange::cut(grid, of_tile, |_, isects| isects <= most)
            };
            for most in [0, 1, 50, 120, 700, u64::MAX] {
                let ranges = cut(most);
                let mut seen = Vec::new();
                for range in &ranges {
                    assert!(range.rows == [0, grid.tiles_y as u16] || range.columns[1] == range.columns[0] + 1);
                    let tiles: Vec<usize> = (0..grid.tiles()).filter(|&tile| range.contains(grid, tile)).collect();
                    let held: u64 = tiles.iter().map(|&tile| isects(tile)).sum();
                    assert!(!tiles.is_empty() && (held <= most || tiles.len() == 1), "{held} of {most}");
                    let mut in_order: Vec<(u32, u32)> = tiles.iter().map(|&tile| grid.position(tile)).collect();
                    in_order.sort_unstable();
                    seen.extend(in_order);
                }
                assert!(seen.is_sorted() && seen.len() == grid.tiles(), "{width}x{height} in ranges of {most}");
                assert_eq!(ranges.len() <= 1, most == u64::MAX || grid.tiles() <= 1 || ranges.len() == 1);
            }
            assert!(cut(u64::MAX).iter().all(|range| range.is_all(grid)));
        }
    }
}
