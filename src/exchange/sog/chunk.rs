//! The files of one SOG: every attribute of some Gaussians as a picture, one pixel a Gaussian, and `meta.json`, which says what
//! the pixels mean.
//!
//! Not here: which Gaussians.
//!
//! | picture | red, green, blue, alpha |
//! | --- | --- |
//! | `means_l`, `means_u` | low and high byte of x, y, z between the least and the largest; by sign(x) ln(1 + abs(x)) |
//! | `scales` | codes of the log-scales |
//! | `quats` | the three smaller components, from -1/sqrt(2) to 1/sqrt(2); 252 and the number of the largest among w, x, y, z |
//! | `sh0` | codes of the constant band; opacity |
//! | `shN_labels` | low and high byte of the number of the Gaussian's harmonics in the palette |
//! | `shN_centroids` | the palette: 64 entries a row, a pixel for each coefficient; codes |
//!
//! Invariant: the bytes depend on the rows and their order alone.

use super::codebook::Codebook;
use super::palette::Palette;
use crate::base::error::{InputError, InputResult};
use crate::base::math::sigmoid;
use crate::base::whole_folder::PartFolder;
use crate::exchange::frames::ExportRow;
use image_webp::{ColorType, EncoderParams, WebPEncoder};
use serde_json::{Value, json};
use std::path::Path;

/// Name of the file that describes the pictures.
pub const META_FILE: &str = "meta.json";
/// Names of the pictures, in the order in which they are written.
pub const PICTURES: [&str; 7] =
    ["means_l.webp", "means_u.webp", "quats.webp", "scales.webp", "sh0.webp", "shN_centroids.webp", "shN_labels.webp"];
/// Rows for each entry of the palette, which then takes about as many bytes as the labels.
const ROWS_PER_ENTRY: usize = 16;
/// Entries in a row of the palette's picture.
pub const ENTRIES_PER_LINE: usize = 64;

/// Writes the files of `rows` into the folder `inside` of `folder`.
/// Errors: the disk fails.
pub fn write_chunk(folder: &mut PartFolder, inside: &Path, rows: &[ExportRow], sh_degree: u8) -> InputResult<()> {
    let bands = usize::from(sh_degree);
    let coefficients = (bands + 1) * (bands + 1) - 1;
    let reach = reach(rows);
    let mut pictures = means(rows, &reach);
    pictures.push(PackedPicture::of(rows, |row| quaternion(row.quat)));
    let scales = codebook(rows, |row| row.log_scales);
    pictures.push(PackedPicture::of(rows, |row| opaque(row.log_scales.map(|v| scales.code(v)))));
    let colours = codebook(rows, |row| row.sh0);
    let coded = |row: &ExportRow| {
        let [r, g, b] = row.sh0.map(|v| colours.code(v));
        [r, g, b, libm::rintf(255.0 * sigmoid(row.opacity)) as u8]
    };
    pictures.push(PackedPicture::of(rows, coded));
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": concat!("gsscale ", env!("CARGO_PKG_VERSION")) },
        "count": rows.len(),
        "means": { "mins": reach.map(|r| r[0]), "maxs": reach.map(|r| r[1]), "files": PICTURES[..2] },
        "quats": { "files": PICTURES[2..3] },
        "scales": { "codebook": scales.values(), "files": PICTURES[3..4] },
        "sh0": { "codebook": colours.values(), "files": PICTURES[4..5] },
    });
    if coefficients > 0 {
        meta["shN"] = harmonics(rows, bands, coefficients, &mut pictures);
    }
    for (name, picture) in PICTURES.iter().zip(&pictures) {
        let path = inside.join(name);
        let bytes = picture.webp().map_err(|e| InputError::new(&path, e, "report this as a bug"))?;
        folder.write(&path, &bytes)?;
    }
    folder.write(&inside.join(META_FILE), meta.to_string().as_bytes())
}

struct PackedPicture {
    width: usize,
    pixels: Vec<[u8; 4]>,
}

impl PackedPicture {
    /// One pixel a row, in a picture that is nearly square; sides are multiples of four, as viewers write them.
    fn of<T>(rows: &[T], pixel: impl Fn(&T) -> [u8; 4]) -> PackedPicture {
        let up4 = |n: usize| n.div_ceil(4) * 4;
        let width = up4(libm::ceil(libm::sqrt(rows.len() as f64)) as usize).max(4);
        let height = up4(rows.len().div_ceil(width)).max(4);
        let mut pixels: Vec<[u8; 4]> = rows.iter().map(pixel).collect();
        // Of the last pixel's values, so that the rest compresses.
        pixels.resize(width * height, pixels.last().copied().unwrap_or([0, 0, 0, 255]));
        PackedPicture { width, pixels }
    }

    /// The shorter one of two lossless encodings.
    fn webp(&self) -> Result<Vec<u8>, String> {
        let height = self.pixels.len() / self.width;
        let is_opaque = self.pixels.iter().all(|pixel| pixel[3] == 255);
        let (color, bytes): (_, Vec<u8>) = match is_opaque {
            true => (ColorType::Rgb8, self.pixels.iter().flat_map(|&[r, g, b, _]| [r, g, b]).collect()),
            false => (ColorType::Rgba8, self.pixels.as_flattened().to_vec()),
        };
        let encoded = |use_predictor_transform: bool| {
            let mut out = Vec::new();
            let mut encoder = WebPEncoder::new(&mut out);
            let mut params = EncoderParams::default();
            params.use_predictor_transform = use_predictor_transform;
            encoder.set_params(params);
            let done = encoder.encode(&bytes, self.width as u32, height as u32, color);
            done.map(|()| out).map_err(|e| e.to_string())
        };
        let (plain, predicted) = (encoded(false)?, encoded(true)?);
        Ok(if predicted.len() < plain.len() { predicted } else { plain })
    }
}

fn opaque([r, g, b]: [u8; 3]) -> [u8; 4] {
    [r, g, b, 255]
}

/// sign(x) ln(1 + |x|), which keeps small distances near the origin.
fn log_position(x: f32) -> f64 {
    let log = libm::log1p(f64::from(x).abs());
    if x < 0.0 { -log } else { log }
}

/// Least and largest of x, y, z, as logarithms.
fn reach(rows: &[ExportRow]) -> [[f64; 2]; 3] {
    [0, 1, 2].map(|i| {
        let at = rows.iter().map(|row| log_position(row.position[i]));
        let (least, most) = at.fold((f64::INFINITY, f64::NEG_INFINITY), |(a, b), x| (a.min(x), b.max(x)));
        if least <= most { [least, most] } else { [0.0; 2] }
    })
}

fn means(rows: &[ExportRow], reach: &[[f64; 2]; 3]) -> Vec<PackedPicture> {
    let fixed = |row: &ExportRow| {
        [0, 1, 2].map(|i| {
            let [least, most] = reach[i];
            let share = if most > least { (log_position(row.position[i]) - least) / (most - least) } else { 0.0 };
            (libm::rint(65535.0 * share) as u16).to_le_bytes()
        })
    };
    [0, 1].map(|byte| PackedPicture::of(rows, |row| opaque(fixed(row).map(|bytes| bytes[byte])))).into()
}

/// The largest component becomes positive: a quaternion and its negative are one rotation.
fn quaternion(q: [f32; 4]) -> [u8; 4] {
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let sign = if q[largest] < 0.0 { -1.0 } else { 1.0 };
    let mut pixel = [0; 4];
    let others = (0..4).filter(|&i| i != largest);
    for (byte, i) in pixel.iter_mut().zip(others) {
        let share = 0.5 + f64::from(q[i]) * sign * std::f64::consts::FRAC_1_SQRT_2;
        *byte = libm::rint(255.0 * share) as u8;
    }
    pixel[3] = 252 + largest as u8;
    pixel
}

fn codebook(rows: &[ExportRow], values: impl Fn(&ExportRow) -> [f32; 3]) -> Codebook {
    Codebook::of(&mut rows.iter().flat_map(values).collect::<Vec<f32>>())
}

/// Adds palette and labels to the pictures; returns what describes them.
fn harmonics(rows: &[ExportRow], bands: usize, coefficients: usize, pictures: &mut Vec<PackedPicture>) -> Value {
    let width = 3 * coefficients;
    let values: Vec<f32> = rows.iter().flat_map(|row| &row.sh_n[..width]).copied().collect();
    let wanted = rows.len().div_ceil(ROWS_PER_ENTRY).next_multiple_of(ENTRIES_PER_LINE).min(1 << 16);
    let palette = Palette::of(&values, width, wanted);
    let codes = Codebook::of(&mut palette.centres.clone());
    let mut pixels: Vec<[u8; 4]> =
        palette.centres.chunks_exact(3).map(|rgb| opaque([0, 1, 2].map(|i| codes.code(rgb[i])))).collect();
    let line = ENTRIES_PER_LINE * coefficients;
    pixels.resize(pixels.len().next_multiple_of(line).max(line), [0, 0, 0, 255]);
    pictures.push(PackedPicture { width: line, pixels });
    pictures.push(PackedPicture::of(&palette.labels, |label| {
        let [low, high] = label.to_le_bytes();
        [low, high, 0, 255]
    }));
    json!({ "count": palette.centres.len() / width, "bands": bands, "codebook": codes.values(), "files": PICTURES[5..] })
}
