//! The squared error of each pixel of a picture, as statistics of rows weigh it.
//!
//! Not here: the sums of a whole picture (`image_loss`).

use super::image_pair::{ImagePair, Reference};
use crate::base::room;
use rayon::prelude::*;

/// Pixels per unit of parallel work.
const PIXELS_PER_TASK: usize = 16_384;

/// Squared difference of picture and reference, mean over the channels, `[height][width]`, into `out`, which is resized;
/// 0 for masked pixels. The picture is not clamped.
pub fn squared_errors(pair: &ImagePair<'_>, out: &mut Vec<f32>) {
    let pixels = pair.width * pair.height;
    room::resize(out, pixels, 0.0);
    out.par_chunks_mut(PIXELS_PER_TASK).enumerate().for_each(|(task, out)| {
        for (pixel, out) in (task * PIXELS_PER_TASK..).zip(out) {
            let mut sum = 0.0;
            for c in 0..3 {
                let reference = match pair.reference {
                    Reference::Bytes(bytes) => f32::from(bytes[3 * pixel + c]) / 255.0,
                    Reference::Planar(values) => values[c * pixels + pixel],
                };
                let difference = pair.rgb[c * pixels + pixel] - reference;
                sum += difference * difference;
            }
            let is_used = pair.mask.is_none_or(|mask| mask[pixel] != 0);
            *out = if is_used { sum / 3.0 } else { 0.0 };
        }
    });
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn errors_are_means_over_channels_and_masked_pixels_have_none() {
        // Two pixels, planar; the first differs by 1, 0 and 0.5 from the reference.
        let rgb = [1.0, 0.25, 0.0, 0.25, 0.5, 0.25];
        let bytes = [0, 0, 0, 255, 255, 255];
        let planar = [0.0, 1.0, 0.0, 1.0, 0.0, 1.0];
        for reference in [Reference::Bytes(&bytes), Reference::Planar(&planar)] {
            let pair = ImagePair { width: 2, height: 1, rgb: &rgb, reference, mask: None, clamp: false };
            let mut out = vec![9.0; 7];
            squared_errors(&pair, &mut out);
            assert_eq!(out, [1.25 / 3.0, 3.0 * 0.5625 / 3.0]);
            squared_errors(&ImagePair { mask: Some(&[0, 255]), ..pair }, &mut out);
            assert_eq!(out, [0.0, 3.0 * 0.5625 / 3.0]);
        }
    }
}
