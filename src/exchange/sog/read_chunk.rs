//! Reads one SOG: the pictures that [`super::chunk`] describes, back into rows.
//!
//! Invariants: 1. a picture is decoded only if its size fits the number of rows, which [`ROWS_MAX`] limits, and rows are allocated
//! only after their pictures; 2. every value is finite; 3. no name leaves the folder of `meta.json`.

use super::chunk::ENTRIES_PER_LINE;
use super::codebook::CODES;
use crate::base::error::{InputError, InputResult};
use crate::base::math::logit;
use crate::base::whole_file::folder_of;
use crate::scene::columns::{Column, Columns, sh_n_width};
use image_webp::WebPDecoder;
use serde::Deserialize;
use serde::de::DeserializeOwned;
use std::io::{Cursor, ErrorKind};
use std::path::{Component, Path, PathBuf};

/// Largest file, bytes.
const FILE_MOST: u64 = 1 << 30;
/// Most rows of a SOG. They take up to 1 GB, and their pictures .1 GB.
const ROWS_MAX: usize = 1 << 22;
/// Largest logarithm of a position: f32 holds its exponential.
const LOG_MAX: f64 = 88.0;
/// Least opacity; the largest is 1 less this. The logits of 0 and 1 are infinite.
const OPACITY_MIN: f32 = 1e-6;

#[derive(Debug, Deserialize)]
struct Meta {
    version: u32,
    count: usize,
    #[serde(default)]
    antialias: bool,
    means: Means,
    quats: Uncoded,
    scales: Coded,
    sh0: Coded,
    #[serde(rename = "shN")]
    sh_n: Option<Harmonics>,
}

#[derive(Debug, Deserialize)]
struct Means {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Debug, Deserialize)]
struct Uncoded {
    files: [String; 1],
}

#[derive(Debug, Deserialize)]
struct Coded {
    codebook: Vec<Option<f32>>,
    files: [String; 1],
}

#[derive(Debug, Deserialize)]
struct Harmonics {
    count: usize,
    bands: u8,
    codebook: Vec<Option<f32>>,
    /// Palette, labels.
    files: [String; 2],
}

/// A SOG whose `meta.json` was read.
#[derive(Debug)]
pub struct SogChunk {
    path: PathBuf,
    meta: Meta,
}

impl SogChunk {
    /// Reads the `meta.json` at `path`.
    /// Errors: the file cannot be read, or describes no SOG that [`SogChunk::read`] could read.
    pub fn open(path: &Path) -> InputResult<SogChunk> {
        let meta: Meta = read_json(path)?;
        if meta.version != 2 {
            return Err(unsupported(path, format!("version {} of SOG; version 2 is read", meta.version)).at("version"));
        }
        if meta.count > ROWS_MAX {
            return Err(unsupported(path, format!("{} Gaussians; at most {ROWS_MAX} are read", meta.count)).at("count"));
        }
        if let Some(sh) = meta.sh_n.as_ref().filter(|sh| sh.bands > 3 || !(1..=1 << 16).contains(&sh.count)) {
            let problem =
                format!("{} bands in a palette of {}; at most 3 in one of 1 to 65,536 are read", sh.bands, sh.count);
            return Err(unsupported(path, problem).at("shN"));
        }
        if !meta.means.mins.iter().chain(&meta.means.maxs).all(|log| log.abs() <= LOG_MAX) {
            return Err(malformed(path, "a position is beyond the range of numbers").at("means"));
        }
        Ok(SogChunk { path: path.to_path_buf(), meta })
    }

    pub fn rows(&self) -> usize {
        self.meta.count
    }

    /// Whether the Gaussians were trained with compensated opacities, which this renderer lacks.
    pub fn is_antialiased(&self) -> bool {
        self.meta.antialias
    }

    /// Reads the rows.
    /// Errors: a picture cannot be read, or is not as `meta.json` says.
    pub fn read(&self) -> InputResult<Columns> {
        let Meta { count, means, quats, scales, sh0, sh_n, .. } = &self.meta;
        let picture = |name: &str| ChunkPicture::read(&path_in_folder(&self.path, name)?, *count);
        let (low, high) = (picture(&means.files[0])?, picture(&means.files[1])?);
        let (turns, sizes, colours) = (picture(&quats.files[0])?, picture(&scales.files[0])?, picture(&sh0.files[0])?);
        let harmonics = match sh_n.as_ref().filter(|sh| sh.bands > 0) {
            Some(sh) => {
                let line = ENTRIES_PER_LINE * sh_n_width(sh.bands) / 3;
                let path = path_in_folder(&self.path, &sh.files[0])?;
                let palette = ChunkPicture::read(&path, sh.count.div_ceil(ENTRIES_PER_LINE) * line)?;
                if palette.width != line {
                    return Err(malformed(&path, format!("{} pixels wide; a palette has {line}", palette.width)));
                }
                Some((sh, palette, picture(&sh.files[1])?))
            }
            None => None,
        };
        let mut columns = Columns::zeros(*count, harmonics.as_ref().map_or(0, |(sh, ..)| sh.bands));
        for (row, mean) in columns.means.as_chunks_mut::<3>().0.iter_mut().enumerate() {
            *mean = [0, 1, 2].map(|i| position(low.pixels[row][i], high.pixels[row][i], means.mins[i], means.maxs[i]));
        }
        for (row, quat) in columns.quats.as_chunks_mut::<4>().0.iter_mut().enumerate() {
            let named = quaternion(turns.pixels[row]);
            *quat = named.ok_or_else(|| {
                malformed(&turns.path, "the alpha of a quaternion is 252 to 255").at(format!("pixel {row}"))
            })?;
        }
        let book = self.codebook("scales.codebook", &scales.codebook)?;
        for (log_scales, pixel) in columns.scales.as_chunks_mut::<3>().0.iter_mut().zip(&sizes.pixels) {
            *log_scales = coded(&book, *pixel);
        }
        let book = self.codebook("sh0.codebook", &sh0.codebook)?;
        for (row, pixel) in colours.pixels.iter().take(*count).enumerate() {
            columns.row_mut(Column::Sh0, row).copy_from_slice(&coded(&book, *pixel));
            columns.opacities[row] = logit((f32::from(pixel[3]) / 255.0).clamp(OPACITY_MIN, 1.0 - OPACITY_MIN));
        }
        if let Some((sh, palette, labels)) = harmonics {
            let book = self.codebook("shN.codebook", &sh.codebook)?;
            let width = sh_n_width(sh.bands);
            for (row, sh_n) in columns.sh_n.chunks_exact_mut(width).enumerate() {
                let [low, high, ..] = labels.pixels[row];
                let label = usize::from(u16::from_le_bytes([low, high]));
                if label >= sh.count {
                    let problem = format!("label {label} of a palette of {} entries", sh.count);
                    return Err(malformed(&labels.path, problem).at(format!("pixel {row}")));
                }
                // Lines hold whole entries, so the entries follow each other.
                let entry = &palette.pixels[label * (width / 3)..][..width / 3];
                for (values, pixel) in sh_n.as_chunks_mut::<3>().0.iter_mut().zip(entry) {
                    *values = coded(&book, *pixel);
                }
            }
        }
        Ok(columns)
    }

    /// The values of a codebook. Some programs write fewer than 256, and no number for the first one, which then follows from the
    /// distance of the others, as PlayCanvas' engine has it.
    fn codebook(&self, place: &str, values: &[Option<f32>]) -> InputResult<[f32; CODES]> {
        let wrong = || malformed(&self.path, format!("a codebook has 1 to {CODES} finite values")).at(place);
        let last = values.last().copied().flatten().filter(|_| values.len() <= CODES).ok_or_else(wrong)?;
        let mut book = [last; CODES];
        for (i, value) in values.iter().enumerate() {
            let second = values.get(1).copied().flatten();
            let extrapolated = || second.filter(|_| i == 0).map(|second| second + (second - last) / 255.0);
            book[i] = value.or_else(extrapolated).ok_or_else(wrong)?;
        }
        if book.iter().all(|v| v.is_finite()) { Ok(book) } else { Err(wrong()) }
    }
}

/// A coordinate between the least and the largest, all as logarithms.
fn position(low: u8, high: u8, least: f64, largest: f64) -> f32 {
    let share = f64::from(u16::from_le_bytes([low, high])) / 65535.0;
    let log = least + share * (largest - least);
    libm::copysign(libm::expm1(log.abs()), log) as f32
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

/// The values that red, green and blue stand for.
fn coded(book: &[f32; CODES], pixel: [u8; 4]) -> [f32; 3] {
    [0, 1, 2].map(|i| book[usize::from(pixel[i])])
}

struct ChunkPicture {
    path: PathBuf,
    width: usize,
    /// RGBA.
    pixels: Vec<[u8; 4]>,
}

impl ChunkPicture {
    /// Reads a lossless picture of at least `least` pixels.
    fn read(path: &Path, least: usize) -> InputResult<ChunkPicture> {
        let wrong = |e: image_webp::DecodingError| malformed(path, format!("cannot be decoded: {e}"));
        let mut decoder = WebPDecoder::new(Cursor::new(read_file(path)?)).map_err(wrong)?;
        let (width, height) = decoder.dimensions();
        let count = width as usize * height as usize;
        // A picture that is nearly square, and the palette's, have a few lines more than their values need.
        let most = 2 * least + (1 << 16);
        if decoder.is_lossy() || decoder.is_animated() {
            return Err(unsupported(path, "not a lossless picture"));
        }
        if !(least..=most).contains(&count) {
            return Err(malformed(path, format!("{width} x {height} pixels where {least} to {most} are needed")));
        }
        let channels = if decoder.has_alpha() { 4 } else { 3 };
        let mut bytes = vec![0; count * channels];
        decoder.read_image(&mut bytes).map_err(wrong)?;
        let pixels = match channels {
            4 => bytes.as_chunks::<4>().0.to_vec(),
            _ => bytes.as_chunks::<3>().0.iter().map(|&[r, g, b]| [r, g, b, u8::MAX]).collect(),
        };
        Ok(ChunkPicture { path: path.to_path_buf(), width: width as usize, pixels })
    }
}

/// An error of a file that contradicts itself or its folder.
pub(super) fn malformed(path: &Path, problem: impl Into<String>) -> InputError {
    InputError::new(path, problem, "the folder is damaged: copy it again, or export it again")
}

/// An error of a file that may follow the format, but that this reader does not support.
pub(super) fn unsupported(path: &Path, problem: impl Into<String>) -> InputError {
    InputError::new(path, problem, "give a folder that gsscale wrote, or evaluate the PLY that the folder was made of")
}

/// Reads a JSON file.
/// Errors: the file cannot be read, or lacks a part.
pub(super) fn read_json<T: DeserializeOwned>(path: &Path) -> InputResult<T> {
    serde_json::from_slice(&read_file(path)?).map_err(|e| malformed(path, format!("cannot be parsed: {e}")))
}

/// The file that `name`, a path in `from`, names in the folder of `from`.
/// Errors: the path leads out of the folder.
pub(super) fn path_in_folder(from: &Path, name: &str) -> InputResult<PathBuf> {
    let is_inside = |part: Component<'_>| matches!(part, Component::Normal(_) | Component::CurDir);
    let path = Path::new(name);
    match path.file_name().is_some() && path.components().all(is_inside) {
        true => {
            Ok(folder_of(from).join(path.components().filter(|part| *part != Component::CurDir).collect::<PathBuf>()))
        }
        false => Err(malformed(from, format!("names the file '{name}', which is not in its folder"))),
    }
}

fn read_file(path: &Path) -> InputResult<Vec<u8>> {
    let io = |e: std::io::Error| match InputError::io(path, "reading", &e) {
        missing if e.kind() == ErrorKind::NotFound => {
            let remedy = "check the path; if it is right, the folder is not whole: copy it again, or export it again";
            InputError { remedy: remedy.into(), ..missing }
        }
        other => other,
    };
    // Checked before opening: opening a pipe would block until somebody writes to it.
    let metadata = std::fs::metadata(path).map_err(io)?;
    if !metadata.is_file() {
        return Err(malformed(path, "this is not a regular file"));
    }
    if metadata.len() > FILE_MOST {
        return Err(malformed(path, "the file is larger than 1 GiB"));
    }
    std::fs::read(path).map_err(io)
}
