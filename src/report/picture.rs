//! Pictures of a report as data URIs. An evaluation writes render and photo side by side into one file; this module
//! cuts the file in two, shrinks the halves and computes a difference map.
//!
//! Invariant: sizes are checked before decoding, and the decoder receives the pixel chunks only.

use crate::base::error::{InputError, InputResult};
use crate::base::png_pixels::{PNG_BUFFERS, PixelChunks};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::codecs::jpeg::JpegEncoder;
use image::codecs::png::PngDecoder;
use image::imageops::{FilterType, crop_imm, resize};
use image::{DynamicImage, ImageDecoder, Limits, RgbImage};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Widest picture in a page, pixels.
const WIDTH_MAX: u32 = 800;
const JPEG_QUALITY: u8 = 88;
/// Limit of a decoded file, bytes.
const DECODED_MAX: u64 = 1 << 30;
/// Differences of this many levels (of 255) and more are white.
const FULL_DIFFERENCE: f32 = 64.0;

/// The pictures of a view as data URIs.
pub struct ViewPictures {
    /// The render.
    pub render: String,
    /// The photo.
    pub photo: String,
    /// The difference map: black for no difference, then red, yellow, and white from a quarter of the range.
    pub difference: String,
}

/// Reads a PNG whose left half is the render and whose right half is the photo.
///
/// # Errors
/// The file cannot be read or decoded, or exceeds the size limit.
pub fn view_pictures(path: &Path) -> InputResult<ViewPictures> {
    let bad = |e: image::ImageError| InputError::new(path, format!("is not a picture: {e}"), "evaluate the run again");
    let io = |e: std::io::Error| InputError::io(path, "reading the picture", &e);
    let file = File::open(path).map_err(io)?;
    let mut limits = Limits::default();
    (limits.max_image_width, limits.max_image_height) = (Some(1 << 16), Some(1 << 15));
    limits.max_alloc = Some(PNG_BUFFERS);
    let pixels = PixelChunks::new(BufReader::new(file)).map_err(io)?;
    let decoder = PngDecoder::with_limits(pixels, limits).map_err(bad)?;
    if decoder.total_bytes() > DECODED_MAX {
        return Err(InputError::new(
            path,
            "exceeds the size limit of a view (1 GiB decoded)",
            "evaluate the run again",
        ));
    }
    let both = DynamicImage::from_decoder(decoder).map_err(bad)?.into_rgb8();
    let (width, height) = (both.width() / 2, both.height());
    if width == 0 || height == 0 {
        return Err(InputError::new(path, "is empty", "evaluate the run again"));
    }
    let half = |x: u32| {
        let half = crop_imm(&both, x, 0, width, height).to_image();
        match width > WIDTH_MAX {
            true => resize(&half, WIDTH_MAX, (height * WIDTH_MAX / width).max(1), FilterType::Triangle),
            false => half,
        }
    };
    let (render, photo) = (half(0), half(width));
    let difference = difference(&render, &photo);
    Ok(ViewPictures {
        render: data_uri(&render).map_err(bad)?,
        photo: data_uri(&photo).map_err(bad)?,
        difference: data_uri(&difference).map_err(bad)?,
    })
}

fn difference(a: &RgbImage, b: &RgbImage) -> RgbImage {
    RgbImage::from_fn(a.width(), a.height(), |x, y| {
        let (p, q) = (a.get_pixel(x, y).0, b.get_pixel(x, y).0);
        let mean = (0..3).map(|c| f32::from(p[c].abs_diff(q[c]))).sum::<f32>() / 3.0;
        let heat = (mean / FULL_DIFFERENCE).min(1.0) * 3.0;
        image::Rgb([0.0, 1.0, 2.0].map(|from: f32| ((heat - from).clamp(0.0, 1.0) * 255.0) as u8))
    })
}

fn data_uri(picture: &RgbImage) -> image::ImageResult<String> {
    let mut bytes = Vec::new();
    JpegEncoder::new_with_quality(&mut bytes, JPEG_QUALITY).encode_image(picture)?;
    Ok(format!("data:image/jpeg;base64,{}", STANDARD.encode(bytes)))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn differences_go_from_black_to_white() {
        let a = RgbImage::from_pixel(3, 1, image::Rgb([10, 20, 30]));
        let mut b = a.clone();
        b.put_pixel(1, 0, image::Rgb([42, 52, 62]));
        b.put_pixel(2, 0, image::Rgb([255, 255, 255]));
        let map = difference(&a, &b);
        assert_eq!(map.get_pixel(0, 0).0, [0, 0, 0]);
        assert_eq!(map.get_pixel(1, 0).0, [255, 127, 0]);
        assert_eq!(map.get_pixel(2, 0).0, [255, 255, 255]);
    }
}
