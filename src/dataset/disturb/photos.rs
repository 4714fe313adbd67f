//! Disturbances of photos, and their files.

use super::{Disturbance, Draw, is_chosen, stream};
use crate::base::error::{InputError, InputResult};
use crate::base::rng::Stream;
use crate::scene::image::Target;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngEncoder;
use image::{ExtendedColorType, ImageEncoder, RgbImage};

/// Sides of a box, as shares of the longer side of the photo.
const BOX_SIDES: [f64; 2] = [0.04, 0.12];
/// Value of the boxes.
const GREY: u8 = 128;
/// Standard deviation of a blur, as a share of the width of the photo.
const BLUR: f32 = 0.01;

/// A photo as the bytes of its file.
pub(super) struct Encoded {
    pub bytes: Vec<u8>,
    /// The mask as a PNG.
    pub mask: Option<Vec<u8>>,
}

/// The photo of training view `number`, disturbed.
pub(super) fn disturbed(
    mut photo: Target,
    disturbance: &Disturbance,
    seed: u64,
    number: usize,
) -> InputResult<Encoded> {
    let mut draws = stream(seed, Draw::Photo, number);
    match *disturbance {
        Disturbance::Exposure { stops } => {
            let gain = libm::exp2(draws.range(-stops, stops));
            scale(&mut photo, [gain; 3]);
        }
        Disturbance::WhiteBalance { stops } => {
            let gain = libm::exp2(draws.range(-stops, stops));
            scale(&mut photo, [gain, 1.0, 1.0 / gain]);
        }
        Disturbance::Boxes { count, are_masked } => {
            (0..count).for_each(|_| add_box(&mut photo, are_masked, &mut draws))
        }
        Disturbance::Blurred { one_in } if is_chosen(seed, number, one_in) => blur(&mut photo),
        _ => {}
    }
    let bytes = match *disturbance {
        Disturbance::Jpeg { quality } => {
            let mut bytes = Vec::new();
            JpegEncoder::new_with_quality(&mut bytes, quality)
                .encode(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)
                .map_err(|e| not_encoded(&e))?;
            bytes
        }
        _ => png(&photo.rgb, photo.width, photo.height, ExtendedColorType::Rgb8)?,
    };
    let mask =
        photo.mask.as_ref().map(|mask| png(mask, photo.width, photo.height, ExtendedColorType::L8)).transpose()?;
    Ok(Encoded { bytes, mask })
}

/// Multiplies the channels, and clamps.
fn scale(photo: &mut Target, gains: [f64; 3]) {
    for (i, byte) in photo.rgb.iter_mut().enumerate() {
        *byte = (f64::from(*byte) * gains[i % 3]).round().min(255.0) as u8;
    }
}

/// Paints one box, cut at the border of the photo.
fn add_box(photo: &mut Target, is_masked: bool, draws: &mut Stream) {
    let (width, height) = (photo.width as usize, photo.height as usize);
    let longest = width.max(height) as f64;
    let [wide, high] = [0, 1].map(|_| (draws.range(BOX_SIDES[0], BOX_SIDES[1]) * longest).max(1.0) as usize);
    let [x, y] = [width, height].map(|side| draws.below(side as u64) as usize);
    if is_masked {
        photo.mask.get_or_insert_with(|| vec![255; width * height]);
    }
    for row in y..height.min(y + high) {
        let pixels = row * width + x..row * width + width.min(x + wide);
        photo.rgb[3 * pixels.start..3 * pixels.end].fill(GREY);
        if let Some(mask) = photo.mask.as_mut().filter(|_| is_masked) {
            mask[pixels].fill(0);
        }
    }
}

fn blur(photo: &mut Target) {
    let rgb = std::mem::take(&mut photo.rgb);
    // Photo and size belong together, so there is a picture.
    if let Some(picture) = RgbImage::from_raw(photo.width, photo.height, rgb) {
        photo.rgb = image::imageops::blur(&picture, (BLUR * photo.width as f32).max(0.5)).into_raw();
    }
}

/// A picture as a PNG.
fn png(pixels: &[u8], width: u32, height: u32, color: ExtendedColorType) -> InputResult<Vec<u8>> {
    let mut bytes = Vec::new();
    PngEncoder::new(&mut bytes).write_image(pixels, width, height, color).map_err(|e| not_encoded(&e))?;
    Ok(bytes)
}

fn not_encoded(e: &image::ImageError) -> InputError {
    InputError::new("a photo", format!("compressing failed: {e}"), "choose smaller photos with --max-resolution")
}

#[cfg(test)]
#[allow(clippy::unwrap_used)] // a panic is a failed test
mod tests {
    use super::*;

    fn photo() -> Target {
        let rgb = (0..3 * 40 * 30).map(|i| (i * 7 % 200) as u8).collect();
        Target { width: 40, height: 30, rgb, mask: None }
    }

    fn read(encoded: &Encoded) -> Vec<u8> {
        image::load_from_memory(&encoded.bytes).unwrap().to_rgb8().into_raw()
    }

    #[test]
    fn boxes_are_grey_and_masked_where_asked_and_white_balance_keeps_green() {
        let of = |are_masked| disturbed(photo(), &Disturbance::Boxes { count: 5, are_masked }, 3, 5).unwrap();
        let (plain, masked) = (of(false), of(true));
        assert!(plain.mask.is_none() && read(&plain) == read(&masked));
        let mask = image::load_from_memory(&masked.mask.clone().unwrap()).unwrap().to_luma8().into_raw();
        let changed = |i: usize| read(&plain)[3 * i..3 * i + 3] != photo().rgb[3 * i..3 * i + 3];
        assert!((0..mask.len()).all(|i| !changed(i) || mask[i] == 0), "what is painted is masked");
        let balanced = read(&disturbed(photo(), &Disturbance::WhiteBalance { stops: 0.5 }, 3, 5).unwrap());
        assert!(balanced.iter().zip(&photo().rgb).skip(1).step_by(3).all(|(a, b)| a == b), "green stays");
        let boxes = mask.iter().filter(|&&byte| byte == 0).count();
        assert!((5..600).contains(&boxes), "{boxes} pixels");
    }
}
