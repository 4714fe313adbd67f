//! Reads one SOG: the pictures that [`super::chunk`] describes, back into rows.
//!
//! Invariants: 1. a picture is decoded only if its size fits the number of rows, which [`ROWS_MAX`] limits; 2. every value is
//! finite; 3. no name leaves the folder of `meta.json`.

use super::codebook::CODES;
use crate::base::error::{InputError, InputResult};
use crate::base::math::logit;
use crate::base::whole_file::folder_of;
use crate::scene::columns::{Column, Columns, sh_n_width};
use image_webp::WebPDecoder;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::io::Cursor;
use std::path::{Component, Path, PathBuf};

/// Most rows of a SOG. The pictures of so many take 64 MiB.
const ROWS_MAX: usize = 1 << 22;
/// Entries in a row of the palette's picture.
const ENTRIES_PER_LINE: usize = 64;
/// Largest logarithm of a position: f32 holds its exponential.
const LOG_MAX: f64 = 88.0;
/// Opacities of 0 and 1, whose logits are infinite, become this and 1 less this.
const OPACITY_MIN: f32 = 1e-6;

#[derive(Deserialize)]
struct Meta {
    version: u32,
    count: usize,
    means: Means,
    quats: Uncoded,
    scales: Coded,
    sh0: Coded,
    #[serde(rename = "shN")]
    sh_n: Option<Harmonics>,
}

#[derive(Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Uncoded {
    files: [String; 1],
}

#[derive(Deserialize)]
struct Coded {
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct Harmonics {
    count: usize,
    bands: u8,
    codebook: Vec<f32>,
    /// Palette, labels.
    files: [String; 2],
}

/// An error of a file that is not what it should be.
pub(super) fn malformed(path: &Path, problem: impl Into<String>) -> InputError {
    InputError::new(path, problem, "export the scene again: gsscale-ckpt export RUN --out DIR/lod-meta.json")
}

/// Reads a JSON file.
///
/// # Errors
/// The file cannot be read, or lacks a part.
pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> InputResult<T> {
    serde_json::from_slice(&read_file(path)?).map_err(|e| malformed(path, format!("cannot be parsed: {e}")))
}

/// The file that `name`, a path in `from`, names in the folder of `from`.
///
/// # Errors
/// The path leads out of the folder.
pub(super) fn named_in(from: &Path, name: &str) -> InputResult<PathBuf> {
    let inside = Path::new(name);
    match !name.is_empty() && inside.components().all(|part| matches!(part, Component::Normal(_))) {
        true => Ok(folder_of(from).join(inside)),
        false => Err(malformed(from, format!("names the file '{name}', which is not in its folder"))),
    }
}

/// Reads the SOG of the `meta.json` at `path`.
///
/// # Errors
/// A file cannot be read, or is not as the format says.
pub fn read_chunk(path: &Path) -> InputResult<Columns> {
    let meta: Meta = read_json(path)?;
    if meta.version != 2 || meta.count > ROWS_MAX {
        let problem =
            format!("{} Gaussians of version {}; at most {ROWS_MAX} of version 2 are read", meta.count, meta.version);
        return Err(malformed(path, problem));
    }
    let pixels = |name: &str| pixels(&named_in(path, name)?, meta.count);
    let degree = meta.sh_n.as_ref().map_or(0, |sh| sh.bands);
    if degree > 3 {
        return Err(malformed(path, format!("{degree} bands of harmonics; at most 3 are read")));
    }
    let mut columns = Columns::zeros(meta.count, degree);
    read_means(path, &meta.means, [&pixels(&meta.means.files[0])?, &pixels(&meta.means.files[1])?], &mut columns)?;
    let quats = pixels(&meta.quats.files[0])?;
    for (quat, &pixel) in columns.quats.as_chunks_mut::<4>().0.iter_mut().zip(&quats) {
        *quat = quaternion(pixel).ok_or_else(|| malformed(path, "a quaternion names no component"))?;
    }
    let (scales, sizes) = (codebook(path, &meta.scales.codebook)?, pixels(&meta.scales.files[0])?);
    for (log_scales, pixel) in columns.scales.as_chunks_mut::<3>().0.iter_mut().zip(&sizes) {
        *log_scales = [0, 1, 2].map(|i| scales[usize::from(pixel[i])]);
    }
    let (colours, sh0) = (codebook(path, &meta.sh0.codebook)?, pixels(&meta.sh0.files[0])?);
    for (row, pixel) in sh0.iter().take(meta.count).enumerate() {
        let rgb = [0, 1, 2].map(|i| colours[usize::from(pixel[i])]);
        columns.row_mut(Column::Sh0, row).copy_from_slice(&rgb);
        columns.opacities[row] = logit((f32::from(pixel[3]) / 255.0).clamp(OPACITY_MIN, 1.0 - OPACITY_MIN));
    }
    if let Some(sh) = meta.sh_n.filter(|sh| sh.bands > 0) {
        read_harmonics(path, &sh, &pixels(&sh.files[1])?, &mut columns)?;
    }
    Ok(columns)
}

fn read_means(path: &Path, means: &Means, [low, high]: [&[[u8; 4]]; 2], columns: &mut Columns) -> InputResult<()> {
    if !means.mins.iter().chain(&means.maxs).all(|log| log.abs() <= LOG_MAX) {
        return Err(malformed(path, "a position is beyond the range of numbers"));
    }
    for (mean, (low, high)) in columns.means.as_chunks_mut::<3>().0.iter_mut().zip(low.iter().zip(high)) {
        *mean = [0, 1, 2].map(|i| {
            let share = f64::from(u16::from_le_bytes([low[i], high[i]])) / 65535.0;
            let log = means.mins[i] + share * (means.maxs[i] - means.mins[i]);
            libm::copysign(libm::expm1(log.abs()), log) as f32
        });
    }
    Ok(())
}

/// Reads the bands above the constant one: a label for each row, and the palette.
fn read_harmonics(path: &Path, sh: &Harmonics, labels: &[[u8; 4]], columns: &mut Columns) -> InputResult<()> {
    let width = sh_n_width(sh.bands);
    let coefficients = width / 3;
    if sh.count == 0 || sh.count > 1 << 16 {
        return Err(malformed(path, format!("a palette of {} entries", sh.count)));
    }
    let book = codebook(path, &sh.codebook)?;
    let palette = pixels(&named_in(path, &sh.files[0])?, sh.count.next_multiple_of(ENTRIES_PER_LINE) * coefficients)?;
    for (sh_n, label) in columns.sh_n.chunks_exact_mut(width).zip(labels) {
        let label = usize::from(u16::from_le_bytes([label[0], label[1]]));
        if label >= sh.count {
            return Err(malformed(path, format!("label {label} of a palette of {} entries", sh.count)));
        }
        // Lines hold whole entries, so the entries follow each other.
        let entry = &palette[label * coefficients..][..coefficients];
        for (values, pixel) in sh_n.as_chunks_mut::<3>().0.iter_mut().zip(entry) {
            *values = [0, 1, 2].map(|i| book[usize::from(pixel[i])]);
        }
    }
    Ok(())
}

/// The quaternion of a pixel, w first; `None` if its alpha names no component.
fn quaternion(pixel: [u8; 4]) -> Option<[f32; 4]> {
    let largest = usize::from(pixel[3].checked_sub(252)?);
    let mut quat = [0.0f64; 4];
    for (&byte, i) in pixel.iter().zip((0..4).filter(|&i| i != largest)) {
        quat[i] = (f64::from(byte) / 255.0 - 0.5) * std::f64::consts::SQRT_2;
    }
    quat[largest] = libm::sqrt((1.0 - quat.iter().map(|v| v * v).sum::<f64>()).max(0.0));
    Some(quat.map(|v| v as f32))
}

fn codebook<'a>(path: &Path, values: &'a [f32]) -> InputResult<&'a [f32; CODES]> {
    let values: Option<&[f32; CODES]> = values.try_into().ok();
    let finite = values.filter(|values| values.iter().all(|v| v.is_finite()));
    finite.ok_or_else(|| malformed(path, format!("a codebook needs {CODES} finite values")))
}

/// RGBA pixels of a lossless picture of at least `least` pixels.
fn pixels(path: &Path, least: usize) -> InputResult<Vec<[u8; 4]>> {
    let wrong = |e: image_webp::DecodingError| malformed(path, format!("cannot be decoded: {e}"));
    let mut decoder = WebPDecoder::new(Cursor::new(read_file(path)?)).map_err(wrong)?;
    let (width, height) = decoder.dimensions();
    let count = width as usize * height as usize;
    // A picture that is nearly square, and the palette's, have a few lines more than their values need.
    let most = 2 * least + (1 << 16);
    if decoder.is_lossy() || decoder.is_animated() || !(least..=most).contains(&count) {
        let problem = format!("{width} x {height} pixels; a lossless picture of {least} to {most} pixels was expected");
        return Err(malformed(path, problem));
    }
    let channels = if decoder.has_alpha() { 4 } else { 3 };
    let mut bytes = vec![0; count * channels];
    decoder.read_image(&mut bytes).map_err(wrong)?;
    Ok(match channels {
        4 => bytes.as_chunks::<4>().0.to_vec(),
        _ => bytes.as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, u8::MAX]).collect(),
    })
}

/// The bytes of a regular file.
fn read_file(path: &Path) -> InputResult<Vec<u8>> {
    let io = |e: std::io::Error| InputError::io(path, "reading", &e);
    // Checked before opening: opening a pipe would block until somebody writes to it.
    if !std::fs::metadata(path).map_err(io)?.is_file() {
        return Err(malformed(path, "this is not a regular file"));
    }
    std::fs::read(path).map_err(io)
}
