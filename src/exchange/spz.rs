//! Writes SPZ, version 3: Gaussians in a tenth of a PLY's bytes (`github.com/nianticlabs/spz`).
//!
//! Not here: reading it.
//!
//! A file is one gzip stream: a header of 16 bytes, then one array for each attribute, one element a Gaussian: positions,
//! opacities, colours, scales, rotations, harmonics. The axes are x right, y up, z to the back, which is half a turn about x
//! from those of a PLY.
//!
//! Written here and not by a crate: those that write SPZ (`spz` 0.0, `wgpu-3dgs-core` 0.7) take all Gaussians at once, and a city's do
//! not fit in memory. Rows go to a temporary file beside the target first, packed but for their positions, whose number of
//! fractional bits follows from the largest one. At the end the temporary file is read once for each attribute.
//!
//! Invariants: 1. the bytes depend on the rows, their order and the metadata alone; 2. the target is replaced as a whole or
//! not at all; 3. memory beyond the given rows is a few buffers of 1 MiB; 4. the temporary file is removed, also after errors;
//! 5. a row with a value that is not finite, or with a coordinate beyond 8 million, is left out and counted; values out of a byte's
//! range become its nearest end, which is told where it shows: Gaussians that become smaller, positions that become coarse.

use crate::base::error::{InputError, InputResult};
use crate::base::math::sigmoid;
use crate::base::units::counted_are;
use crate::base::whole_file::PartFile;
use crate::exchange::frames::{ExportRow, ExportRows};
use crate::exchange::meta::{ExportFrame, SceneMeta};
use crate::exchange::sink::{Format, FormatSink, LevelCounts};
use crate::scene::rotation::{Rotation, VIEWER_UP};
use flate2::Compression;
use flate2::write::GzEncoder;
use std::f32::consts::FRAC_1_SQRT_2;
use std::fs::File;
use std::io::{self, BufReader, BufWriter, Read, Seek, Write};
use std::path::{Path, PathBuf};

/// First bytes of a file, little endian: "NGSP".
const MAGIC: u32 = 0x5053_474e;
const VERSION: u32 = 3;
/// Bytes of a position in the temporary file: three f32.
const RAW_POSITION_BYTES: usize = 12;
const BUFFER_BYTES: usize = 1 << 20;
/// Half a turn about x: from the axes of a PLY to those of SPZ.
const HALF_TURN: Rotation = Rotation::HALF_TURN_ABOUT_X;
/// Up in an upright file.
pub const SPZ_UP: [f64; 3] = [0.0, -VIEWER_UP[1], 0.0];
const POSITION_BYTES: usize = 9;
/// Largest magnitude of a coordinate's 24 bits.
const FIXED_MAX: f64 = 8_388_607.0;
/// Most fractional bits of a coordinate. f32 holds no more of values beyond 1/2.
const FRACTION_BITS_MAX: u8 = 22;
/// Largest log sigma of a byte: of 379 units.
const LOG_SCALE_MAX: f32 = 255.0 / 16.0 - 10.0;
/// A warning names the far rows that cost all positions so many fractional bits, 64 times the precision.
const BITS_LOST: u8 = 6;
/// The part of the rows that counts as few.
const FAR_SHARE: f64 = 1e-3;
/// Most Gaussians that the format's own reader opens.
const READER_ROWS_MAX: u64 = 10_000_000;
/// Colours: a constant band of 0 is mid grey, and this much of it is the whole range.
const COLOR_SCALE: f32 = 0.15;
/// Largest magnitude of the small components of a quaternion, in 9 bits.
const QUAT_MAX: f32 = 511.0;

pub struct SpzWriter {
    path: PathBuf,
    part: PartFile,
    out: File,
    rows_path: PathBuf,
    rows_part: PartFile,
    rows_file: BufWriter<File>,
    sh_degree: u8,
    rows: u64,
    reach: f32,
    /// Rows left out because a coordinate is too large for the format.
    far: u64,
    /// Rows by the fractional bits that their position allows.
    rows_by_bits: [u64; FRACTION_BITS_MAX as usize + 1],
    /// Rows by the fewest fractional bits with which a position moves by less than their largest sigma.
    rows_by_need: [u64; FRACTION_BITS_MAX as usize + 1],
    /// Rows with a sigma beyond the format's.
    large: u64,
    is_local: bool,
}

impl SpzWriter {
    /// Converts the metadata of a PLY to the axes of SPZ.
    pub fn spz_meta(meta: &SceneMeta) -> SceneMeta {
        let upright = meta.upright.map_or(HALF_TURN, |upright| HALF_TURN.after(&upright));
        SceneMeta { upright: Some(upright), ..meta.clone() }
    }

    /// Starts a file of rows with the bands of `sh_degree`, beside its target. `meta` is that of a PLY of the same rows.
    /// Errors: the disk fails, or `path` names no file.
    pub fn create(path: &Path, sh_degree: u8, meta: &SceneMeta) -> InputResult<FormatSink<SpzWriter>> {
        let to_file = ExportRows::new(&Self::spz_meta(meta));
        let (part, out) = PartFile::create(path)?;
        let rows_path = path.with_extension("spz.rows");
        let (rows_part, rows_file) = PartFile::create(&rows_path)?;
        let writer = SpzWriter {
            path: path.to_path_buf(),
            part,
            out,
            rows_path,
            rows_part,
            rows_file: BufWriter::with_capacity(BUFFER_BYTES, rows_file),
            sh_degree,
            rows: 0,
            reach: 0.0,
            far: 0,
            rows_by_bits: [0; FRACTION_BITS_MAX as usize + 1],
            rows_by_need: [0; FRACTION_BITS_MAX as usize + 1],
            large: 0,
            is_local: to_file.frame() == ExportFrame::Local,
        };
        Ok(FormatSink::new(path, sh_degree, to_file, writer))
    }

    /// Writes header and arrays as one gzip stream; returns its length.
    fn compress(&mut self) -> io::Result<u64> {
        self.rows_file.flush()?;
        let fraction_bits = fraction_bits(self.reach);
        let mut gzip = GzEncoder::new(BufWriter::with_capacity(BUFFER_BYTES, &self.out), Compression::default());
        gzip.write_all(&header(self.rows as u32, self.sh_degree, fraction_bits))?;
        let attributes = attribute_bytes(self.sh_degree);
        let row_bytes = RAW_POSITION_BYTES + attributes.iter().sum::<usize>();
        let rows = self.rows_file.get_mut();
        each_row(rows, (self.rows, row_bytes), |row| {
            let (numbers, _) = row[..RAW_POSITION_BYTES].as_chunks::<4>();
            let position = [0, 1, 2].map(|i| f32::from_le_bytes(numbers[i]));
            gzip.write_all(&packed_position(position, fraction_bits))
        })?;
        let mut start = RAW_POSITION_BYTES;
        for length in attributes {
            if length > 0 {
                each_row(rows, (self.rows, row_bytes), |row| gzip.write_all(&row[start..start + length]))?;
            }
            start += length;
        }
        gzip.finish()?.flush()?;
        Ok(self.out.metadata()?.len())
    }
}

impl Format for SpzWriter {
    fn put(&mut self, row: &ExportRow) -> InputResult<bool> {
        let reach = row.position.iter().fold(0.0f32, |most, x| most.max(x.abs()));
        if reach > FIXED_MAX as f32 {
            self.far += 1;
            return Ok(false);
        }
        self.reach = self.reach.max(reach);
        self.rows_by_bits[usize::from(fraction_bits(reach))] += 1;
        let need = -row.log_scales.iter().copied().fold(f32::MIN, f32::max) / std::f32::consts::LN_2;
        self.rows_by_need[need.ceil().clamp(0.0, f32::from(FRACTION_BITS_MAX)) as usize] += 1;
        self.large += u64::from(row.log_scales.iter().any(|&s| s > LOG_SCALE_MAX));
        let mut bytes: Vec<u8> = row.position.iter().flat_map(|x| x.to_le_bytes()).collect();
        push_attributes(&ExportRow { quat: half_turn_of_own_axes(row.quat), ..*row }, self.sh_degree, &mut bytes);
        self.rows_file.write_all(&bytes).map_err(|e| InputError::io(&self.rows_path, "writing", &e))?;
        self.rows += 1;
        Ok(true)
    }

    fn complete(mut self) -> InputResult<(u64, Option<LevelCounts>)> {
        let rows = self.rows;
        if u32::try_from(rows).is_err() {
            let problem = format!("an SPZ file holds at most {} Gaussians, and these are {rows}", u32::MAX);
            return Err(InputError::new(&self.path, problem, "export a part of the scene"));
        }
        let bytes = self.compress().map_err(|e| InputError::io(&self.path, "writing", &e))?;
        self.part.finish(self.out)?;
        drop(self.rows_part);
        Ok((bytes, None))
    }

    fn warnings(&self) -> Vec<String> {
        let mut told = Vec::new();
        let remedy = if self.is_local { "use a PLY or SOG" } else { "use --export-frame local, or a PLY or SOG" };
        let gaussians_are = |rows: u64| counted_are(rows, "Gaussian");
        if self.large > 0 {
            let (large, most) = (gaussians_are(self.large), f64::from(LOG_SCALE_MAX).exp());
            told.push(format!(
                "{large} larger than a sigma of {most:.0} units, the most that SPZ holds, and cut to that: {remedy}"
            ));
        }
        let few = (FAR_SHARE * self.rows as f64) as u64;
        let (bits, mut far) = (fraction_bits(self.reach), 0);
        for most in bits..=FRACTION_BITS_MAX {
            let rows = self.rows_by_bits[usize::from(most)];
            if far + rows > few {
                if most >= bits + BITS_LOST {
                    let (far, step) = (gaussians_are(far), 0.5f64.powi(i32::from(bits)));
                    told.push(format!("{far} so far out that SPZ rounds all positions to {step} units: {remedy}"));
                }
                break;
            }
            far += rows;
        }
        let small: u64 = self.rows_by_need[usize::from(bits) + 1..].iter().sum();
        if told.is_empty() && small > few {
            let (small, step) = (gaussians_are(small), 0.5f64.powi(i32::from(bits)));
            told.push(format!("{small} smaller than the {step} units to which SPZ rounds all positions: {remedy}"));
        }
        if self.rows > READER_ROWS_MAX {
            told.push(format!(
                "{} Gaussians are more than the {READER_ROWS_MAX} that the format's own reader opens: export fewer (--max-gaussians), or a SOG",
                self.rows
            ));
        }
        told
    }

    fn holds_none(&self, given: u64) -> Option<InputError> {
        let problem = format!("all {given} Gaussians lie beyond the {} units of this format", FIXED_MAX as f32);
        let remedy = "export in local coordinates (--export-frame local), or as a PLY";
        (self.far == given).then(|| InputError::new(&self.path, problem, remedy))
    }
}

/// Rotates the Gaussian's own axes by 180 degrees about the first of them, which leaves the covariance unchanged. Readers
/// conjugate quaternions when they convert a file to the axes of a PLY; they then get the quaternion of the PLY.
fn half_turn_of_own_axes([w, x, y, z]: [f32; 4]) -> [f32; 4] {
    [x, -w, -z, y]
}

fn header(rows: u32, sh_degree: u8, fraction_bits: u8) -> [u8; 16] {
    let mut header = [0; 16];
    header[..4].copy_from_slice(&MAGIC.to_le_bytes());
    header[4..8].copy_from_slice(&VERSION.to_le_bytes());
    header[8..12].copy_from_slice(&rows.to_le_bytes());
    header[12] = sh_degree;
    header[13] = fraction_bits;
    header
}

/// Calls `take` with each of `rows` rows of a file of rows.
fn each_row(
    file: &mut File,
    (rows, row_bytes): (u64, usize),
    mut take: impl FnMut(&[u8]) -> io::Result<()>,
) -> io::Result<()> {
    file.rewind()?;
    let mut file = BufReader::with_capacity(BUFFER_BYTES, file);
    let mut row = vec![0; row_bytes];
    for _ in 0..rows {
        file.read_exact(&mut row)?;
        take(&row)?;
    }
    Ok(())
}

/// Lengths of the attributes of a row that follow its position: opacity, colours, scales, rotation, harmonics.
fn attribute_bytes(sh_degree: u8) -> [usize; 5] {
    let n = usize::from(sh_degree) + 1;
    [1, 3, 3, 4, 3 * (n * n - 1)]
}

/// The most fractional bits with which coordinates up to `reach` (file units) fit into 24 bits.
fn fraction_bits(reach: f32) -> u8 {
    let fits = |bits: &u8| f64::from(reach) * f64::from(1u32 << bits) <= FIXED_MAX - 0.5;
    (0..=FRACTION_BITS_MAX).rev().find(fits).unwrap_or(0)
}

/// Position with this many fractional bits: three numbers of 24 bits, little endian.
fn packed_position(position: [f32; 3], fraction_bits: u8) -> [u8; POSITION_BYTES] {
    let mut out = [0; POSITION_BYTES];
    for (bytes, x) in out.chunks_exact_mut(3).zip(position) {
        let fixed = libm::rint(f64::from(x) * f64::from(1u32 << fraction_bits)).clamp(-FIXED_MAX, FIXED_MAX) as i32;
        bytes.copy_from_slice(&fixed.to_le_bytes()[..3]);
    }
    out
}

/// The attributes that follow a position, in their order.
fn push_attributes(row: &ExportRow, sh_degree: u8, out: &mut Vec<u8>) {
    out.push(byte(sigmoid(row.opacity) * 255.0));
    out.extend(row.sh0.map(|c| byte(c * (COLOR_SCALE * 255.0) + 0.5 * 255.0)));
    out.extend(row.log_scales.map(|s| byte((s + 10.0) * 16.0)));
    out.extend(rotation(row.quat));
    // The linear band keeps five bits, the others four.
    let [.., harmonics] = attribute_bytes(sh_degree);
    out.extend(row.sh_n[..harmonics].iter().enumerate().map(|(i, &v)| harmonic(v, if i < 9 { 8 } else { 16 })));
}

fn byte(value: f32) -> u8 {
    // The cast cuts to the range of a byte.
    libm::rintf(value) as u8
}

/// A coefficient in [-1, 1) around 128, rounded to a multiple of `bucket`.
fn harmonic(value: f32, bucket: i32) -> u8 {
    let q = libm::rintf(value.clamp(-2.0, 2.0) * 128.0) as i32 + 128;
    ((q + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

/// A unit quaternion (w first) in 32 bits, little endian: number of the largest component among x, y, z, w, then the others in
/// this order, each a sign and nine bits. The largest one is positive: a quaternion and its negative are one rotation.
fn rotation([w, x, y, z]: [f32; 4]) -> [u8; 4] {
    let q = [x, y, z, w];
    let largest = (1..4).fold(0, |best, i| if q[i].abs() > q[best].abs() { i } else { best });
    let turns = q[largest] < 0.0;
    let mut bits = largest as u32;
    for (i, value) in q.into_iter().enumerate() {
        if i != largest {
            let magnitude = libm::rintf(value.abs() / FRAC_1_SQRT_2 * QUAT_MAX).min(QUAT_MAX) as u32;
            let is_negative = (value < 0.0) != turns;
            bits = bits << 10 | u32::from(is_negative) << 9 | magnitude;
        }
    }
    bits.to_le_bytes()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coordinates_have_as_many_bits_as_fit() {
        for (reach, bits) in [(0.0, 22), (1.0, 22), (2.0, 21), (2047.0, 12), (2048.0, 11), (8_388_606.0, 0), (1e9, 0)] {
            assert_eq!(fraction_bits(reach), bits, "{reach}");
        }
        // -1.5 in units of 1/16 is -24.
        assert_eq!(packed_position([1.0, -1.5, 0.0], 4), [16, 0, 0, 232, 255, 255, 0, 0, 0]);
        // Beyond the range: its end.
        assert_eq!(packed_position([1e9, 0.0, -1e9], 0), [255, 255, 127, 0, 0, 0, 1, 0, 128]);
    }
}
