//! Pictures of a report as data URIs. An evaluation writes render and photo side by side into one file; this module
//! reads the file row by row, shrinks both halves to the means of areas, and computes a difference map.
//!
//! Invariants: 1. sizes are checked before decoding, and the decoder receives the pixel chunks only; 2. memory holds some
//! rows of the file, and pictures of at most `WIDTH_MAX` columns.

use crate::base::error::{InputError, InputResult};
use crate::base::png_pixels::{PNG_BUFFERS, PixelChunks};
use base64::Engine;
use base64::engine::general_purpose::STANDARD;
use image::RgbImage;
use image::codecs::jpeg::JpegEncoder;
use png::{Decoder, DecodingError, Limits, Transformations};
use std::fs::File;
use std::io::BufReader;
use std::ops::Range;
use std::path::Path;

/// Widest picture in a page, pixels.
const WIDTH_MAX: u32 = 800;
const JPEG_QUALITY: u8 = 88;
/// Widest and highest file that is read: two of the widest accepted photos side by side.
const SIDES_MAX: [u32; 2] = [1 << 17, 1 << 16];
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
    let (width, height) = ((info.width / 2) as usize, info.height as usize);
    if info.width > SIDES_MAX[0] || info.height > SIDES_MAX[1] || info.interlaced {
        return Err(refused(format!(
            "is {} x {} pixels or interlaced, as no evaluation writes it",
            info.width, info.height
        )));
    }
    if width == 0 || height == 0 {
        return Err(refused(String::from("is empty")));
    }
    let [mut render, mut photo] = [Shrunk::new(width, height), Shrunk::new(width, height)];
    let samples = color.samples();
    for y in 0..height {
        let Some(row) = reader.next_row().map_err(bad)? else { return Err(refused(String::from("is cut short"))) };
        let (left, right) = row.data().split_at(width * samples);
        render.add_row(y, left, samples);
        photo.add_row(y, right, samples);
    }
    let (render, photo) = (render.picture, photo.picture);
    let difference = difference(&render, &photo);
    let uri = |picture| data_uri(picture).map_err(|e| refused(format!("cannot be shown: {e}")));
    Ok(ViewPictures { render: uri(&render)?, photo: uri(&photo)?, difference: uri(&difference)? })
}

/// A picture that is shrunk to at most [`WIDTH_MAX`] columns while its rows arrive: each pixel is the mean of its area.
struct Shrunk {
    /// Size of the rows that arrive.
    from: [usize; 2],
    /// For each part of a row: the pixel, the column of `picture`, and their overlap.
    columns: Vec<(usize, usize, u64)>,
    picture: RgbImage,
    /// Weighted sums of the row of `picture` that is being made; the weights of a pixel have the sum `from[0] * from[1]`.
    sums: Vec<u64>,
}

impl Shrunk {
    fn new(width: usize, height: usize) -> Shrunk {
        let to = width.min(WIDTH_MAX as usize);
        Shrunk::with_size([width, height], [to, (height * to / width).max(1)])
    }

    fn with_size([width, height]: [usize; 2], [to_width, to_height]: [usize; 2]) -> Shrunk {
        let of_pixel = |x: usize| shares(x, width, to_width).map(move |(to_x, weight)| (x, to_x, weight));
        let picture = RgbImage::new(to_width as u32, to_height as u32);
        let columns = (0..width).flat_map(of_pixel).collect();
        Shrunk { from: [width, height], columns, sums: vec![0; 3 * to_width], picture }
    }

    /// Adds row `y`, of `samples` bytes a pixel: gray or RGB, with or without alpha.
    fn add_row(&mut self, y: usize, row: &[u8], samples: usize) {
        let ([width, height], (to_width, to_height)) = (self.from, self.picture.dimensions());
        for (to_y, row_weight) in shares(y, height, to_height as usize) {
            for &(x, to_x, weight) in &self.columns {
                let pixel = &row[samples * x..samples * (x + 1)];
                for (c, sum) in self.sums[3 * to_x..3 * to_x + 3].iter_mut().enumerate() {
                    *sum += row_weight * weight * u64::from(pixel[if samples < 3 { 0 } else { c }]);
                }
            }
            if (y + 1) * to_height as usize >= (to_y + 1) * height {
                let whole = (width * height) as u64;
                let shown = self.picture.as_mut().chunks_exact_mut(3 * to_width as usize).nth(to_y);
                for (shown, sum) in shown.into_iter().flatten().zip(&mut self.sums) {
                    *shown = ((*sum + whole / 2) / whole) as u8;
                    *sum = 0;
                }
            }
        }
    }
}

/// The parts of `to` equal parts of a line that item `at` of `from` equal ones overlaps, with the length of each overlap. Lengths are in
/// units of `1 / (from * to)` of the line, so that the overlaps of a part have the sum `from`. `to` is at most `from`.
fn shares(at: usize, from: usize, to: usize) -> impl Iterator<Item = (usize, u64)> {
    let item: Range<usize> = at * to..(at + 1) * to;
    (item.start / from..=(item.end - 1) / from).map(move |part| {
        let overlap = item.end.min((part + 1) * from) - item.start.max(part * from);
        (part, overlap as u64)
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
    fn a_shrunk_picture_has_the_means_of_areas() {
        // 5 x 2 pixels on 2 x 1: WIDTH_MAX does not shrink so small a picture, so the size is set by hand.
        let mut shrunk = Shrunk::with_size([5, 2], [2, 1]);
        for y in 0..2 {
            let row: Vec<u8> = (0..5).flat_map(|x| [10 * x, 100 + 50 * y as u8, 7]).collect();
            shrunk.add_row(y, &row, 3);
        }
        // (0 + 10 + 20 / 2) / 2.5 and (20 / 2 + 30 + 40) / 2.5.
        assert_eq!(shrunk.picture.as_raw(), &[8, 125, 7, 32, 125, 7]);
        let mut same = Shrunk::new(3, 1);
        same.add_row(0, &[1, 200, 255], 1);
        assert_eq!(same.picture.as_raw(), &[1, 1, 1, 200, 200, 200, 255, 255, 255]);
        assert_eq!(
            (Shrunk::new(1601, 901).picture.dimensions(), Shrunk::new(801, 1).picture.height()),
            ((800, 450), 1)
        );
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
