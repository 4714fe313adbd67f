//! Residuals of blocks: how far the mean colour of a picture lies from that of its photo, block by block.
//!
//! Invariants: 1. a photo has at most [`BlockGrid::BLOCKS_MOST`] blocks; 2. residuals are a function of photo and picture alone, the
//! same for any number of threads; 3. masked pixels do not count.

use crate::scene::image::Target;
use rayon::prelude::*;
use std::ops::Range;

/// Blocks along the longer side of a photo, at most.
const BLOCKS_ALONG: usize = 64;
/// Side of a block, pixels, at least.
const SIDE_LEAST: usize = 4;
/// Fixed-point numbers per unit of a residual, of values in 0..1.
pub(super) const PER_UNIT: f32 = 16_384.0;
/// Residuals below this are noise of photos and rounding (values in 0..1): six grey levels.
pub(super) const RESIDUAL_LEAST: f64 = 0.025;
/// The residual of a block without used pixels.
pub(super) const NO_PIXELS: u16 = u16::MAX >> 1;

/// How a photo is cut into square blocks; those at the right and lower border are cut off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlockGrid {
    width: usize,
    height: usize,
    side: usize,
}

impl BlockGrid {
    /// The most blocks of a photo.
    pub const BLOCKS_MOST: usize = BLOCKS_ALONG * BLOCKS_ALONG;

    /// The blocks of a photo of this size, pixels.
    pub fn of(width: u32, height: u32) -> BlockGrid {
        let (width, height) = (width as usize, height as usize);
        BlockGrid { width, height, side: width.max(height).div_ceil(BLOCKS_ALONG).max(SIDE_LEAST) }
    }

    fn columns(&self) -> usize {
        self.width.div_ceil(self.side)
    }

    pub fn blocks(&self) -> usize {
        self.columns() * self.height.div_ceil(self.side)
    }

    /// Columns and rows of the pixels of a block.
    pub(super) fn pixels(&self, block: usize) -> (Range<usize>, Range<usize>) {
        let (x, y) = (block % self.columns() * self.side, block / self.columns() * self.side);
        (x..(x + self.side).min(self.width), y..(y + self.side).min(self.height))
    }

    /// Numbers of the pixels of a block (y * width + x), row by row.
    pub(super) fn pixel_numbers(&self, block: usize) -> impl Iterator<Item = usize> {
        let (columns, rows) = self.pixels(block);
        let width = self.width;
        rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
    }

    /// Side of a block, pixels.
    pub(super) fn side(&self) -> usize {
        self.side
    }

    /// The blocks of a line of blocks, from left to right; lines count from the top.
    pub(super) fn line(&self, line: usize) -> Range<usize> {
        line * self.columns()..((line + 1) * self.columns()).min(self.blocks())
    }

    /// The blocks around a block, and the block.
    pub(super) fn around(&self, block: usize) -> impl Iterator<Item = usize> {
        let (columns, lines) = (self.columns(), self.height.div_ceil(self.side));
        let (x, y) = (block % columns, block / columns);
        let lines = y.saturating_sub(1)..(y + 2).min(lines);
        lines.flat_map(move |y| (x.saturating_sub(1)..(x + 2).min(columns)).map(move |x| y * columns + x))
    }

    /// The blocks that share a side with a block.
    pub(super) fn neighbours(&self, block: usize) -> impl Iterator<Item = usize> {
        let (columns, blocks) = (self.columns(), self.blocks());
        let x = block % columns;
        let left = (x > 0).then(|| block - 1);
        let right = (x + 1 < columns).then_some(block + 1);
        let below = Some(block + columns).filter(|&below| below < blocks);
        [left, right, block.checked_sub(columns), below].into_iter().flatten()
    }

    /// Sum of brightness (R + G + B, 0..765) and of its square over the used pixels of a block, and their number.
    fn brightness(&self, block: usize, photo: &Target) -> [u64; 3] {
        let mut sums = [0; 3];
        for i in self.pixel_numbers(block) {
            if photo.mask.as_ref().is_none_or(|mask| mask[i] != 0) {
                let value: u64 = photo.rgb[3 * i..3 * i + 3].iter().map(|&byte| u64::from(byte)).sum();
                [sums[0], sums[1], sums[2]] = [sums[0] + value, sums[1] + value * value, sums[2] + 1];
            }
        }
        sums
    }

    /// The residual of a block: mean colour of the picture less that of the photo, absolute, mean over channels, fixed-point.
    /// `None` if a used pixel is NaN.
    fn residual(&self, block: usize, picture: &[f32], photo: &Target) -> Option<u16> {
        let (mut sums, mut count) = ([0f32; 3], 0u32);
        for i in self.pixel_numbers(block) {
            if photo.mask.as_ref().is_some_and(|mask| mask[i] == 0) {
                continue;
            }
            count += 1;
            for (c, sum) in sums.iter_mut().enumerate() {
                let value = picture[c * self.width * self.height + i].clamp(0.0, 1.0);
                *sum += value - f32::from(photo.rgb[3 * i + c]) / 255.0;
            }
        }
        if count == 0 {
            return Some(NO_PIXELS);
        }
        let mean = sums.iter().map(|sum| sum.abs()).sum::<f32>() / (3 * count) as f32;
        mean.is_finite().then(|| (mean * PER_UNIT).round() as u16)
    }
}

/// The residuals of all blocks; [`NO_PIXELS`] for a block without used pixels. `None` if a used pixel is NaN.
///
/// # Panics
/// Picture and photo differ in size.
pub(super) fn residuals(picture: &[f32], photo: &Target, grid: &BlockGrid) -> Option<Vec<u16>> {
    assert_eq!(picture.len(), 3 * photo.pixels(), "picture and photo differ in size");
    (0..grid.blocks()).into_par_iter().with_min_len(64).map(|block| grid.residual(block, picture, photo)).collect()
}

/// Contrast of a photo around each block: the standard deviation of brightness over the used pixels of the block and of
/// the eight around it, of values in 0..1.
pub(super) fn contrasts(photo: &Target, grid: &BlockGrid) -> Vec<f64> {
    let blocks = (0..grid.blocks()).into_par_iter().with_min_len(64);
    let sums: Vec<[u64; 3]> = blocks.clone().map(|block| grid.brightness(block, photo)).collect();
    let contrast = |block| {
        let add = |a: [u64; 3], b: usize| std::array::from_fn(|i| a[i] + sums[b][i]);
        let [sum, squares, count] = grid.around(block).fold([0; 3], add).map(|n| n as f64);
        let mean = sum / count.max(1.0);
        (squares / count.max(1.0) - mean * mean).max(0.0).sqrt() / 765.0
    };
    blocks.map(contrast).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn residuals_are_those_of_mean_colours_over_used_pixels() {
        // Two blocks; the second is two pixels wide.
        let (width, height) = (6, 4);
        let grid = BlockGrid::of(width, height);
        assert_eq!((grid.blocks(), grid.pixels(1)), (2, (4..6, 0..4)));
        let mut photo = Target { width, height, rgb: vec![102; 72], mask: None };
        // A fine pattern about .4, which is 102 / 255, in the first block; .9 in the red of the second.
        let value = |i: usize| match (i / 24, i % 6) {
            (0, 4..) => 0.9,
            (_, x) if (x + i / 6).is_multiple_of(2) => 0.5,
            _ => 0.3,
        };
        let picture: Vec<f32> = (0..72).map(value).collect();
        assert_eq!(residuals(&picture, &photo, &grid), Some(vec![0, (PER_UNIT / 6.0).round() as u16]));
        photo.mask = Some((0..24).map(|i| if i % 6 >= 4 { 0 } else { 255 }).collect());
        assert_eq!(residuals(&picture, &photo, &grid), Some(vec![0, NO_PIXELS]));
        let broken: Vec<f32> = picture.iter().map(|value| if *value == 0.3 { f32::NAN } else { *value }).collect();
        assert_eq!(residuals(&broken, &photo, &grid), None);
    }

    #[test]
    fn contrast_is_the_deviation_of_brightness_around_a_block() {
        let mut photo = Target { width: 32, height: 4, rgb: vec![100; 3 * 128], mask: None };
        let grid = BlockGrid::of(32, 4);
        assert_eq!(contrasts(&photo, &grid), vec![0.0; 8]);
        // The last block is white: a third of the pixels around the one beside it.
        for i in (0..128).filter(|i| i % 32 >= 28) {
            photo.rgb[3 * i..3 * i + 3].fill(255);
        }
        let found = contrasts(&photo, &grid);
        assert_eq!(found[..6], [0.0; 6]);
        let step = 155.0 / 255.0;
        assert!((found[6] - step * (2.0f64 / 9.0).sqrt()).abs() < 1e-9 && (found[7] - 0.5 * step).abs() < 1e-9);
    }

    #[test]
    fn blocks_know_their_neighbours() {
        let grid = BlockGrid::of(12, 12);
        let sorted = |of: &mut dyn Iterator<Item = usize>| {
            let mut blocks: Vec<usize> = of.collect();
            blocks.sort_unstable();
            blocks
        };
        assert_eq!(sorted(&mut grid.neighbours(4)), [1, 3, 5, 7]);
        assert_eq!(sorted(&mut grid.neighbours(2)), [1, 5]);
        assert_eq!(sorted(&mut grid.around(4)), (0..9).collect::<Vec<_>>());
        assert_eq!(sorted(&mut grid.around(6)), [3, 4, 6, 7]);
    }
}
