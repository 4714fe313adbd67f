//! The values of a correction that bring a picture closest to its photo: damped Gauss-Newton steps.
//!
//! The fit minimises the mean absolute difference between picture and photo, as weighted squares, plus a small weight times
//! the square of each value. These weights pull the values towards no change. A few ten thousand pixels determine nine
//! values, so a large picture is sampled on a grid that depends on its size alone.
//!
//! Invariants: 1. sums are f64, by row and then over rows in order, so the bits are the same for any number of threads;
//! 2. masked pixels, and values at which the photo is white and the picture at least as bright, do not count; 3. the
//! result is finite, or there is none.

use super::model::{CHANNEL_VALUES, IMAGE_VALUES, PixelModel, falloff_columns, homography_back, homography_columns};
use super::picture::Look;
use crate::scene::image::Target;
use rayon::prelude::*;
use std::ops::Range;

/// Pixels of a sample, about.
const SAMPLE: usize = 16_384;
/// Differences below this count as squares, larger ones as absolute differences (Huber): moving objects, and detail that
/// the picture does not have yet, must not outweigh the rest.
const SMALL_DIFFERENCE: f64 = 0.05;
/// Weight of the square of the exposure in stops. It shrinks an exposure of one stop by .01 to .06 stops, the more the darker
/// the picture.
const EXPOSURE_WEIGHT: f64 = 0.01;
/// Weight of the squares of the numbers of a homography.
const CHROMA_WEIGHT: f64 = 0.05;
/// Weight of the squares of the numbers of a falloff.
const FALLOFF_WEIGHT: f64 = 0.02;
/// Largest magnitude of an exposure that acts, stops.
const EXPOSURE_MOST: f64 = 4.0;
/// Largest magnitude of a number of a homography: q2 stays above S/2 then.
const CHROMA_MOST: f64 = 0.3;
/// Largest magnitude of a number of a falloff.
const FALLOFF_MOST: f64 = 1.0;

/// `values` within their bounds; `None` if one is not finite.
pub fn bounded(values: [f64; IMAGE_VALUES]) -> Option<[f64; IMAGE_VALUES]> {
    let most = |k: usize| if k == 0 { EXPOSURE_MOST } else { CHROMA_MOST };
    let is_finite = values.iter().all(|x| x.is_finite());
    is_finite.then(|| std::array::from_fn(|k| values[k].clamp(-most(k), most(k))))
}

pub fn bounded_channel(values: [f64; CHANNEL_VALUES]) -> Option<[f64; CHANNEL_VALUES]> {
    values.iter().all(|x| x.is_finite()).then(|| values.map(|x| x.clamp(-FALLOFF_MOST, FALLOFF_MOST)))
}

/// A picture as it was drawn, and its photo.
#[derive(Debug, Clone, Copy)]
pub struct FittedPair<'a> {
    /// `[3][height][width]`.
    pub drawn: &'a [f32],
    pub photo: &'a Target,
}

#[derive(Debug, Clone, Copy)]
struct Normal<const N: usize> {
    /// Values in the sums.
    count: f64,
    /// Sums of w d d^T; the lower triangle.
    matrix: [[f64; N]; N],
    /// Sums of w d times the difference.
    right: [f64; N],
}

impl<const N: usize> Normal<N> {
    const ZERO: Self = Normal { count: 0.0, matrix: [[0.0; N]; N], right: [0.0; N] };

    fn add_square(&mut self, used: usize, weight: f64, column: &[f64; N]) {
        self.count += 1.0;
        for i in 0..used {
            for j in 0..=i {
                self.matrix[i][j] += weight * column[i] * column[j];
            }
        }
    }

    fn and(mut self, other: &Self) -> Self {
        self.count += other.count;
        for i in 0..N {
            self.right[i] += other.right[i];
            (0..=i).for_each(|j| self.matrix[i][j] += other.matrix[i][j]);
        }
        self
    }

    /// The step of the first `used` values from `at`; the others do not move. `None` without pixels, or if a number is
    /// not finite. Cholesky decomposition; the weights make the matrix positive definite.
    fn step(&self, used: usize, at: &[f64; N], weights: &[f64; N]) -> Option<[f64; N]> {
        if self.count == 0.0 {
            return None;
        }
        let (mut lower, mut y) = ([[0.0; N]; N], [0.0; N]);
        for i in 0..used {
            for j in 0..=i {
                let own = if i == j { weights[i] } else { 0.0 };
                let rest =
                    self.matrix[i][j] / self.count + own - (0..j).map(|k| lower[i][k] * lower[j][k]).sum::<f64>();
                lower[i][j] = if i == j { rest.max(own * 0.5).sqrt() } else { rest / lower[j][j] };
            }
            let right = self.right[i] / self.count - weights[i] * at[i];
            y[i] = (right - (0..i).map(|k| lower[i][k] * y[k]).sum::<f64>()) / lower[i][i];
        }
        let mut step = [0.0; N];
        for i in (0..used).rev() {
            step[i] = (y[i] - (i + 1..used).map(|k| lower[k][i] * step[k]).sum::<f64>()) / lower[i][i];
        }
        step.iter().all(|x| x.is_finite()).then_some(step)
    }
}

/// Differences of a corrected pixel to its photo with their weights, which are 0 where a value does not count.
fn differences(photo: &[u8], corrected: [f64; 3]) -> [(f64, f64); 3] {
    std::array::from_fn(|c| {
        let difference = f64::from(photo[c]) / 255.0 - corrected[c];
        let counts = !(photo[c] == u8::MAX && corrected[c] >= 1.0);
        (difference, if counts { 1.0 / difference.abs().max(SMALL_DIFFERENCE) } else { 0.0 })
    })
}

impl FittedPair<'_> {
    /// Sums over the sampled, unmasked pixels of some columns: `add` takes the position, the drawn colour and the photo.
    fn sum<S: Send>(
        &self,
        look: &Look,
        columns: Range<usize>,
        zero: impl Fn() -> S + Sync,
        add: impl Fn(&mut S, [f64; 2], [f64; 3], &[u8]) + Sync,
    ) -> Vec<S> {
        let (width, height, pixels) = (self.photo.width as usize, self.photo.height as usize, self.photo.pixels());
        let stride = ((columns.len() * height / SAMPLE) as f64).sqrt().max(1.0) as usize;
        let rows: Vec<usize> = (stride / 2..height).step_by(stride).collect();
        let of_row = |y: usize| {
            let mut sum = zero();
            for x in columns.clone().skip(stride / 2).step_by(stride) {
                let i = y * width + x;
                if self.photo.mask.as_ref().is_none_or(|mask| mask[i] != 0) {
                    let color = std::array::from_fn(|c| f64::from(self.drawn[c * pixels + i]));
                    let at = look.lens.at(x, y).map(f64::from);
                    add(&mut sum, at, color, &self.photo.rgb[3 * i..3 * i + 3]);
                }
            }
            sum
        };
        rows.into_par_iter().map(of_row).collect()
    }

    fn image_normal(&self, look: &Look, used: usize, columns: Range<usize>) -> Normal<IMAGE_VALUES> {
        let model = PixelModel::<f64>::new(&look.image, &look.falloff);
        let chroma: [f64; 8] = std::array::from_fn(|k| look.image[1 + k]);
        let rows = self.sum(
            look,
            columns,
            || Normal::ZERO,
            |sum, at, color, photo| {
                let corrected = model.of(at, color);
                let of_chroma =
                    if used > 1 { homography_columns(&chroma, model.lit(at, color)) } else { [[0.0; 3]; 8] };
                for (c, (difference, weight)) in differences(photo, corrected).into_iter().enumerate() {
                    let column = std::array::from_fn(|k| match k {
                        0 => std::f64::consts::LN_2 * corrected[c],
                        k => of_chroma[k - 1][c],
                    });
                    sum.add_square(used, weight, &column);
                    (0..used).for_each(|k| sum.right[k] += weight * column[k] * difference);
                }
            },
        );
        rows.iter().fold(Normal::ZERO, Normal::and)
    }

    /// The values of the photo that bring the picture closest, over the given columns of pixels, after `rounds` steps from
    /// those of `look`: the first `used` of them. The vignetting is that of `look`. `None` without pixels that count, or if
    /// the picture is not finite.
    pub fn image_values(
        &self,
        look: &Look,
        used: usize,
        columns: Range<usize>,
        rounds: usize,
    ) -> Option<[f64; IMAGE_VALUES]> {
        let weights = std::array::from_fn(|k| if k == 0 { EXPOSURE_WEIGHT } else { CHROMA_WEIGHT });
        let mut look = *look;
        for _ in 0..rounds {
            let step = self.image_normal(&look, used, columns.clone()).step(used, &look.image, &weights)?;
            // An exposure changes by a stop at most: further away the linear model does not hold.
            let limited = |k: usize| if k == 0 { step[0].clamp(-1.0, 1.0) } else { step[k] };
            look.image = bounded(std::array::from_fn(|k| look.image[k] + limited(k)))?;
        }
        Some(look.image)
    }

    /// The vignetting, by channel, that brings the picture closest under the values of `look`, by one step from its
    /// vignetting. The step ignores the coupling between channels, which is accurate enough for a step.
    pub fn falloff(&self, look: &Look) -> Option<[[f64; CHANNEL_VALUES]; 3]> {
        let model = PixelModel::<f64>::new(&look.image, &look.falloff);
        let rows = self.sum(
            look,
            0..self.photo.width as usize,
            || [Normal::ZERO; 3],
            |sums, at, color, photo| {
                let weighted = differences(photo, model.of(at, color));
                let lit = model.lit(at, color);
                let v = weighted.map(|(difference, weight)| weight * difference);
                let v = model.chroma.as_ref().map_or(v, |h| homography_back(h, lit, v));
                for (c, sum) in sums.iter_mut().enumerate() {
                    let column = falloff_columns(&look.falloff[c], at).map(|by| model.gain * color[c] * by);
                    sum.add_square(CHANNEL_VALUES, weighted[c].1, &column);
                    (0..CHANNEL_VALUES).for_each(|k| sum.right[k] += column[k] * v[c]);
                }
            },
        );
        let mut values = look.falloff;
        for (c, values) in values.iter_mut().enumerate() {
            let sum = rows.iter().fold(Normal::ZERO, |sum, row| sum.and(&row[c]));
            let step = sum.step(CHANNEL_VALUES, values, &[FALLOFF_WEIGHT; CHANNEL_VALUES])?;
            *values = bounded_channel(std::array::from_fn(|k| values[k] + step[k]))?;
        }
        Some(values)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::base::rng::mix64;
    use crate::photos::exposure::picture::LensPlane;
    use crate::scene::image::Image;

    const WIDTH: u32 = 64;
    const HEIGHT: u32 = 48;

    fn drawn() -> Vec<f32> {
        (0..3 * u64::from(WIDTH * HEIGHT)).map(|i| 0.1 + 0.3 * (mix64(i) % 1000) as f32 / 1000.0).collect()
    }

    /// The photo of `drawn` under a look, rounded to 8 bits.
    fn photo_of(drawn: &[f32], look: &Look) -> Target {
        let mut picture = drawn.to_vec();
        look.correct(&mut picture, WIDTH as usize, None);
        let image = Image { rgb: picture, ..Image::new(WIDTH, HEIGHT) };
        Target::new([WIDTH, HEIGHT], image.to_rgb8())
    }

    fn lens() -> LensPlane {
        LensPlane { centre: [32.0, 24.0], scale: 1.0 / 40.0 }
    }

    #[test]
    fn the_values_of_a_photo_are_found() {
        let drawn = drawn();
        for exposure in [-1.0, 0.8] {
            let image = [exposure, 0.05, 0.0, 0.02, 0.0, -0.05, -0.01, 0.0, 0.0];
            let look = Look { image, lens: lens(), ..Look::default() };
            let photo = photo_of(&drawn, &look);
            let pair = FittedPair { drawn: &drawn, photo: &photo };
            let start = Look { lens: lens(), ..Look::default() };
            let found = pair.image_values(&start, IMAGE_VALUES, 0..WIDTH as usize, 8).unwrap();
            // The weights take up to .06 stops from an exposure of a stop on a picture as dark as this one, and a tenth
            // from a white balance. Hue and saturation are pulled too far to be compared.
            assert!((found[0] - exposure).abs() < 0.06, "{found:?}");
            assert!((found[3] - 0.02).abs() < 0.002 && (found[6] + 0.01).abs() < 0.002, "{found:?}");
            let alone = pair.image_values(&start, 1, 0..WIDTH as usize, 8).unwrap();
            assert!((alone[0] - exposure).abs() < 0.06 && alone[1..] == [0.0; 8], "{alone:?}");
        }
    }

    #[test]
    fn masked_pixels_do_not_count_and_pictures_that_are_not_finite_have_no_values() {
        let mut drawn = drawn();
        let look = Look { image: [0.5, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0], ..Look::default() };
        let mut photo = photo_of(&drawn, &look);
        let of = |drawn: &[f32], photo: &Target| {
            FittedPair { drawn, photo }.image_values(&Look::default(), IMAGE_VALUES, 0..WIDTH as usize, 2)
        };
        let want = of(&drawn, &photo);
        let left = |i: usize| i % (WIDTH as usize) < 9;
        photo.mask = Some((0..(WIDTH * HEIGHT) as usize).map(|i| if left(i) { 0 } else { 255 }).collect());
        let masked = of(&drawn, &photo);
        assert!(want.is_some() && masked != want, "the mask has taken pixels away");
        (0..drawn.len()).filter(|&i| left(i)).for_each(|i| drawn[i] = f32::NAN);
        (0..photo.rgb.len()).filter(|&i| left(i / 3)).for_each(|i| photo.rgb[i] = 200);
        assert_eq!(of(&drawn, &photo), masked);
        photo.mask = None;
        assert_eq!(of(&drawn, &photo), None);
        photo.mask = Some(vec![0; (WIDTH * HEIGHT) as usize]);
        assert_eq!(of(&drawn, &photo), None);
    }

    #[test]
    fn vignetting_is_found_over_several_sightings() {
        let drawn = drawn();
        let falloff = [[-0.3, 0.0, 0.0, 0.0, 0.0]; 3];
        let photo = photo_of(&drawn, &Look { falloff, lens: lens(), ..Look::default() });
        let mut look = Look { lens: lens(), ..Look::default() };
        for _ in 0..4 {
            look.falloff = FittedPair { drawn: &drawn, photo: &photo }.falloff(&look).unwrap();
        }
        // a1, a2, a3 trade places under the weights, so compare the falloff where the photo has pixels.
        for at in [[0.2, 0.1], [0.5, 0.5], [0.7, 0.4]] {
            let [got, want] =
                [look.falloff[1], falloff[1]].map(|values| crate::photos::exposure::model::falloff(&values, at));
            assert!((got - want).abs() < 0.02, "{got}, not {want} at {at:?}");
        }
    }
}
