//! Rims of transient objects: pixels beside masked blocks that belong to the same object.
//!
//! The blocks at the border of an object show the object in part. Their mean colours may differ too little for a mask, yet such blocks
//! teach the scene the border. Where objects are a dozen pixels wide, a mask of the blocks that lie wholly in an object wins half of
//! what exact masks win, and a mask of the blocks that lie at least half in an object wins five sixths (`benches/RESULTS.md`). So a
//! pixel of a block beside a masked block is left out if the mean colour of the masked block explains the pixel far better than the
//! picture does.
//!
//! Invariants: 1. a rim is at most one block wide; 2. pixels that the picture shows right are never part of a rim, so the rim of a block
//! that was masked by mistake ends when the picture shows the place; 3. nothing is remembered: a rim follows from the masked blocks, the
//! picture and the photo, so a step whose picture is not looked at has no rims.

use super::residuals::{BlockGrid, RESIDUAL_LEAST};
use crate::scene::image::Target;
use rayon::prelude::*;

/// A pixel belongs to the object if its distance from the colour of the object is at most this share of its distance from the
/// picture.
const OBJECT_MOST: f32 = 0.2;

/// Red, green and blue in 0..1.
type Rgb = [f32; 3];

/// Clears `mask` (one byte per pixel) where a pixel of a block beside those in `is_masked` belongs to their object. `picture` is
/// `[3][height][width]`.
pub(super) fn mask_rims(is_masked: &[bool], picture: &[f32], photo: &Target, mask: &mut [u8]) {
    let grid = BlockGrid::of(photo.width, photo.height);
    let blocks = (0..grid.blocks()).into_par_iter().with_min_len(64);
    let objects: Vec<Option<Rgb>> =
        blocks.map(|block| is_masked[block].then(|| mean_rgb(&grid, block, photo)).flatten()).collect();
    let lines = mask.par_chunks_mut(grid.side() * photo.width as usize).enumerate();
    lines.for_each(|(line, mask)| {
        let first = line * grid.side() * photo.width as usize;
        for block in grid.line(line).filter(|&block| !is_masked[block]) {
            let beside: Vec<Rgb> = grid.around(block).filter_map(|block| objects[block]).collect();
            if beside.is_empty() {
                continue;
            }
            for pixel in grid.pixel_numbers(block) {
                if is_of_object(photo_rgb(photo, pixel), picture_rgb(picture, photo, pixel), &beside) {
                    mask[pixel - first] = 0;
                }
            }
        }
    });
}

/// Whether one of the colours of objects explains a pixel of the photo far better than the picture does.
fn is_of_object(pixel: Rgb, shown: Rgb, objects: &[Rgb]) -> bool {
    let residual = distance(pixel, shown);
    f64::from(residual) >= RESIDUAL_LEAST
        && objects.iter().any(|&object| distance(pixel, object) <= OBJECT_MOST * residual)
}

/// The mean colour of the used pixels of a block; `None` without one.
fn mean_rgb(grid: &BlockGrid, block: usize, photo: &Target) -> Option<Rgb> {
    let (mut sums, mut count) = ([0f32; 3], 0u32);
    for pixel in grid.pixel_numbers(block).filter(|&pixel| photo.mask.as_ref().is_none_or(|mask| mask[pixel] != 0)) {
        sums.iter_mut().zip(photo_rgb(photo, pixel)).for_each(|(sum, value)| *sum += value);
        count += 1;
    }
    (count > 0).then(|| sums.map(|sum| sum / count as f32))
}

fn photo_rgb(photo: &Target, pixel: usize) -> Rgb {
    std::array::from_fn(|c| f32::from(photo.rgb[3 * pixel + c]) / 255.0)
}

fn picture_rgb(picture: &[f32], photo: &Target, pixel: usize) -> Rgb {
    std::array::from_fn(|c| picture[c * photo.pixels() + pixel].clamp(0.0, 1.0))
}

/// Absolute difference of two colours, mean over channels, in 0..1.
fn distance(a: Rgb, b: Rgb) -> f32 {
    a.iter().zip(b).map(|(a, b)| (a - b).abs()).sum::<f32>() / 3.0
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIZE: usize = 16;

    /// A photo of 4 x 4 blocks with a bright object of 6 x 6 pixels from (4, 4) on, and the picture of the grey scene behind it.
    fn scene() -> (Target, Vec<f32>) {
        let mut photo = Target { width: SIZE as u32, height: SIZE as u32, rgb: vec![102; 3 * SIZE * SIZE], mask: None };
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
