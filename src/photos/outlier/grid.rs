//! How a photo is cut into blocks: the residual of each (how far the mean colour of the picture lies from that of the photo), and the
//! rims of masked ones.
//!
//! A rim is the part of a transient object outside its masked blocks. Blocks at the border of an object show the object in
//! part. Their mean colours may differ too little for a mask, yet training on them teaches the scene the border. For
//! objects a dozen pixels wide, masks of the blocks that lie wholly in an object gain half of what exact masks gain; masks
//! of the blocks that lie at least half in an object gain five sixths (`benches/RESULTS.md`). So a pixel of a block beside
//! a masked block is left out if the mean colour of the masked block explains the pixel far better than the picture does.
//!
//! Invariants: 1. a photo has at most [`BlockGrid::BLOCKS_MOST`] blocks; 2. all is a function of photo, picture and masked blocks
//! alone, the same for any number of threads; 3. masked pixels do not count; 4. a rim is at most one block wide, and what the picture
//! shows right is never part of it, so the rim of a block that was masked by mistake ends when the picture shows the place.

use super::is_used;
use crate::scene::image::Target;
use rayon::prelude::*;
use std::ops::Range;

/// Blocks along the longer side of a photo, at most.
const BLOCKS_ALONG: usize = 64;
/// Side of a block, pixels, at least.
const SIDE_LEAST: usize = 4;
/// Fixed-point numbers per unit of a residual, of values in 0..1.
pub const PER_UNIT: f32 = 16_384.0;
/// Residuals below this are noise of photos and rounding (values in 0..1): six grey levels.
pub const RESIDUAL_LEAST: f64 = 0.025;
/// The residual of a block without used pixels.
pub const NO_PIXELS: u16 = u16::MAX >> 1;

/// How a photo is cut into square blocks; those at the right and lower border are cut off.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct BlockGrid {
    width: usize,
    height: usize,
    side: usize,
}

impl BlockGrid {
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

    /// The block of a place in the photo, pixels.
    pub fn block_at(&self, [x, y]: [f64; 2]) -> usize {
        y as usize / self.side * self.columns() + x as usize / self.side
    }

    /// Columns and rows of the pixels of a block.
    pub fn pixels(&self, block: usize) -> (Range<usize>, Range<usize>) {
        let (x, y) = (block % self.columns() * self.side, block / self.columns() * self.side);
        (x..(x + self.side).min(self.width), y..(y + self.side).min(self.height))
    }

    /// Numbers of the pixels of a block (y * width + x), row by row.
    pub fn pixel_numbers(&self, block: usize) -> impl Iterator<Item = usize> {
        let (columns, rows) = self.pixels(block);
        let width = self.width;
        rows.flat_map(move |y| columns.clone().map(move |x| y * width + x))
    }

    /// The blocks of a line of blocks, from left to right; lines count from the top.
    pub fn line(&self, line: usize) -> Range<usize> {
        line * self.columns()..((line + 1) * self.columns()).min(self.blocks())
    }

    pub fn around(&self, block: usize) -> impl Iterator<Item = usize> {
        let (columns, lines) = (self.columns(), self.height.div_ceil(self.side));
        let (x, y) = (block % columns, block / columns);
        let lines = y.saturating_sub(1)..(y + 2).min(lines);
        lines.flat_map(move |y| (x.saturating_sub(1)..(x + 2).min(columns)).map(move |x| y * columns + x))
    }

    /// The blocks that share a side with a block.
    pub fn neighbours(&self, block: usize) -> impl Iterator<Item = usize> {
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
            if is_used(photo, i) {
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
            if !is_used(photo, i) {
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
pub fn residuals(picture: &[f32], photo: &Target, grid: &BlockGrid) -> Option<Vec<u16>> {
    assert_eq!(picture.len(), 3 * photo.pixels(), "picture and photo differ in size");
    (0..grid.blocks()).into_par_iter().with_min_len(64).map(|block| grid.residual(block, picture, photo)).collect()
}

/// Contrast of a photo around each block: the standard deviation of brightness over the used pixels of the block and of
/// the eight around it, of values in 0..1.
pub fn contrasts(photo: &Target, grid: &BlockGrid) -> Vec<f64> {
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

/// A pixel belongs to the object if its distance from the colour of the object is at most this share of its distance from the
/// picture.
const OBJECT_MOST: f32 = 0.2;

/// Clears `mask` (one byte per pixel) where a pixel of a block beside those in `is_masked` belongs to their object. `picture` is
/// `[3][height][width]`.
pub fn mask_rims(is_masked: &[bool], picture: &[f32], photo: &Target, mask: &mut [u8]) {
    let grid = BlockGrid::of(photo.width, photo.height);
    let blocks = (0..grid.blocks()).into_par_iter().with_min_len(64);
    let objects: Vec<Option<[f32; 3]>> =
        blocks.map(|block| is_masked[block].then(|| mean_rgb(&grid, block, photo)).flatten()).collect();
    let lines = mask.par_chunks_mut(grid.side * photo.width as usize).enumerate();
    lines.for_each(|(line, mask)| {
        let first = line * grid.side * photo.width as usize;
        for block in grid.line(line).filter(|&block| !is_masked[block]) {
            let beside: Vec<[f32; 3]> = grid.around(block).filter_map(|block| objects[block]).collect();
            if beside.is_empty() {
                continue;
            }
            for pixel in grid.pixel_numbers(block) {
                let of_photo = photo_rgb(photo, pixel);
                let shown = std::array::from_fn(|c| picture[c * photo.pixels() + pixel].clamp(0.0, 1.0));
                let residual = distance(of_photo, shown);
                // Whether one of the colours of objects explains the pixel far better than the picture does.
                if f64::from(residual) >= RESIDUAL_LEAST
                    && beside.iter().any(|&object| distance(of_photo, object) <= OBJECT_MOST * residual)
                {
                    mask[pixel - first] = 0;
                }
            }
        }
    });
}

/// The mean colour of the used pixels of a block; `None` without one.
fn mean_rgb(grid: &BlockGrid, block: usize, photo: &Target) -> Option<[f32; 3]> {
    let (mut sums, mut count) = ([0f32; 3], 0u32);
    for pixel in grid.pixel_numbers(block).filter(|&pixel| is_used(photo, pixel)) {
        sums.iter_mut().zip(photo_rgb(photo, pixel)).for_each(|(sum, value)| *sum += value);
        count += 1;
    }
    (count > 0).then(|| sums.map(|sum| sum / count as f32))
}

/// Red, green and blue in 0..1, as all colours here.
fn photo_rgb(photo: &Target, pixel: usize) -> [f32; 3] {
    std::array::from_fn(|c| f32::from(photo.rgb[3 * pixel + c]) / 255.0)
}

/// Absolute difference of two colours, mean over channels, in 0..1.
fn distance(a: [f32; 3], b: [f32; 3]) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0
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
        let mut photo = Target::new([width, height], vec![102; 72]);
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
        let mut photo = Target::new([32, 4], vec![100; 3 * 128]);
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

    const SIZE: usize = 16;

    /// A photo of 4 x 4 blocks with a bright object of 6 x 6 pixels from (4, 4) on, and the picture of the grey scene behind it.
    fn scene() -> (Target, Vec<f32>) {
        let mut photo = Target::new([SIZE as u32; 2], vec![102; 3 * SIZE * SIZE]);
        for pixel in object() {
            photo.rgb[3 * pixel..3 * pixel + 3].fill(230);
        }
        (photo, vec![0.4; 3 * SIZE * SIZE])
    }

    fn object() -> Vec<usize> {
        (4..10).flat_map(|y| (4..10).map(move |x| y * SIZE + x)).collect()
    }

    fn masked(is_masked: &[bool], picture: &[f32], photo: &Target) -> Vec<usize> {
        let mut mask = vec![u8::MAX; photo.pixels()];
        mask_rims(is_masked, picture, photo, &mut mask);
        (0..mask.len()).filter(|&pixel| mask[pixel] == 0).collect()
    }

    #[test]
    fn the_rim_is_what_has_the_colour_of_the_object() {
        let (photo, picture) = scene();
        let mut blocks = vec![false; 16];
        assert_eq!(masked(&blocks, &picture, &photo), [0; 0], "no block is masked");
        blocks[5] = true;
        let grid = BlockGrid::of(photo.width, photo.height);
        let inside: Vec<usize> = grid.pixel_numbers(5).collect();
        let want: Vec<usize> = object().into_iter().filter(|pixel| !inside.contains(pixel)).collect();
        assert_eq!(masked(&blocks, &picture, &photo), want);
        // The same with noise of three grey levels in the photo, which is a fortieth of the residual.
        let mut noisy = photo.clone();
        noisy.rgb.iter_mut().enumerate().for_each(|(i, value)| *value += [0, 3, 1][i / 3 % 3]);
        assert_eq!(masked(&blocks, &picture, &noisy), want);
    }

    #[test]
    fn what_the_picture_shows_is_no_rim() {
        let (photo, _) = scene();
        let shows_all: Vec<f32> =
            (0..3).flat_map(|c| photo.rgb.iter().skip(c).step_by(3)).map(|&byte| f32::from(byte) / 255.0).collect();
        let blocks: Vec<bool> = (0..16).map(|block| block == 5).collect();
        assert_eq!(masked(&blocks, &shows_all, &photo), [0; 0]);
        // Neither is a pixel whose residual is large, but whose colour is not the object's.
        let dark = vec![0.0; 3 * SIZE * SIZE];
        assert_eq!(masked(&blocks, &dark, &photo).len(), object().len() - 16);
    }

    #[test]
    fn a_rim_is_one_block_wide_and_pixels_under_a_mask_have_no_say() {
        let (mut photo, picture) = scene();
        photo.rgb.fill(230);
        let blocks: Vec<bool> = (0..16).map(|block| block == 0).collect();
        assert_eq!(masked(&blocks, &picture, &photo).len(), 3 * 16);
        // The used pixels of the masked block are dark, so no pixel beside it has their colour.
        let of_user = |pixel: usize| if pixel == 0 || pixel % SIZE > 3 || pixel / SIZE > 3 { u8::MAX } else { 0 };
        photo.mask = Some((0..SIZE * SIZE).map(of_user).collect());
        photo.rgb[..3].fill(0);
        assert_eq!(masked(&blocks, &picture, &photo), [0; 0]);
    }
}
