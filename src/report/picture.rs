//! Pictures of a report as data URIs. An evaluation writes render and photo side by side into one file; this module
//! reads the file row by row, shrinks both halves to the means of areas, and computes a difference map.
//!
//! Invariants: 1. sizes are checked before decoding, and the decoder receives the pixel chunks only; 2. memory holds some
//! rows of the file, and pictures of at most `WIDTH_MAX` columns.

use crate::base::error::{InputError, InputResult};
use crate::base::png_pixels::{PNG_BUFFERS, PixelChunks};
use crate::dataset::resize::{AreaResizer, LARGEST_SIDE, Size};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use png::{Decoder, DecodingError, Limits, Transformations};
use std::fs::File;
use std::io::BufReader;
use std::path::Path;

/// Widest picture in a page, pixels.
const WIDTH_MAX: u32 = 800;
const JPEG_QUALITY: u8 = 88;
/// Widest and highest file that is read: two of the widest accepted photos side by side.
const SIDES_MAX: [u32; 2] = [2 * LARGEST_SIDE, LARGEST_SIDE];
/// Differences of this many levels (of 255) and more are white.
const FULL_DIFFERENCE: f32 = 64.0;

pub struct ViewPictures {
    pub render: String,
    pub photo: String,
    /// The difference map: black for no difference, then red, yellow, and white from a quarter of the range.
    pub difference: String,
}

/// Reads a PNG whose left half is the render and whose right half is the photo.
/// Errors: the file cannot be read or decoded, or exceeds the size limit.
pub fn view_pictures(path: &Path) -> InputResult<ViewPictures> {
    let refused = |problem: String| InputError::new(path, problem, "evaluate the run again");
    let bad = |e: DecodingError| refused(format!("is not a picture: {e}"));
    let io = |e: std::io::Error| InputError::io(path, "reading the picture", &e);
    let pixels = PixelChunks::new(BufReader::new(File::open(path).map_err(io)?)).map_err(io)?;
    let mut decoder = Decoder::new_with_limits(pixels, Limits { bytes: PNG_BUFFERS as usize });
    decoder.set_transformations(Transformations::normalize_to_color8());
    let mut reader = decoder.read_info().map_err(bad)?;
    let (info, (color, _)) = (reader.info(), reader.output_color_type());
    let size = (info.width / 2, info.height);
    if info.width > SIDES_MAX[0] || info.height > SIDES_MAX[1] || info.interlaced {
        return Err(refused(format!(
            "is {} x {} pixels or interlaced, as no evaluation writes it",
            info.width, info.height
        )));
    }
    if size.0 == 0 || size.1 == 0 {
        return Err(refused(String::from("is empty")));
    }
    let shown = shown_size(size);
    let mut halves = [(); 2].map(|()| AreaResizer::new(3, size, shown, 1));
    let samples = color.samples();
    for _ in 0..size.1 {
        let Some(row) = reader.next_row().map_err(bad)? else { return Err(refused(String::from("is cut short"))) };
        for (half, row) in halves.iter_mut().zip(row.data().chunks_exact(size.0 as usize * samples)) {
            half.push_row(row.chunks_exact(samples).map(rgb).collect::<Vec<_>>().as_flattened());
        }
    }
    let picture = |half: AreaResizer| {
        RgbImage::from_raw(shown.0, shown.1, half.finish()).ok_or_else(|| refused(String::from("is too large")))
    };
    let [render, photo] = halves.map(picture);
    let (render, photo) = (render?, photo?);
    let difference = difference(&render, &photo);
    let uri = |picture| data_uri(picture).map_err(|e| refused(format!("cannot be shown: {e}")));
    Ok(ViewPictures { render: uri(&render)?, photo: uri(&photo)?, difference: uri(&difference)? })
}

/// The channels of a pixel of gray or RGB, with or without alpha.
fn rgb(pixel: &[u8]) -> [u8; 3] {
    [0, 1, 2].map(|c| pixel[if pixel.len() < 3 { 0 } else { c }])
}

/// A picture of at most [`WIDTH_MAX`] columns: the size to which one of size `from` is shrunk.
fn shown_size((width, height): Size) -> Size {
    let to = width.min(WIDTH_MAX);
    (to, (u64::from(height) * u64::from(to) / u64::from(width)).max(1) as u32)
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
    fn pixels_are_rgb_and_wide_pictures_shrink() {
        assert_eq!([&[7][..], &[7, 0], &[1, 2, 3], &[1, 2, 3, 0]].map(rgb), [[7; 3], [7; 3], [1, 2, 3], [1, 2, 3]]);
        assert_eq!([(3, 1), (1601, 901), (801, 1)].map(shown_size), [(3, 1), (800, 450), (800, 1)]);
    }

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
